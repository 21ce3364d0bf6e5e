"""Naive predictors: exact where their assumption holds, and worse than a bicycle where
it does not.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law, dataset, jit

from sfkd_jax import build, evaluation, plants
from sfkd_jax.types import Trajectory

DT, HORIZON, STEPS = 0.1, 10, 20
PLANT = plants.kinematic()


def rolled(step, start, controls):
    """One trajectory of a step function, as a batch."""

    def advance(state, control):
        after = step(state, control, jnp.zeros(2))
        return after, after

    _, states = jit(partial(jax.lax.scan, advance))(start, controls)
    states = jnp.concatenate([start[None], states])
    envs = jnp.zeros((len(controls), 2))
    return jax.tree.map(lambda leaf: leaf[None], Trajectory(states, controls, envs))


def circle(yaw_rate, speed=8.0):
    """States on a circle at constant speed, exact."""
    t = DT * np.arange(STEPS + 1)
    yaw = 0.3 + yaw_rate * t
    h = 0.5 * yaw_rate * t
    chord = speed * t * np.sinc(h / np.pi)
    states = np.stack(
        [chord * np.cos(0.3 + h), chord * np.sin(0.3 + h), yaw, np.full_like(t, speed)],
        axis=1,
    )
    zeros = jnp.zeros((1, STEPS, 2))
    return Trajectory(jnp.asarray(states, dtype=jnp.float32)[None], zeros, zeros)


def errors(train, test, **options):
    options = {"nominal": PLANT.nominal, "dt": DT, "horizon": HORIZON} | options
    result = evaluation.baselines(train, **options)
    return {name: np.asarray(jit(rmse)(test)) for name, rmse in result.items()}


def test_constant_velocity_is_exact_on_a_straight_line_and_errs_on_a_circle():
    data = dataset().train
    straight = errors(data, circle(0.0))["constant_velocity"]
    np.testing.assert_allclose(straight, np.zeros((HORIZON, 4)), atol=1e-4)
    turning = errors(data, circle(0.5))["constant_velocity"]
    np.testing.assert_allclose(
        turning[:, 2], 0.05 * np.arange(1, HORIZON + 1), rtol=1e-3
    )
    assert turning[-1, 1] > 1.0


@pytest.mark.parametrize("yaw_rate", [-0.7, 0.0, 0.5])
def test_constant_turn_is_exact_on_a_circle(yaw_rate):
    rmse = errors(dataset().train, circle(yaw_rate))["constant_turn"]
    np.testing.assert_allclose(rmse, np.zeros((HORIZON, 4)), atol=2e-4)


def test_the_fit_finds_the_parameters_of_a_bicycle():
    true = evaluation._baselines.FittedBicycle(
        np.asarray([0.1, 0.8, -0.05]),
        np.asarray([0.01, 1 / 2.9]),
        np.asarray([0.02, 1.3]),
        True,
    )
    noise = jax.random.normal(jax.random.key(0), (400, 2)) * jnp.asarray([0.1, 1.0])
    start = jnp.asarray([0.0, 0.0, 0.2, 9.0])
    driven = rolled(evaluation.bicycle_step(true, dt=DT), start, noise)
    fitted = evaluation.fit_bicycle(driven, dt=DT)
    for result, wanted in zip(fitted[:3], true[:3], strict=True):
        np.testing.assert_allclose(result, wanted, rtol=2e-2, atol=2e-3)
    assert fitted.is_angle


def test_the_fitted_bicycle_errs_least_on_the_plant():
    data = dataset()
    rmse = {n: np.hypot(*e[-1, :2]) for n, e in errors(data.train, data.test).items()}
    assert min(rmse, key=rmse.get) == "fitted_bicycle"
    assert rmse["fitted_bicycle"] < 0.8 * rmse["constant_velocity"]


def test_controls_that_are_no_angles_are_fitted_linearly():
    """A robot whose first control is its curvature in 1/km."""

    def step(state, control, env):
        bicycle = evaluation._baselines.FittedBicycle(
            np.asarray([0.0, 1.0, 0.0]), np.asarray([0.0, 1e-3]), np.zeros(2), False
        )
        return evaluation.bicycle_step(bicycle, dt=DT)(state, control, env)

    noise = jax.random.normal(jax.random.key(1), (200, 2)) * jnp.asarray([30.0, 0.5])
    driven = rolled(step, jnp.asarray([0.0, 0.0, 0.0, 5.0]), noise)
    fitted = evaluation.fit_bicycle(driven, dt=DT)
    assert not fitted.is_angle
    np.testing.assert_allclose(fitted.curvature, [0.0, 1e-3], atol=1e-5)


def test_in_path_coordinates_a_straight_course_beside_a_straight_path_is_exact():
    coordinates = jnp.asarray([[0.0, 0.0, 0.0, 0.5, 0.0, 8.0]])
    states = jnp.tile(coordinates, (STEPS + 1, 1))[None]
    controls = jnp.tile(jnp.asarray([0.0, 0.0, 0.0, 8.0]), (1, STEPS, 1))
    data = Trajectory(states, controls, jnp.zeros((1, STEPS, 2)))
    loop = build.build_loop(PLANT, any_law(3))
    result = errors(data, data, nominal=loop.nominal, along_path=True)
    assert set(result) == {"constant_velocity", "constant_turn", "kinematic_bicycle"}
    for name in ("constant_velocity", "constant_turn"):
        np.testing.assert_allclose(result[name], np.zeros((HORIZON, 4)), atol=1e-4)
    bent = data._replace(controls=controls.at[..., 2].set(0.02))
    assert (
        errors(bent, bent, nominal=loop.nominal, along_path=True)["constant_velocity"][
            -1, 1
        ]
        > 0.1
    )


def test_a_horizon_longer_than_the_trajectories_is_refused():
    with pytest.raises(ValueError, match="a horizon of 26 steps does not fit"):
        errors(dataset().train, dataset().test, horizon=26)
