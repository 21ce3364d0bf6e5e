"""Violations counted where the count is known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, driven, jit

from sfkd_jax import models
from sfkd_jax.evaluation import ClaimedBounds, Predictions, predictions, violations
from sfkd_jax.rollout import sliding_windows
from sfkd_jax.types import Trajectory


def still(count=2, steps=12):
    """Cars that stand at the origin whatever they observe."""
    shapes = (count, steps + 1, 4), (count, steps, 2)
    return Trajectory(*map(jnp.zeros, shapes), jnp.ones((count, steps, 2)))


def drifting(*each):
    """A model that adds the same to every state."""
    return models.physics(lambda state, action, env: state + jnp.asarray(each))


def tube(position, yaw=9.0, body=9.0, horizon=4):
    radii = {"position_m": position, "yaw_rad": yaw, "body": body}
    return {name: [radius] * horizon for name, radius in radii.items()}


def predicted(model, params, data, **lengths):
    """Predictions as the host sees them."""
    return jax.device_get(jit(partial(predictions, model, **lengths))(params, data))


def test_windows_are_the_stretches_that_start_at_every_stride():
    one = at(driven(), 0)
    cut = sliding_windows(one, horizon=5, stride=3)
    assert len(cut.states) == 3  # from 0, 3, 6; the one from 9 does not fit 12 steps
    for index, start in enumerate((0, 3, 6)):
        stop = start + 5
        np.testing.assert_array_equal(cut.states[index], one.states[start : stop + 1])
        np.testing.assert_array_equal(cut.controls[index], one.controls[start:stop])
        np.testing.assert_array_equal(cut.envs[index], one.envs[start:stop])


def rates(errors=None, latent_errors=None, gaps=None, **claims):
    """Violations of predictions of which only a part matters."""
    shape = np.shape(latent_errors if errors is None else errors)[:3]
    given = np.zeros((*shape, 3)) if errors is None else errors
    latent = np.zeros(shape) if latent_errors is None else latent_errors
    gaps = np.zeros(shape) if gaps is None else gaps
    return violations(Predictions(given, latent, gaps), ClaimedBounds(**claims))


def test_a_segment_leaves_its_tube_if_any_window_step_or_kind_does():
    errors = np.zeros((5, 2, 4, 3))
    errors[1, 1, 3, 0], errors[2, 0, 0, 1], errors[3, 1, 2, 2] = 1.01, 0.21, np.nan
    errors[4] = [1.0, 0.2, 3.0]  # on the edge
    assert rates(errors, certified=tube(1.0, 0.2, 3.0))["v1"] == 0.6
    assert rates(errors, certified=tube(2.0, 0.2, 3.0))["v1"] == 0.4


def test_a_constant_drift_errs_by_its_multiples_and_leaves_tubes_below_them():
    model, steps = drifting(0.3, 0.4, 1.0, 0.5), np.arange(1.0, 5.0)
    errors = predicted(model, {}, still(steps=20), length=10, horizon=4).errors
    assert errors.shape[0] == 4
    # The yaw is wrapped.
    columns = [0.5 * steps, np.minimum(steps, 2 * np.pi - steps), 0.5 * steps]
    expected = np.broadcast_to(np.stack(columns, axis=1), errors.shape)
    np.testing.assert_allclose(errors, expected, rtol=1e-5)
    for size, rate in ((2.0001, 0.0), (1.9999, 1.0)):
        growing = {"position_m": [0.5001, 1.0001, 1.5001, size]}
        assert rates(errors, certified=tube(0.0) | growing)["v1"] == rate


def test_windows_beyond_the_common_threshold_are_counted_by_window():
    errors = np.zeros((2, 3, 4, 3))
    errors[0, 0, 1, 0], errors[1, 2, 3, 0], errors[1, 1, 0, 1] = 1.1, np.inf, 9.0
    assert rates(errors, threshold=1.0)["v2"] == 2 / 6
    assert rates(errors, threshold=1.2)["v2"] == 1 / 6


def theorem(latent_errors, gaps, latent, d_bar):
    """V0 and the largest error over its bound."""
    found = rates(None, latent_errors, gaps, latent=latent, d_bar=d_bar)
    return found["v0"], found["v0_ratio"]


def test_the_theorem_is_only_asked_about_steps_up_to_the_first_large_defect():
    gaps, lost = np.asarray([[[0.1, 0.1, 0.3, 0.1]]]), np.full((1, 1, 4), np.nan)
    errors = np.asarray([[[0.5, 0.0, 9.0, 9.0]]])
    assert theorem(errors, gaps, np.full(4, 0.4), 0.2) == (0.5, pytest.approx(1.25))
    assert theorem(errors, gaps, np.full(4, 0.6), 0.2)[0] == 0.0
    assert theorem(lost, gaps, np.full(4, 0.6), 0.2) == (1.0, None)
    assert theorem(errors, gaps, np.full(4, 0.4), 0.05) == (None, None)


def radii(alpha, d_bar, horizon):
    return d_bar * (1 - alpha ** np.arange(1, horizon + 1)) / (1 - alpha)


def test_defects_that_all_point_one_way_fill_the_tube_of_a_linear_model():
    """s⁺ = α s beside the truth s⁺ = α s + d̄: |e_k| = R_k, so any smaller radius is
    left at every step.
    """
    alpha, d_bar, horizon = 0.93, 0.2, 10
    model = models.physics(lambda state, action, env: state.at[3].multiply(alpha))
    speeds = [1.0]
    for _ in range(20):
        speeds.append(alpha * speeds[-1] + d_bar)
    data = still(count=1, steps=20)
    data = data._replace(states=data.states.at[0, :, 3].set(jnp.asarray(speeds)))
    result = predicted(model, {}, data, length=20, horizon=horizon)
    bound = radii(alpha, d_bar, horizon)
    np.testing.assert_allclose(result.latent_errors[0, 0], bound, rtol=1e-5)
    for size, rate in ((1.0, 0.0), (1.0 - 1e-3, 1.0)):
        measured = result.latent_errors, result.defects, size * bound, d_bar + 1e-6
        assert theorem(*measured)[0] == rate


def test_what_is_not_claimed_or_not_predicted_is_null():
    errors = np.zeros((4, 1, 4, 3))
    errors[0, 0, 3, 0] = 1.5
    result = Predictions(errors, np.full((4, 1, 4), 0.3), np.full((4, 1, 4), 0.1))
    claims = ClaimedBounds(tube(2.0), np.asarray([0.2, 0.4, 0.4, 0.4]), 0.1, 1.4)
    rates = {"v0": 0.25, "v0_ratio": pytest.approx(1.5), "v1": 0.0, "v2": 0.25}
    assert violations(result, claims) == rates | {"v1_radius_m": 2.0}
    nothing = dict.fromkeys(rates)
    assert violations(None, claims) == nothing | {"v1_radius_m": 2.0}
    assert violations(result, ClaimedBounds()) == nothing | {"v1_radius_m": None}
