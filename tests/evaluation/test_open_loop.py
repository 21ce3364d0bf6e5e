"""Open-loop errors of known models, and naive predictors where they are exact."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import dataset, driven, jit, model_and_params

from sfkd_jax import evaluation, models
from sfkd_jax.driving import plants
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.experiment.identified import least_squares
from sfkd_jax.types import Trajectory

DT = 0.1


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
    with pytest.raises(ValueError, match="13 steps do not fit trajectories of 12"):
        errors_of("oracle", driven(), 13)


def test_errors_along_and_across_mean_the_same_on_every_heading():
    data = driven()
    turn = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    states = data.states.at[..., :2].set(data.states[..., :2] @ turn.T)
    turned = data._replace(states=states.at[..., 2].add(jnp.pi / 2))
    np.testing.assert_allclose(
        errors_of("nominal", turned, 12), errors_of("nominal", data, 12), atol=1e-4
    )


def test_least_squares_errs_less_than_the_nominal_bicycle():
    data, horizon = dataset(), 10
    both = [
        jit(partial(evaluation.open_loop, models.physics(step), horizon=horizon))(
            {}, data.test
        )
        for step in (least_squares(data), plants.kinematic().nominal)
    ]
    ours, nominal = (np.hypot(*np.asarray(each)[-1, :2]) for each in both)
    assert ours < 0.9 * nominal


def test_without_a_pose_the_errors_are_those_of_the_body():
    data = Trajectory(*map(jnp.zeros, [(1, 11, 6), (1, 10, 4), (1, 10, 2)]))
    drift = jnp.asarray([0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
    model = models.physics(lambda x, u, e: x + drift, frame=PATH_FRAME)
    errors = jit(partial(evaluation.open_loop, model, horizon=5))({}, data)
    steps = np.arange(1.0, 6.0)[:, None]
    expected = steps * np.asarray([0.1, 0.2, 0.3])
    np.testing.assert_allclose(errors, expected, rtol=1e-5)
