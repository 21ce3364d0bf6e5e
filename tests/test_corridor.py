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
from sfkd_jax.certification import CertificationRefused, issue, verify_document
from sfkd_jax.certification.corridor import certify_corridor, closed_loop
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
    result["corridor"] = certify_corridor(loop, result["outputs"], DATA, 0.9, **SMALL)
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
