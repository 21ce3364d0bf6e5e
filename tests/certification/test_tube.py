"""Tubes from α and d̄: the formula, the paper's erratum, and simulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import certified, driven, jit, model_and_params

from sfkd_jax.certification import latent_tube
from sfkd_jax.certification._measured import residuals
from sfkd_jax.certification._tubes import tubes
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.rollout import rollout
from sfkd_jax.types import BODY_FRAME


@pytest.mark.parametrize(
    ("alpha", "d_bar"), [(0.9, 0.3), (0.5, 1.0), (0.0, 0.7), (0.995, 1e-3)]
)
def test_the_latent_tube_is_the_closed_formula(alpha, d_bar):
    exact = d_bar * (1 - alpha ** np.arange(1, 41)) / (1 - alpha)
    np.testing.assert_allclose(latent_tube(alpha, d_bar, 40), exact, rtol=1e-12)


def test_the_physical_tube_is_its_finite_sums():
    """R = 0, 2, 3: with increments, and the limits along a path."""
    given = {
        "alpha": 0.5,
        "lipschitz": {"position": 2.0, "yaw": 0.5, "body": 3.0},
        "one_step": {"latent": 2.0, "position": 0.1, "yaw": 0.01, "body": 0.2},
        "horizon": 3,
    }
    tube = tubes(**given, frame=BODY_FRAME, largest_increment=10.0).physical
    yaw = [0.01, 0.02 + 1.0, 0.03 + 2.5]
    np.testing.assert_allclose(tube["yaw_rad"], yaw)
    position = [0.1, 0.2 + 4.0 + 10 * yaw[0], 0.3 + 10.0 + 10 * (yaw[0] + yaw[1])]
    np.testing.assert_allclose(tube["position_m"], position)
    np.testing.assert_allclose(tube["body"], [0.2, 0.2 + 3.0, 0.2 + 4.5])
    along = tubes(**given, frame=PATH_FRAME, largest_increment=None)
    np.testing.assert_allclose(along.physical["position_m"], [0.1, 2.1, 3.1])
    assert along.ultimate == 4.0
    assert along.asymptotic == pytest.approx(
        {"position_m": 4.1, "yaw_rad": 1.01, "body": 6.2}
    )


def test_free_running_predictions_stay_inside_the_physical_tube():
    """Trajectories whose one-step disturbances are bounded as measured: position, yaw
    and body state for 12 steps, with a switch of the environment at every one of them.
    The theorem leaves no exception.
    """
    model, params = model_and_params("sfkd")
    data, proved = driven(24), certified("sfkd")
    errors = residuals(model, params, data)
    measured = dict(zip(errors.names, errors.largest().T, strict=True))
    each = jit(jax.vmap(lambda one: rollout(model, params, one).free))
    predicted = np.asarray(each(data))
    true = np.asarray(data.states)[:, 1:]
    position = np.linalg.norm(predicted[..., :2] - true[..., :2], axis=-1)
    yaw = np.abs(wrap_angle(jnp.asarray(predicted[..., 2] - true[..., 2])))
    body = np.linalg.norm(predicted[..., 3:] - true[..., 3:], axis=-1)
    moves = np.linalg.norm(np.diff(np.asarray(data.states)[..., :2], axis=1), axis=-1)
    for k in range(len(predicted)):
        tube = tubes(
            alpha=proved.alpha,
            lipschitz=proved.lipschitz,
            frame=BODY_FRAME,
            one_step={kind: float(measured[kind][k]) for kind in measured},
            horizon=12,
            largest_increment=float(moves[k].max()),
        ).physical
        for radii, error in zip(tube.values(), (position, yaw, body), strict=True):
            assert np.all(error[k] <= np.asarray(radii) + 2e-5)
