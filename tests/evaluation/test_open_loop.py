"""Open-loop errors of known models, and naive predictors where they are exact."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law, dataset, driven, jit, model_and_params

from sfkd_jax import build, evaluation, plants
from sfkd_jax.evaluation._open_loop import FittedBicycle
from sfkd_jax.types import Trajectory

DT, HORIZON, STEPS = 0.1, 10, 20
PLANT = plants.kinematic()


def errors_of(name, data, horizon):
    model, params = model_and_params(name)
    return np.asarray(
        jit(partial(evaluation.open_loop, model, horizon=horizon))(params, data)
    )


def test_the_true_plant_has_no_error_and_a_wrong_model_more_the_further_it_looks():
    exact = errors_of("oracle", driven(), 12)
    np.testing.assert_allclose(exact, np.zeros((12, 4)), atol=2e-5)
    result = errors_of("nominal", driven(), 12)
    assert np.all(result[:, :3] > 0)
    assert np.all(np.diff(result[:, 1]) > 0)
    assert result[-1, 1] > 5 * result[0, 1]
    with pytest.raises(ValueError, match="13 steps does not fit trajectories of 12"):
        errors_of("oracle", driven(), 13)


def test_errors_along_and_across_mean_the_same_on_every_heading():
    data = driven()
    turn = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    states = data.states.at[..., :2].set(data.states[..., :2] @ turn.T)
    turned = data._replace(states=states.at[..., 2].add(jnp.pi / 2))
    np.testing.assert_allclose(
        errors_of("nominal", turned, 12), errors_of("nominal", data, 12), atol=1e-4
    )


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
    h = 0.5 * yaw_rate * t
    chord = speed * t * np.sinc(h / np.pi)
    x, y = chord * np.cos(0.3 + h), chord * np.sin(0.3 + h)
    states = np.stack([x, y, 0.3 + yaw_rate * t, np.full_like(t, speed)], axis=1)
    zeros = jnp.zeros((1, STEPS, 2))
    return Trajectory(jnp.asarray(states, dtype=jnp.float32)[None], zeros, zeros)


def errors(test, **options):
    options = {"nominal": PLANT.nominal, "dt": DT, "horizon": HORIZON} | options
    result = evaluation.baselines(dataset().train, **options)
    return {name: np.asarray(jit(rmse)(test)) for name, rmse in result.items()}


def test_on_a_circle_a_constant_turn_is_exact_and_a_constant_velocity_is_not():
    result = errors(circle(0.5))
    nothing = np.zeros((HORIZON, 4))
    np.testing.assert_allclose(result["constant_turn"], nothing, atol=2e-4)
    turning, missed = result["constant_velocity"], 0.05 * np.arange(1, HORIZON + 1)
    np.testing.assert_allclose(turning[:, 2], missed, rtol=1e-3)
    assert turning[-1, 1] > 1.0
    straight = errors(circle(0.0))["constant_velocity"]
    np.testing.assert_allclose(straight, nothing, atol=1e-4)


@pytest.mark.parametrize(
    ("curvature", "slip", "spread", "is_angle"),
    [
        ([0.01, 1 / 2.9], [0.02, 1.3], [0.1, 1.0], True),
        ([0.0, 1e-3], [0.0, 0.0], [30.0, 0.5], False),
    ],
)
def test_the_fit_finds_the_parameters_of_a_bicycle(curvature, slip, spread, is_angle):
    """The second is a robot whose first control is its curvature in 1/km."""
    given = ([0.1, 0.8, -0.05], curvature, slip)
    true = FittedBicycle(*map(np.asarray, given), is_angle, DT)
    noise = jax.random.normal(jax.random.key(0), (400, 2)) * jnp.asarray(spread)
    data = rolled(true.step, jnp.asarray([0.0, 0.0, 0.2, 9.0]), noise)
    fitted = FittedBicycle.fit(data, dt=DT)
    assert fitted.is_angle is is_angle
    for name in ("acceleration", "curvature", "slip"):
        result, wanted = getattr(fitted, name), getattr(true, name)
        np.testing.assert_allclose(result, wanted, rtol=2e-2, atol=2e-3)


def test_the_fitted_bicycle_errs_least_on_the_plant():
    rmse = {name: np.hypot(*e[-1, :2]) for name, e in errors(dataset().test).items()}
    assert min(rmse, key=rmse.get) == "fitted_bicycle"
    assert rmse["fitted_bicycle"] < 0.8 * rmse["constant_velocity"]


def test_in_path_coordinates_a_straight_course_beside_a_straight_path_is_exact():
    coordinates = jnp.asarray([[0.0, 0.0, 0.0, 0.5, 0.0, 8.0]])
    states = jnp.tile(coordinates, (STEPS + 1, 1))[None]
    controls = jnp.tile(jnp.asarray([0.0, 0.0, 0.0, 8.0]), (1, STEPS, 1))
    data = Trajectory(states, controls, jnp.zeros((1, STEPS, 2)))
    loop = {"nominal": build.build_loop(PLANT, any_law(3)).nominal, "along_path": True}
    result = errors(data, **loop)
    assert set(result) == {"constant_velocity", "constant_turn", "kinematic_bicycle"}
    for name in ("constant_velocity", "constant_turn"):
        np.testing.assert_allclose(result[name], np.zeros((HORIZON, 4)), atol=1e-4)
    bent = data._replace(controls=controls.at[..., 2].set(0.02))
    assert errors(bent, **loop)["constant_velocity"][-1, 1] > 0.1
