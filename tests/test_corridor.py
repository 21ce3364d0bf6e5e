"""The corridor of a policy, end to end.

The policy is untrained, because the claims do not depend on training.
"""

import copy
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from helpers import TINY, any_law, path_space

from sfkd_jax import data as datasets
from sfkd_jax import models
from sfkd_jax.certification import (
    CertificationRefused,
    issue,
    output_metrics_from,
    verify_document,
)
from sfkd_jax.certification.corridor import (
    certify_corridor,
    closed_loop,
    corridor_by_speed,
    fastest_speeds,
)
from sfkd_jax.plants import kinematic

DRIVEN = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
SMALL = {"runs": 24, "duration": 4.0, "attack_steps": 3000}


@pytest.fixture(scope="module")
def trained():
    options = TINY | {"frame": "path", "transport": False, "budget": "joint"}
    model = models.sfkd(path_space(), **options)
    params = model.init(jax.random.key(0))
    return SimpleNamespace(model=model, params=params, law=any_law(), sha256="0" * 64)


@pytest.fixture(scope="module")
def loop(trained):
    return closed_loop(
        kinematic(), trained.model, trained.params, trained.law, (0.015, 0.015, 0.002)
    )


DATA = DRIVEN | {
    "seed": 0,
    "speed": (8.0, 10.5),
    "peak_curvature": 0.02,
    "wavelengths": (50.0, 200.0),
    "lateral_acceleration": 2.0,
    "steering_excitation": (0.002, 0.025),
    "speed_excitation": (0.05, 0.6),
}


def corridor_of(loop, outputs):
    return certify_corridor(loop, output_metrics_from(outputs), DATA, 0.9, **SMALL)


@pytest.fixture(scope="module")
def document(trained, loop):
    """As `certify` makes it, with fewer and shorter runs."""
    make = jax.jit(
        lambda key: datasets.generate_along_path(
            loop.plant, key, segments=120, steps=20, **DRIVEN
        )
    )
    driven = make(jax.random.key(1))
    parts = {
        name: jax.tree.map(lambda leaf, k=k: leaf[k::3], driven)
        for k, name in enumerate(("validation", "calibration", "test"))
    }
    held_out = {"test": parts.pop("test")}
    body = np.asarray(driven.states)[..., 3:].reshape(-1, 3)
    boxes = {
        "state": [body.min(0).tolist(), body.max(0).tolist()],
        "env": [list(side) for side in DRIVEN.values()],
    }
    boxes["control"] = [[-0.03, -1.0, -0.02, 8.0], [0.03, 1.0, 0.02, 10.5]]
    options = {"level": 0.9, "attack_starts": 0}
    result = issue(
        trained.model,
        trained.params,
        **parts,
        held_out=held_out,
        boxes=boxes,
        **options,
    )
    result["corridor"] = corridor_of(loop, result["outputs"])
    return result | {"policy_sha256": trained.sha256}


def check(document, trained):
    verify_document(
        document, trained.params, model=trained.model, policy_sha256=trained.sha256
    )


def test_the_document_verifies_and_a_changed_one_does_not(document, trained):
    check(document, trained)
    for part, name, value in (
        ("corridor", "corridor_m", 0.01),
        ("corridor", "coverage", 1.5),
        ("outputs", "position", document["outputs"]["yaw"]),
    ):
        changed = copy.deepcopy(document)
        changed[part][name] = value
        with pytest.raises(CertificationRefused):
            check(changed, trained)
    without = copy.deepcopy(document)
    without["outputs"] = {}
    with pytest.raises(CertificationRefused, match="needs a metric"):
        check(without, trained)


def test_every_friction_and_speed_gets_a_corridor_of_its_own(document, loop):
    frictions, speeds = [0.3, 0.9], [8.0, 10.5]
    result = corridor_by_speed(
        loop, document, frictions=frictions, speeds=speeds, runs=24
    )
    cells = result["cells"]
    assert [(cell["friction"], cell["speed"]) for cell in cells] == [
        (f, v) for f in frictions for v in speeds
    ]
    assert [cell["curvature"] for cell in cells] == pytest.approx(
        [0.02, 2.0 / 10.5**2] * 2
    )
    for cell in cells:
        assert cell["corridor_m"] == pytest.approx(cell["nominal_m"] + cell["tube_m"])
        assert cell["lateral_m"] > 0.0
        assert cell["coverage_runs"] == 24
    assert len({cell["corridor_m"] for cell in cells}) == 4
    assert result["coverage"] == pytest.approx(
        np.mean([cell["coverage"] for cell in cells])
    )
    assert result["coverage_ci95"][1] - result["coverage_ci95"][0] < 0.25


def test_speeds_and_frictions_outside_the_box_are_refused(document, loop):
    for name, values in (
        ("friction", {"frictions": [0.2], "speeds": [9.0]}),
        ("speed", {"frictions": [0.3], "speeds": [11.0]}),
    ):
        with pytest.raises(
            ValueError, match=f"{name} .* is outside the certified range"
        ):
            corridor_by_speed(loop, document, **values)


def test_the_fastest_speed_is_one_below_which_every_corridor_fits():
    """Also where a faster one fits again by chance, and where none does."""
    widths = {
        0.3: (0.6, 0.4, 0.4),
        0.6: (0.4, 0.6, 0.4),
        0.9: (0.5, 0.4, 0.5),
        0.75: (0.4, 0.4, float("nan")),
    }
    cells = [
        {"friction": friction, "speed": speed, "corridor_m": width}
        for friction, row in widths.items()
        for speed, width in zip((8.0, 9.0, 10.0), row, strict=True)
    ]
    assert fastest_speeds(cells[::-1], 0.5) == {
        0.3: None,
        0.6: 8.0,
        0.75: 9.0,
        0.9: 10.0,
    }
    assert fastest_speeds(cells, 0.1) == dict.fromkeys(widths)
