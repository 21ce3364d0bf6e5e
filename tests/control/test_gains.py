"""Feedback gains of a plan: exact where the answer is known, finite where it is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import control, models, plants

A = jnp.asarray([[1.0, 0.1], [0.0, 1.0]])
B = jnp.asarray([[0.0], [0.1]])
LQ = control.free_task(
    lambda params, x, u, e: A @ x + B @ u,
    lambda weights, x, u, before, target: jnp.sum(x**2) + 0.1 * jnp.sum(u**2),
    num_controls=1,
)
START = jnp.asarray([0.3, -0.2])
NOTHING = jnp.zeros(0)


def step(task, observation, **settings):
    options = {"num_samples": 256, "horizon": 8, "noise_std": (0.5,)}
    controller = control.mppi(task, **(options | settings))
    state = controller.init(jax.random.key(0))
    return jax.jit(controller.act)({}, state, observation, NOTHING, ())


@pytest.mark.parametrize("several", [False, True])
def test_gains_are_the_derivative_of_the_control_by_the_observation(several):
    """Finite differences of the whole control step, with the temperature held."""
    options = {"temperature": 2.0, "gain_samples": 256}
    env = jnp.zeros((3, 1)) if several else NOTHING

    def control_at(observation):
        planned = control.mppi(
            LQ, num_samples=256, horizon=8, noise_std=(0.5,), **options
        )
        state = planned.init(jax.random.key(0))
        return planned.act({}, state, observation, env, ())

    control_at = jax.jit(control_at)
    gains = control_at(START)[2]["gains"]
    assert gains.shape == (1, 2)
    for column, direction in enumerate(1e-2 * jnp.eye(2)):
        ahead, behind = (control_at(START + sign * direction)[0] for sign in (1, -1))
        np.testing.assert_allclose(
            (ahead - behind) / 2e-2, gains[:, column], rtol=2e-2, atol=1e-3
        )


def test_gains_of_a_cold_planner_tend_to_those_of_the_regulator():
    """Many samples, many iterations and a low temperature: the finite-horizon LQ gain."""
    horizon, effort = 8, 0.1
    cost = np.eye(2)
    for left in range(horizon):
        gain = np.linalg.solve(effort * np.eye(1) + B.T @ cost @ B, B.T @ cost @ A)
        closed = A - B @ gain
        after = np.zeros((2, 2)) if left == horizon - 1 else np.eye(2)
        cost = after + effort * gain.T @ gain + closed.T @ cost @ closed
    info = step(
        LQ,
        START,
        num_samples=20_000,
        noise="white",
        noise_std=(1.0,),
        temperature=0.1,
        gain_samples=20_000,
    )[2]
    np.testing.assert_allclose(info["gains"], -gain, rtol=0.25)


def test_the_feedback_law_of_a_task_is_part_of_the_gains():
    """Along a path, by finite differences; the law's gain is most of it."""
    plant = plants.kinematic()
    task = control.path_tracking(
        models.physics(plant.step),
        control.tracking_cost(dt=plant.dt),
        control.path_feedback(wheelbase=plant.wheelbase),
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
    )
    planned = control.mppi(task, num_samples=64, temperature=500.0, gain_samples=64)
    ahead = jnp.arange(1, 21.0)
    reference = jnp.stack([ahead, 0 * ahead, 0 * ahead, 10.0 + 0 * ahead], axis=1)
    start = (
        jnp.zeros(len(plant.state_names))
        .at[jnp.asarray([1, 2, 3])]
        .set(jnp.asarray([0.1, 0.02, 9.5]))
    )
    act = jax.jit(
        lambda x: planned.act(
            {}, planned.init(jax.random.key(0)), x, jnp.asarray([0.6, 2.0]), reference
        )
    )
    gains = act(start)[2]["gains"]
    for column in range(4):
        moved = 1e-2 * jnp.eye(start.size)[column]
        slope = (act(start + moved)[0] - act(start - moved)[0]) / 2e-2
        np.testing.assert_allclose(gains[:, column], slope, rtol=0.03, atol=5e-3)
    assert gains[0, 1] < -0.02


def lane(data, x, u, target, at):
    return jnp.abs(x[:1]) - data


def test_gains_beside_a_constraint_are_those_of_the_samples_that_keep_it():
    """Finite differences small enough that no sample changes its side."""
    planned = control.mppi(
        control.constrained(LQ, lane, 0.31),
        num_samples=256,
        horizon=8,
        noise_std=(3.0,),
        temperature=2.0,
        gain_samples=256,
    )
    act = jax.jit(
        lambda x: planned.act({}, planned.init(jax.random.key(0)), x, NOTHING, ())
    )
    _, _, info = act(START)
    assert info["constraints_kept"]
    moved = jnp.asarray([0.0, 1e-4])
    slope = (act(START + moved)[0] - act(START - moved)[0]) / 2e-4
    np.testing.assert_allclose(info["gains"][:, 1], slope, rtol=0.1)
    assert abs(info["gains"][0, 1]) > 0.05


@pytest.mark.parametrize("kind", [control.cem, control.gradient_planner])
def test_a_search_without_a_temperature_is_refused(kind):
    planned = kind(LQ, horizon=6, noise_std=(1.0,), gain_samples=8)
    state = planned.init(jax.random.key(0))
    with pytest.raises(ValueError, match="gain_samples needs a search"):
        planned.act({}, state, START, NOTHING, ())


def test_between_plans_a_control_follows_the_gains_within_the_limits():
    given = {
        "planned_from": jnp.asarray([0.0, 3.1]),
        "predicted": jnp.asarray([1.0, -3.1]),
        "fraction": 0.5,
        "control_low": (-1.0,),
        "control_high": (1.0,),
        "angles": (1,),
    }
    gains = jnp.asarray([[0.5, 2.0]])
    half_way = jnp.asarray([0.5, jnp.pi])
    act = lambda observation: control.between_plans(
        jnp.asarray([0.2]), gains, observation=observation, **given
    )
    np.testing.assert_allclose(act(half_way), [0.2], atol=1e-6)
    np.testing.assert_allclose(
        act(half_way + jnp.asarray([0.2, 0.1])), [0.5], atol=1e-6
    )
    np.testing.assert_allclose(act(half_way + jnp.asarray([9.0, 0.0])), [1.0])
    np.testing.assert_allclose(act(half_way.at[0].set(jnp.nan)), [0.2], atol=1e-6)
