"""A shipped policy on a car with latency: it drives, says so, and claims what holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

import sfkd_jax
from sfkd_jax import assembly, policy
from sfkd_jax.driving import simulation
from sfkd_jax.driving.scenarios import Scenario

LATENCY = sfkd_jax.Latency((0.06,), (0.04,))
"""As long as the laws that ship tolerate, and in parts of a period."""


@pytest.fixture(scope="module")
def late():
    return sfkd_jax.load("kinematic_path", latency=LATENCY)


def episode(policy, latency, seconds=15.0):
    """On S3, whose friction and wind switch every 3 s; the car has this latency."""
    family = assembly.build_scenario(
        {"name": "s3", "speed": 10.0}, policy.vehicle, duration=seconds
    )
    scenario: Scenario = family(jax.random.key(3))
    drive = jit(
        lambda key: simulation.simulate(
            policy.vehicle.step,
            policy.controller,
            policy.params,
            scenario._replace(observed_envs=scenario.envs),
            key,
            dt=policy.vehicle.dt,
            horizon=policy.interface["horizon"],
            observation_noise=policy.vehicle.sensor_noise,
            latency=latency,
            record={"claim": lambda info: info.claim, "gate": lambda info: info.gate},
        )
    )
    return jax.tree.map(np.asarray, drive(jax.random.key(4)))


def test_it_follows_its_path_and_claims_the_corridor_of_its_latency(late):
    driven = episode(late, LATENCY)
    distance = np.abs(driven.lateral)
    claim = driven.signals["claim"]
    assert (claim.reason == sfkd_jax.Reason.CERTIFIED).mean() > 0.95
    assert (distance <= claim.bound)[np.isfinite(claim.bound)].all()
    (row, *_) = late.certificate.corridor.late_controls
    np.testing.assert_allclose(claim.bound[-1], row.corridor_m, rtol=1e-3)
    assert (driven.signals["gate"].later == 0.0).all()


def test_a_latency_that_nobody_stated_is_found_and_compensated():
    on_time = sfkd_jax.load("kinematic_path")
    driven = episode(on_time, sfkd_jax.Latency((), (0.2,)))
    later = driven.signals["gate"].later
    claim = driven.signals["claim"]
    assert (later[100:] == 2.0).all()
    assert np.abs(driven.lateral).max() < 0.5
    # The claim ends, and comes back as that of this latency.
    (_, row, _) = on_time.certificate.corridor.late_controls
    assert claim.bound[0] < row.corridor_m
    assert np.isnan(claim.bound[(later[1:] != later[:-1]).nonzero()[0] + 1]).all()
    np.testing.assert_allclose(claim.bound[-1], row.corridor_m, rtol=1e-3)


def test_of_a_car_that_is_less_late_than_stated_a_corridor_is_claimed_as_well():
    stated = sfkd_jax.load("kinematic_path", latency=sfkd_jax.Latency((), (0.2,)))
    driven = episode(stated, sfkd_jax.Latency())
    later = driven.signals["gate"].later
    claim = driven.signals["claim"]
    assert (later[100:] == -2.0).all()
    corridor = stated.certificate.corridor
    np.testing.assert_allclose(claim.bound[-1], corridor.corridor_m, rtol=1e-3)
    assert claim.bound[0] > corridor.late_controls[1].corridor_m - 1e-3


def test_of_a_latency_that_no_corridor_covers_nothing_is_claimed():
    later = sfkd_jax.load("kinematic_path", latency=sfkd_jax.Latency((0.5,)))
    state = later.controller.init(jax.random.key(0))
    points = jnp.stack(
        [jnp.arange(1.0, 26.0), *[jnp.zeros(25)] * 2, jnp.full(25, 10.0)]
    )
    seen = jnp.asarray([0.0, 0.0, 0.0, 10.0])
    env = jnp.asarray([0.5, 0.0])
    act = jit(later.controller.act)
    _, _, info = act(later.params, state, seen, env, points.T)
    assert info.claim.reason == sfkd_jax.Reason.NOT_CALIBRATED
    assert "latency" in sfkd_jax.Reason.NOT_CALIBRATED.advice


def test_it_says_what_is_late_and_reads_the_road_until_its_command_acts(late):
    assert "latency, compensated: sensors 0.06 s, controls 0.04 s" in repr(late)
    assert late.interface["horizon"] == 21
    assert late.interface["latency_s"]["sensors"]["yaw"] == 0.06
    assert late.interface["latency_s"]["controls"]["steering"] == 0.04
    on_time = sfkd_jax.load("kinematic_path")
    assert on_time.interface["horizon"] == 20
    assert "latency" not in repr(on_time)


def test_a_reference_without_these_points_is_refused(late):
    state = late.controller.init(jax.random.key(0))
    points = jnp.stack([jnp.arange(1.0, 21.0), *[jnp.zeros(20)] * 3], axis=1)
    with pytest.raises(ValueError, match="reference must have shape"):
        late.controller.act(
            late.params, state, jnp.zeros(4), jnp.asarray([0.5, 0.0]), points
        )


def test_delays_of_another_number_of_sensors_are_refused():
    with pytest.raises(ValueError, match=r"latency\.sensors needs one number or 4"):
        sfkd_jax.load("kinematic_path", latency=sfkd_jax.Latency((0.1, 0.2), ()))
    with pytest.raises(ValueError, match="latency needs a model in path coordinates"):
        sfkd_jax.load("kinematic", latency=LATENCY)


@pytest.mark.parametrize(
    ("vehicle", "latency"),
    [("kinematic", None), ("kinematic_path", None), ("kinematic_path", LATENCY)],
)
def test_a_horizon_without_a_curvature_is_refused(vehicle, latency):
    saved = sfkd_jax.load(vehicle).settings["controller"]
    search = saved["mppi"] | {"horizon": 1}
    with pytest.raises(ValueError, match=r"controller\.mppi\.horizon=1 is too short"):
        sfkd_jax.load(vehicle, controller=saved | {"mppi": search}, latency=latency)


def test_the_shortest_horizon_drives_with_a_latency():
    saved = sfkd_jax.load("kinematic_path").settings["controller"]
    search = saved["mppi"] | {"horizon": 2, "num_samples": 20}
    short = sfkd_jax.load(
        "kinematic_path", controller=saved | {"mppi": search}, latency=LATENCY
    )
    points = jnp.zeros((short.interface["horizon"], 4)).at[:, 3].set(10.0)
    points = points.at[:, 0].set(jnp.arange(1.0, 1.0 + len(points)))
    control, _, info = jit(short.controller.act)(
        short.params,
        short.controller.init(jax.random.key(0)),
        jnp.asarray([0.0, 0.0, 0.0, 10.0]),
        jnp.asarray([0.5, 0.0]),
        points,
    )
    assert np.isfinite(control).all()
    assert np.isfinite(info.claim.bound)


def test_an_export_states_its_latency_to_whoever_loads_it(late, tmp_path):
    """Its programs compensate it, so its policy must not drive without."""
    settings = late.settings | {
        "controller": late.settings["controller"] | {"shield": False}
    }
    policy.save(tmp_path / "policy.safetensors", late.weights, settings, law=late.law)
    with pytest.warns(UserWarning, match="nothing is certified"):
        again = sfkd_jax.load(tmp_path)
    assert again.latency == late.latency
    assert again.interface == late.interface
    for wrong in ({"sensors": [0.1, "x"]}, {"of": [0.1]}, {"controls": [-1.0]}):
        forged = settings | {"latency": wrong}
        policy.save(tmp_path / "policy.safetensors", late.weights, forged, law=late.law)
        with pytest.raises(sfkd_jax.ArtefactError):
            sfkd_jax.load(tmp_path)
