"""The corridor: joint bounds, consistent counts, and forgeries that are refused.

`benchmarks/robustness/mutants.py` runs these tests against mutants of
`_corridor_claims`.
"""

import copy
from functools import cache

import numpy as np
import pytest

from sfkd_jax.certification import (
    OUTPUTS,
    DriveScores,
    FixedPoints,
    OutputMetric,
    _corridor_claims,
    calibrate_corridor,
    corridor_coverage,
    fixed_point_corridor,
    radii,
)
from sfkd_jax.certification._calibration import coverage_interval
from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._corridor_claims import drive_scores
from sfkd_jax.certification._radii import Residuals


def scores(count, seed):
    random = np.random.default_rng(seed)
    return DriveScores._make(random.lognormal(size=(len(DriveScores._fields), count)))


def test_bounds_hold_together_as_often_as_they_say():
    """Exchangeable drives, 400 repetitions of 60 calibrating ones: coverage 0.9 within
    its error, 0.9 to 0.93.
    """
    shares = []
    for repetition in range(400):
        bounds = calibrate_corridor(
            scores(60, 3 * repetition), scores(60, 3 * repetition + 1), level=0.9
        )
        shares.append(
            corridor_coverage(bounds, scores(200, 3 * repetition + 2))["coverage"]
        )
    assert 0.895 <= np.mean(shares) <= 0.93


PROVED = {"alpha": 0.8, "lipschitz": 0.02}
"""Of e_y."""


@cache
def corridor():
    bounds = calibrate_corridor(scores(60, 0), scores(60, 1), level=0.9)
    part = corridor_coverage(bounds, scores(200, 2))
    return {
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["followed_position"],
        "level": 0.9,
        "drives": 60,
        **part,
        "by_scenario": {"s3": part},
        "attack": {"over_tube": 0.7, "over_corridor": 0.5},
        "fixed_points": fixed_point_corridor(
            FixedPoints(0.01, 0.7, 0.9, 1.1, 500),
            **PROVED,
            for_ever=bounds["for_ever_position"],
            steps_between_switches=30,
        ),
    }


def counted(corridor, **changes):
    """With the interval that a share and a number of drives have."""
    corridor.update(changes)
    corridor["coverage_ci95"] = coverage_interval(
        corridor["coverage"], corridor["coverage_drives"]
    )


FORGED = {
    "the sum": (
        "corridor_m",
        lambda c: c.update(corridor_m=(1 - 1e-6) * c["corridor_m"]),
    ),
    "a difference": (
        "corridor_m",
        lambda c: c.update(corridor_m=c["bounds"]["nominal"]),
    ),
    "a bound": ("corridor_m", lambda c: c["bounds"].update(followed_position=0.01)),
    "a bound NaN": ("bounds", lambda c: c["bounds"].update(nominal=float("nan"))),
    "a bound without end": (
        "bounds",
        lambda c: c["bounds"].update(for_ever_yaw=float("inf")),
    ),
    "a bound of 0": ("bounds", lambda c: c["bounds"].update(for_ever_yaw=0.0)),
    "a bound below 0": ("bounds", lambda c: c["bounds"].update(followed_yaw=-0.5)),
    "a bound that there is not": ("bounds", lambda c: c["bounds"].update(more=1.0)),
    "a bound left out": ("bounds", lambda c: c["bounds"].pop("for_ever_yaw")),
    "a bound by another name": (
        "bounds",
        lambda c: c["bounds"].update(yaw=c["bounds"].pop("for_ever_yaw")),
    ),
    "too few drives": ("level", lambda c: c.update(drives=8)),
    "no drives": ("level", lambda c: c.update(drives=0)),
    "drives that are no count": ("level", lambda c: c.update(drives=60.0)),
    "a level of 1": ("level", lambda c: c.update(level=1.0)),
    "a level of 0": ("level", lambda c: c.update(level=0.0)),
    "a level below 0": ("level", lambda c: c.update(level=-0.5)),
    "a coverage between two counts": (
        "corridor: coverage",
        lambda c: counted(c, coverage=c["coverage"] - 0.001),
    ),
    "a coverage above 1": ("corridor: coverage", lambda c: c.update(coverage=1.5)),
    "a coverage below 0": ("corridor: coverage", lambda c: c.update(coverage=-0.5)),
    "another number of trajectories": (
        "corridor: coverage",
        lambda c: counted(c, coverage_trajectories=201),
    ),
    "another number of drives": (
        "corridor: coverage",
        lambda c: c.update(coverage_drives=100),
    ),
    "an interval": (
        "corridor: coverage",
        lambda c: c.update(coverage_ci95=[0.99, 1.0]),
    ),
    "another scenario": (
        "s3: coverage",
        lambda c: c["by_scenario"]["s3"].update(coverage=0.5),
    ),
    "an attack just beyond the tube": (
        "attack",
        lambda c: c["attack"].update(over_tube=1.0 + 1e-12),
    ),
    "an attack far beyond the tube": (
        "attack",
        lambda c: c["attack"].update(over_tube=1.9),
    ),
    "no fixed points": ("fixed_points", lambda c: c["fixed_points"].update(points=0)),
    "a fixed point off by less": (
        "fixed_points",
        lambda c: c["fixed_points"].update(centre_m=0.0),
    ),
    "a smaller move of the road": (
        "fixed_points",
        lambda c: c["fixed_points"].update(road=0.6),
    ),
    "a smaller switch": (
        "fixed_points",
        lambda c: c["fixed_points"].update(switch=0.1),
    ),
    "a smaller push": ("fixed_points", lambda c: c["fixed_points"].update(push=1.0)),
    "a push NaN": (
        "fixed_points",
        lambda c: c["fixed_points"].update(push=float("nan")),
    ),
    "a negative push": ("fixed_points", lambda c: c["fixed_points"].update(push=-1.0)),
    "rarer switches": (
        "fixed_points",
        lambda c: c["fixed_points"].update(steps_between_switches=10**6),
    ),
    "switches at no step": (
        "fixed_points",
        lambda c: c["fixed_points"].update(steps_between_switches=0),
    ),
    "half a step": (
        "fixed_points",
        lambda c: c["fixed_points"].update(steps_between_switches=30.5),
    ),
    "a narrower corridor": (
        "fixed_points",
        lambda c: c["fixed_points"]["corridor_m"].update(law=0.1),
    ),
    "another corridor": (
        "fixed_points",
        lambda c: c["fixed_points"]["corridor_m"].update(more=0.1),
    ),
    "no switch in it": (
        "fixed_points",
        lambda c: c["fixed_points"].update(
            after_switch_m=c["fixed_points"]["corridor_m"]
        ),
    ),
    "a larger tube": (
        "fixed_points",
        lambda c: c["bounds"].update(
            for_ever_position=2.0 * c["bounds"]["for_ever_position"]
        ),
    ),
    "an attack that is no number": (
        "attack",
        lambda c: c["attack"].update(over_tube=float("nan")),
    ),
}


def test_an_honest_corridor_passes():
    _corridor_claims.require_corridor(corridor(), PROVED)


def test_what_was_added_up_in_another_order_is_the_same():
    changed = copy.deepcopy(corridor())
    changed["corridor_m"] *= 1 + 1e-12
    counted(changed, coverage=changed["coverage"] * (1 - 1e-12))
    _corridor_claims.require_corridor(changed, PROVED)


@pytest.mark.parametrize(("named", "forge"), FORGED.values(), ids=list(FORGED))
def test_a_corridor_whose_parts_do_not_go_together_is_refused(named, forge):
    changed = copy.deepcopy(corridor())
    forge(changed)
    with pytest.raises(Refuted) as reason:
        _corridor_claims.require_corridor(changed, PROVED)
    assert named in str(reason.value)


@pytest.mark.parametrize("share", [0.0, 0.005, 1.0])
def test_every_share_of_all_drives_can_be_covered(share):
    changed = copy.deepcopy(corridor())
    counted(changed, coverage=share)
    counted(changed["by_scenario"]["s3"], coverage=share)
    changed["attack"]["over_tube"] = 1.0
    _corridor_claims.require_corridor(changed, PROVED)


def test_bounds_are_units_of_other_drives_times_a_quantile():
    """Level 0.5 of three drives: the second; the lateral tube counts in its median, the
    others in their 0.95.
    """
    reference = DriveScores(
        *(np.asarray([0.0, 1.0, 2.0]) * scale for scale in (1.0, 10.0, 9.0, 8.0, 100.0))
    )
    new = DriveScores(
        followed_position=np.asarray([3.0, 0.1, 0.2]),
        followed_yaw=np.asarray([1.0, 38.0, 2.0]),
        for_ever_position=np.asarray([7.0, 5.0, 6.0]),
        for_ever_yaw=np.asarray([0.3, 0.2, 0.4]),
        nominal=np.asarray([19.0, 20.0, 190.0]),
    )
    bounds = calibrate_corridor(reference, new, level=0.5)
    units = {"followed_position": 1.0, "followed_yaw": 19.0, "nominal": 190.0}
    assert sorted(bounds) == sorted(_corridor_claims.MEASURED)
    assert {name: bounds[name] for name in units} == pytest.approx(
        {name: 2.0 * unit for name, unit in units.items()}
    )
    assert (bounds["for_ever_position"], bounds["for_ever_yaw"]) == (6.0, 0.3)


def test_a_drive_on_its_bound_is_covered_and_one_that_leaves_any_bound_is_not():
    bounds = dict(zip(DriveScores._fields, (1.0, 2.0, 0.1, 0.1, 3.0), strict=True))
    inside = DriveScores(
        *(
            np.asarray([value, value, value, value, 0.0])
            for value in (1.0, 2.0, 9.0, 9.0, 3.0)
        )
    )
    for k, name in enumerate(_corridor_claims.JOINT):
        getattr(inside, name)[k] *= 1 + 1e-9
    actual = corridor_coverage(bounds, inside)
    assert actual == {
        "coverage": 0.4,
        "coverage_ci95": coverage_interval(0.4, 5),
        "coverage_trajectories": 5,
        "coverage_drives": 5,
    }


def test_scores_are_the_radii_of_every_output():
    random = np.random.default_rng(0)
    measured = Residuals(
        random.standard_normal((4, 7, 2)), np.abs(random.standard_normal((4, 7, 2)))
    )
    claims = {
        name: OutputMetric(0.5 + 0.1 * k, 2.0 + k, np.diag([1.0, 2.0 + k]), [])
        for k, name in enumerate(OUTPUTS)
    }
    nominal, beside = (
        np.arange(4.0),
        {name: np.full(4, 20.0 + k) for k, name in enumerate(OUTPUTS)},
    )
    for initial in (None, beside):
        scored = drive_scores(measured, claims, nominal, initial)
        for name in OUTPUTS:
            expected = radii(
                measured, name, claims[name], 0.0 if initial is None else initial[name]
            )
            np.testing.assert_array_equal(
                getattr(scored, f"followed_{name}"), expected.followed
            )
            np.testing.assert_array_equal(
                getattr(scored, f"for_ever_{name}"), expected.for_ever
            )
        np.testing.assert_array_equal(scored.nominal, nominal)


@pytest.mark.parametrize("constant", ["alpha", "lipschitz"])
def test_fixed_points_rest_on_what_is_proved(constant):
    with pytest.raises(Refuted, match="fixed_points"):
        _corridor_claims.require_corridor(
            corridor(), PROVED | {constant: 1.01 * PROVED[constant]}
        )
