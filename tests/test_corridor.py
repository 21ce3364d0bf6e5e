"""The corridor of a policy, end to end.

The policy is untrained, because the claims do not depend on training.
"""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law
from test_path_policy import saved, settings

from sfkd_jax import build, policy
from sfkd_jax import data as datasets
from sfkd_jax.certification import (
    CertificationRefused,
    issue,
    output_metrics_from,
    verify_document,
)
from sfkd_jax.corridor import certify_corridor, corridor_by_speed, fastest_speeds
from sfkd_jax.plants import along_path, kinematic
from sfkd_jax.types import Trajectory

DRIVEN = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
SMALL = {"drives": 24, "duration": 4.0, "attack_steps": 3000}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("policy")
    saved(run_dir, law=any_law())
    return policy.restore(run_dir)


@pytest.fixture(scope="module")
def config():
    return settings("certification.level=0.9", "certification.attack_starts=1")


@pytest.fixture(scope="module")
def document(trained, config):
    """As `certify` makes it, with fewer and shorter drives."""
    loop = along_path(kinematic(), trained.law)
    make = jax.jit(
        lambda key: datasets.generate_along_path(
            loop, key, segments=120, steps=20, **DRIVEN
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
    options = {"level": 0.9, "monitor_level": 0.9, "attack_starts": 0}
    result = issue(
        trained.model,
        trained.params,
        **parts,
        held_out=held_out,
        boxes=boxes,
        **options,
    )
    result["corridor"] = certify_corridor(
        config, trained, output_metrics_from(result["outputs"]), **SMALL
    )
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
        (
            "corridor",
            "fixed_points",
            document["corridor"]["fixed_points"] | {"push": 0.0},
        ),
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


def test_what_is_claimed_is_one_sum_of_what_is_calibrated(document):
    result = document["corridor"]
    assert result["corridor_m"] == pytest.approx(
        result["bounds"]["nominal"] + result["bounds"]["followed_position"]
    )
    assert (
        result["bounds"]["followed_position"] <= result["bounds"]["for_ever_position"]
    )
    assert 0.6 <= result["coverage"] <= 1.0
    assert result["drives"] == SMALL["drives"]
    assert result["attack"]["over_tube"] <= 1.0


def test_without_a_copy_the_corridor_is_wider_and_no_drive_of_the_class_leaves_it(
    document,
):
    result, part = document["corridor"], document["corridor"]["fixed_points"]
    between, after = part["corridor_m"], part["after_switch_m"]
    assert (
        result["bounds"]["for_ever_position"]
        < between["law"]
        < between["planner"]
        < after["planner"]
    )
    assert after["law"] - between["law"] == pytest.approx(
        after["planner"] - between["planner"]
    )
    assert result["seen"]["lateral_m"] < part["after_switch_m"]["planner"]
    assert part["steps_between_switches"] == 30
    assert part["points"] == 3 * 3 * SMALL["drives"] * 2 * 25


def test_every_friction_and_speed_gets_a_corridor_of_its_own(document, trained):
    frictions, speeds = [0.3, 0.9], [8.0, 10.5]
    result = corridor_by_speed(
        trained, document, frictions=frictions, speeds=speeds, drives=24
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
        assert cell["coverage_drives"] == 24
    assert len({cell["corridor_m"] for cell in cells}) == 4
    assert result["coverage"] == pytest.approx(
        np.mean([cell["coverage"] for cell in cells])
    )
    assert result["coverage_ci95"][1] - result["coverage_ci95"][0] < 0.25
    alone = corridor_by_speed(
        trained, document, frictions=frictions[:1], speeds=speeds[:1], drives=24
    )
    assert alone["cells"] == cells[:1]


def test_speeds_and_frictions_outside_the_box_are_refused(document, trained):
    for name, values in (
        ("friction", {"frictions": [0.2], "speeds": [9.0]}),
        ("speed", {"frictions": [0.3], "speeds": [11.0]}),
    ):
        with pytest.raises(
            ValueError, match=f"{name} .* is outside the certified range"
        ):
            corridor_by_speed(trained, document, **values)


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


def test_the_same_seed_gives_the_same_corridor(document, trained, config):
    again = certify_corridor(
        config, trained, output_metrics_from(document["outputs"]), **SMALL
    )
    assert {**again, "seconds": 0.0} == {**document["corridor"], "seconds": 0.0}


def test_a_policy_without_a_law_has_no_corridor(trained, config, document):
    with pytest.raises(ValueError, match="with its law"):
        certify_corridor(
            config,
            trained._replace(law=None),
            output_metrics_from(document["outputs"]),
            **SMALL,
        )


def test_a_controller_with_a_corridor_is_shielded_if_shield_is_set(
    document, trained, config
):
    """And then a request beyond its limits is cut, the copy reported, and both are off
    without `shield`.
    """
    plant = kinematic()
    reference = jnp.column_stack(
        [jnp.arange(1, 21.0), jnp.zeros(20), jnp.zeros(20), jnp.full(20, 9.0)]
    )
    state = jnp.asarray([0.0, 0.0, 0.0, 9.0])
    for shield in (True, False):
        chosen = config["controller"] | {"shield": shield}
        chosen["mppi"] = chosen["mppi"] | {"num_samples": 4}
        built = build.build_controller(
            chosen,
            trained.model,
            plant,
            certificate=document,
            law=trained.law,
            **DRIVEN,
        )
        _, _, info = jax.jit(built.act)(
            trained.params,
            built.init(jax.random.key(0)),
            state,
            jnp.asarray([0.6, 0.0]),
            reference,
        )
        assert ("corridor" in info) == shield
        if shield:
            assert info["corridor"] == pytest.approx(
                document["corridor"]["corridor_m"], rel=1e-5
            )
            assert not info["outside_box"]


def test_what_sensors_add_is_no_part_of_the_recorded_perturbation(trained):
    """The recorded ν of a drive with sensors is the requested one, though the car moves
    differently.
    """
    loop = along_path(kinematic(), trained.law)
    config = {
        "drives": 2,
        "steps": 30,
        "offset": (0.0, 0.0, 0.0),
        "burn_in": 0,
        **DRIVEN,
    }

    def noisy(key, state, inputs, env):
        del state, inputs, env
        return jnp.asarray([0.01, 0.0]) * jax.random.normal(key, (2,))

    plain, seen = (
        jax.jit(
            lambda key, hook=hook: datasets.drive_switching(
                loop, key, sensors=hook, **config
            )
        )(jax.random.key(4))
        for hook in (None, noisy)
    )
    assert isinstance(plain, Trajectory)
    np.testing.assert_allclose(plain.controls, seen.controls, rtol=1e-5)
    assert float(jnp.max(jnp.abs(plain.states - seen.states))) > 1e-3
    np.testing.assert_array_equal(plain.states[:, 0, 3:5], np.zeros((2, 2)))


def test_a_filter_of_a_drive_sees_it_whole_and_its_answer_is_what_is_driven(trained):
    loop = along_path(kinematic(), trained.law)
    config = {"drives": 2, "steps": 30, "burn_in": 0, **DRIVEN}

    def halve(start, inputs, envs):
        assert (start.shape, inputs.shape, envs.shape) == ((6,), (30, 4), (30, 2))
        return inputs.at[:, :2].multiply(0.5)

    plain, cut = (
        jax.jit(
            lambda key, hook=hook: datasets.drive_switching(
                loop, key, safety_filter=hook, **config
            )
        )(jax.random.key(5))
        for hook in (None, halve)
    )
    np.testing.assert_allclose(
        cut.controls[..., :2], 0.5 * plain.controls[..., :2], rtol=1e-6
    )
    again = jax.vmap(jax.vmap(loop.step))(cut.states[:, :-1], cut.controls, cut.envs)
    np.testing.assert_allclose(again, cut.states[:, 1:], atol=1e-5)
