"""The corridor: joint bounds, and a policy end to end."""

from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO

import jax
import numpy as np
import pytest
from helpers import TINY, any_law, path_space

from sfkd_jax import models, policy, store
from sfkd_jax.certificate import Boxes, Coverage, Provenance, read, write
from sfkd_jax.certification import measure, prove
from sfkd_jax.certification._measured import coverage_interval
from sfkd_jax.driving import drives
from sfkd_jax.driving.certificate import Bounds, DrivingCertificate
from sfkd_jax.driving.corridor import verify_driving
from sfkd_jax.driving.corridor._bounds import (
    ALONE,
    JOINT,
    calibrate_corridor,
    corridor_coverage,
)
from sfkd_jax.driving.corridor._closed_loop import closed_loop
from sfkd_jax.driving.corridor._measuring import measure_corridor
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.driving.plants import kinematic
from sfkd_jax.latency import Latency

NAMES = (*JOINT, *ALONE)


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
    expected = dict(zip(NAMES, [2.0, 38.0, 380.0, 6.0, 0.3], strict=True))
    assert vars(bounds) == pytest.approx(expected)


def test_a_run_on_its_bound_is_covered_and_one_that_leaves_any_bound_is_not():
    bounds = Bounds(**dict(zip(NAMES, (1.0, 2.0, 3.0, 0.1, 0.1), strict=True)))
    inside = np.tile([1.0, 2.0, 3.0, 9.0, 9.0], (5, 1))
    inside[range(3), range(3)] *= 1 + 1e-9
    assert corridor_coverage(bounds, inside) == Coverage(
        share=0.4, ci95=coverage_interval(0.4, 5), trajectories=5, runs=5
    )


# --- end to end, of an untrained policy: the claims do not depend on training ---------

BOX = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
DATA = BOX | {
    "seed": 0,
    "speed": (3.0, 12.0),
    "peak_curvature": 0.05,
    "wavelengths": (50.0, 200.0),
    "lateral_acceleration": 2.0,
    "law": {"model": "learned"},
    "acceleration": 2.0,
    "lateral_jerk": 7.0,
    "curvature_slope": 0.02,
    "steering_excitation": (0.002, 0.025),
    "speed_excitation": (0.05, 0.6),
}


def test_a_certificate_with_a_corridor_is_written_read_and_verified(tmp_path):
    """As `certify` makes it, with fewer and shorter runs."""
    options = TINY | {"frame": PATH_FRAME, "transport": False, "budget": "joint"}
    model = models.sfkd(path_space(), **options)
    params = model.init(jax.random.key(0))
    late = Latency((0.1,), (0.05,))
    noise = (0.015, 0.015, 0.002)
    loop = closed_loop(kinematic(), model, params, any_law(), noise, late)
    generate = drives.generate_along_path
    driven = jax.jit(
        lambda key: generate(loop.plant, key, segments=120, steps=20, **BOX)
    )(jax.random.key(1))
    validation, calibration, test = (
        jax.tree.map(lambda leaf, k=k: leaf[k::3], driven) for k in range(3)
    )
    body = np.asarray(driven.states, np.float64)[..., 3:].reshape(-1, 3)
    boxes = Boxes(
        state=(tuple(body.min(0).tolist()), tuple(body.max(0).tolist())),
        control=((-0.03, -1.0, -0.05, 3.0), (0.03, 1.0, 0.05, 12.0)),
        env=(BOX["env_low"], BOX["env_high"]),
    )
    proof = prove(model, params, boxes.env, validation=validation, attack_starts=0)
    measured = measure(
        model,
        params,
        proof,
        validation=validation,
        calibration=calibration,
        held_out=dict.fromkeys(("test", "uniform", "s3"), test),
        boxes=boxes,
        level=0.9,
    )
    small = {"runs": 24, "duration": 4.0, "attack_steps": 3000, "later": (0.1,)}
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(StringIO()) as said:
        patch.setattr("sfkd_jax.progress.APART", 0.0)
        corridor = measure_corridor(loop, proof.outputs, DATA, 0.9, **small)
    # A line after each part of the runs, with the steps of the vehicle so far: 16 parts
    # and the attack, and three parts each of the later sensors and controls.
    lines = said.getvalue().splitlines()
    assert len(lines) == 16 + 1 + 6
    assert "steps of the vehicle 2,880 / 66,360, " in lines[0]
    assert "steps of the vehicle 66,360 / 66,360, 0:00 left" in lines[-1]
    settings = {
        "space": path_space()._asdict(),
        "environment": {"low": BOX["env_low"], "high": BOX["env_high"]},
    }
    trained = policy.TrainedModel(
        model, params, kinematic(), any_law(), settings, "1" * 64, "0" * 64
    )
    certificate = DrivingCertificate(
        proof=proof,
        measured=measured,
        corridor=corridor,
        provenance=Provenance(
            policy_sha256="0" * 64,
            weights_sha256="1" * 64,
            versions=store.versions(),
            seconds=1.0,
        ),
    )
    write(tmp_path / "certificate.json", certificate)
    again = read(tmp_path / "certificate.json", DrivingCertificate)
    assert replace(again, sha256="") == certificate
    verify_driving(again, trained)
    assert measured.outputs.keys() == {"position", "yaw"}
    assert corridor.conditions.acceleration == 2.0
    assert again.corridor.conditions.latency == late.sized(4, 2)
    assert len(again.corridor.margins.delay_s) == len(again.corridor.margins.speed)
    for (later,) in (again.corridor.late_sensors, again.corridor.late_controls):
        assert later.later_s == 0.1
        assert later.corridor_m > later.bounds.nominal
    groups = corridor.by_group
    assert list(groups) == ["bends", "speeds", "lane_changes"]
    # The claim is that of the worst group.
    for kind, bound in vars(corridor.bounds).items():
        assert bound == max(getattr(of.bounds, kind) for of in groups.values())
    assert corridor.coverage in [of.coverage for of in groups.values()]
    assert corridor.coverage.share == min(of.coverage.share for of in groups.values())
    assert corridor.corridor_m == pytest.approx(
        corridor.bounds.nominal + corridor.bounds.vehicle_to_nominal_position
    )
