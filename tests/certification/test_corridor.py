"""The corridor: joint bounds, forgeries that are refused, and a policy end to end."""

import copy
from functools import cache

import jax
import numpy as np
import pytest
from helpers import TINY, any_law, path_space

from sfkd_jax import data as datasets
from sfkd_jax import models
from sfkd_jax.certification import CertificationRefused, issue, verify_document
from sfkd_jax.certification._measured import coverage_interval
from sfkd_jax.certification._tubes import (
    ALONE,
    JOINT,
    calibrate_corridor,
    corridor_coverage,
)
from sfkd_jax.certification._verification import require_corridor
from sfkd_jax.certification.corridor import certify_corridor, closed_loop
from sfkd_jax.plants import kinematic

NAMES = (*JOINT, *ALONE)


def scores(count, seed):
    random = np.random.default_rng(seed)
    return random.lognormal(size=(count, len(NAMES)))


@cache
def corridor():
    bounds = calibrate_corridor(scores(60, 0), scores(60, 1), level=0.9)
    part = corridor_coverage(bounds, scores(200, 2))
    return {
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["vehicle_to_nominal_position"],
        "level": 0.9,
        "runs": 60,
        **part,
        "by_scenario": {"s3": part},
        "attack": {"over_tube": 0.7, "over_corridor": 0.5},
    }


def counted(corridor, **changes):
    """With the interval that a share and a number of runs have."""
    corridor.update(changes)
    corridor["coverage_ci95"] = coverage_interval(
        corridor["coverage"], corridor["coverage_runs"]
    )


FORGED = {
    "a bound": (
        "corridor_m",
        lambda c: c["bounds"].update(vehicle_to_nominal_position=0.01),
    ),
    "a bound NaN": ("bounds", lambda c: c["bounds"].update(nominal=float("nan"))),
    "a bound without end": (
        "bounds",
        lambda c: c["bounds"].update(asymptotic_yaw=float("inf")),
    ),
    "a bound that there is not": ("bounds", lambda c: c["bounds"].update(more=1.0)),
    "a bound left out": ("bounds", lambda c: c["bounds"].pop("asymptotic_yaw")),
    "too few runs": ("level", lambda c: c.update(runs=8)),
    "a level of 1": ("level", lambda c: c.update(level=1.0)),
    "a level of 0": ("level", lambda c: c.update(level=0.0)),
    "a coverage between two counts": (
        "corridor: coverage",
        lambda c: counted(c, coverage=c["coverage"] - 0.001),
    ),
    "a coverage above 1": ("corridor: a coverage", lambda c: c.update(coverage=1.5)),
    "another number of runs": (
        "corridor: coverage",
        lambda c: c.update(coverage_runs=100),
    ),
    "another scenario": (
        "s3: coverage",
        lambda c: c["by_scenario"]["s3"].update(coverage=0.5),
    ),
    "an attack just beyond the tube": (
        "attack",
        lambda c: c["attack"].update(over_tube=1.0 + 1e-12),
    ),
    "an attack that is no number": (
        "attack",
        lambda c: c["attack"].update(over_tube=float("nan")),
    ),
}


@pytest.mark.parametrize(("named", "forge"), FORGED.values(), ids=list(FORGED))
def test_a_corridor_whose_parts_do_not_go_together_is_refused(named, forge):
    changed = copy.deepcopy(corridor())
    require_corridor(changed)
    forge(changed)
    with pytest.raises(CertificationRefused) as reason:
        require_corridor(changed)
    assert named in str(reason.value)


def test_bounds_are_units_of_other_runs_times_a_quantile():
    """Level 0.5 of three runs: the second; the lateral tube counts in its median, the
    others in their 0.95.
    """
    reference = np.outer([0.0, 1.0, 2.0], [1.0, 10.0, 100.0, 9.0, 8.0])
    new = np.asarray(
        [
            [3.0, 1.0, 19.0, 7.0, 0.3],
            [0.1, 38.0, 20.0, 5.0, 0.2],
            [0.2, 2.0, 190.0, 6.0, 0.4],
        ]
    )
    bounds = calibrate_corridor(reference, new, level=0.5)
    assert bounds == pytest.approx(
        dict(zip(NAMES, [2.0, 38.0, 380.0, 6.0, 0.3], strict=True))
    )


def test_a_run_on_its_bound_is_covered_and_one_that_leaves_any_bound_is_not():
    bounds = dict(zip(NAMES, (1.0, 2.0, 3.0, 0.1, 0.1), strict=True))
    inside = np.tile([1.0, 2.0, 3.0, 9.0, 9.0], (5, 1))
    inside[range(3), range(3)] *= 1 + 1e-9
    assert corridor_coverage(bounds, inside) == {
        "coverage": 0.4,
        "coverage_ci95": coverage_interval(0.4, 5),
        "coverage_trajectories": 5,
        "coverage_runs": 5,
    }


# --- end to end, of an untrained policy: the claims do not depend on training ---------

BOX = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
DATA = BOX | {
    "seed": 0,
    "speed": (8.0, 10.5),
    "peak_curvature": 0.02,
    "wavelengths": (50.0, 200.0),
    "lateral_acceleration": 2.0,
    "steering_excitation": (0.002, 0.025),
    "speed_excitation": (0.05, 0.6),
}


def test_a_document_with_a_corridor_verifies():
    """As `certify` makes it, with fewer and shorter runs."""
    options = TINY | {"frame": "path", "transport": False, "budget": "joint"}
    model = models.sfkd(path_space(), **options)
    params = model.init(jax.random.key(0))
    loop = closed_loop(kinematic(), model, params, any_law(), (0.015, 0.015, 0.002))
    generate = datasets.generate_along_path
    driven = jax.jit(
        lambda key: generate(loop.plant, key, segments=120, steps=20, **BOX)
    )(jax.random.key(1))
    validation, calibration, test = (
        jax.tree.map(lambda leaf, k=k: leaf[k::3], driven) for k in range(3)
    )
    body = np.asarray(driven.states)[..., 3:].reshape(-1, 3)
    boxes = {
        "state": [body.min(0).tolist(), body.max(0).tolist()],
        "control": [[-0.03, -1.0, -0.02, 8.0], [0.03, 1.0, 0.02, 10.5]],
        "env": [list(side) for side in BOX.values()],
    }
    document = issue(
        model,
        params,
        validation=validation,
        calibration=calibration,
        held_out={"test": test},
        boxes=boxes,
        level=0.9,
        attack_starts=0,
    )
    small = {"runs": 24, "duration": 4.0, "attack_steps": 3000}
    document["corridor"] = certify_corridor(
        loop, document["outputs"], DATA, 0.9, **small
    )
    document["policy_sha256"] = "0" * 64
    verify_document(document, params, model=model, policy_sha256="0" * 64)
