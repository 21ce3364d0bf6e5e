"""Tubes of measured errors: exact cases, and coverage on exchangeable drives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven, jit, model_and_params

from sfkd_jax import models
from sfkd_jax.certification import clopper_pearson, conformal_tube, physical_tube
from sfkd_jax.certification._calibration import conformal_quantile
from sfkd_jax.evaluation import tube_violations
from sfkd_jax.rollout import window_errors
from sfkd_jax.types import Trajectory

OPTIONS = {"level": 0.9, "horizon": 4, "stride": 2}
STAYS = models.physics(lambda state, action, env: state)


def random_walks(count, seed, steps=8):
    """Random walks of the state, each with its own spread: heavy tails, one
    distribution.
    """
    random = np.random.default_rng(seed)
    spread = random.standard_exponential((count, 1, 1)) * np.asarray(
        [0.3, 0.3, 0.02, 1.0]
    )
    states = np.cumsum(spread * random.standard_normal((count, steps + 1, 4)), axis=1)
    rest = jnp.zeros((count, steps, 2))
    return Trajectory(jnp.asarray(states, dtype=jnp.float32), rest, rest)


def tube_of(model=STAYS, validation=None, calibration=None, params=None, **changes):
    validation = random_walks(40, 1) if validation is None else validation
    calibration = random_walks(39, 2) if calibration is None else calibration
    return conformal_tube(
        model,
        params or {},
        validation=validation,
        calibration=calibration,
        **OPTIONS | changes,
    )


def errors(model, data):
    one = partial(window_errors, model, {}, horizon=4, stride=2)
    return np.asarray(jit(jax.vmap(one))(data))


def as_array(tube):
    return np.stack([tube[kind] for kind in ("position_m", "yaw_rad", "body")], axis=1)


def test_a_model_that_always_errs_alike_gets_its_error_as_radius():
    model = models.physics(
        lambda state, action, env: state + jnp.asarray([0.3, 0.4, -0.1, 2.0])
    )
    still = Trajectory(
        jnp.zeros((20, 9, 4)), jnp.zeros((20, 8, 2)), jnp.zeros((20, 8, 2))
    )
    radii = as_array(tube_of(model, still, still))
    np.testing.assert_allclose(
        radii, np.arange(1, 5)[:, None] * np.asarray([0.5, 0.1, 2.0]), rtol=1e-5
    )


def test_radii_are_units_of_the_validation_drives_times_the_calibration_quantile():
    seen, fresh = errors(STAYS, random_walks(40, 1)), errors(STAYS, random_walks(39, 2))
    units = np.quantile(seen, 0.95, axis=(0, 1))
    scores = np.sort(np.max(fresh / units, axis=(1, 2, 3)))
    np.testing.assert_allclose(
        as_array(tube_of()), units * scores[35], rtol=1e-5
    )  # ⌈40 · 0.9⌉ = 36th smallest
    outside, _ = tube_violations(fresh, tube_of())
    assert outside in (3, 4)  # 39 − 36, and the one on the edge may be rounded out


def test_a_new_drive_stays_inside_as_often_as_the_level_says():
    """Coverage given the calibration set is Beta-distributed around the level; nearly
    all within ± 0.05 for n = 399.
    """
    tube = tube_of(calibration=random_walks(399, 3))
    outside, total = tube_violations(errors(STAYS, random_walks(600, 4)), tube)
    low, high = clopper_pearson(total - outside, total, level=0.99)
    assert low - 0.05 <= 0.9 <= high + 0.05
    assert 0 < outside < total


def test_levels_are_nested():
    wide, narrow = (as_array(tube_of(level=level)) for level in (0.95, 0.5))
    assert np.all(wide > narrow)


def test_it_has_the_parts_of_the_certified_tube():
    names = {"position": 1.0, "yaw": 1.0, "body": 1.0}
    certified = physical_tube(
        np.ones(4), alpha=0.5, lipschitz=names, residual=names, largest_increment=1.0
    )
    assert {kind: len(radii) for kind, radii in tube_of().items()} == {
        kind: 4 for kind in certified
    }


def test_a_model_that_never_errs_gets_the_resolution_of_the_numbers_and_not_zero():
    model, params = model_and_params("oracle")
    tube = tube_of(model, driven(), driven(), params, level=0.5)
    np.testing.assert_allclose(as_array(tube), np.tile([1e-3, 1e-4, 1e-3], (4, 1)))


def test_a_trained_kind_of_model_is_measured_like_any_other():
    model, params = model_and_params("sfkd")
    tube = as_array(tube_of(model, driven(), driven(), params, level=0.5))
    assert tube.shape == (4, 3)
    assert np.all(np.isfinite(tube) & (tube > 1e-3))


@pytest.mark.parametrize(
    ("count", "level", "rank"),
    [(9, 0.9, 9), (10, 0.9, 10), (19, 0.9, 18), (19, 0.5, 10)],
)
def test_the_quantile_is_an_order_statistic(count, level, rank):
    scores = np.random.default_rng(0).permutation(np.arange(1.0, count + 1))
    assert conformal_quantile(scores, level) == rank


def test_too_few_drives_for_the_level_are_refused():
    with pytest.raises(
        ValueError, match=r"18 calibration trajectories are too few for level 0\.95"
    ):
        tube_of(calibration=random_walks(18, 2), level=0.95)
    tube_of(calibration=random_walks(19, 2), level=0.95)


@pytest.mark.parametrize("split", ["validation", "calibration"])
def test_errors_that_are_not_finite_are_refused(split):
    data = random_walks(39, 2)
    with pytest.raises(ValueError, match="not finite"):
        tube_of(**{split: data._replace(states=data.states.at[5, 3, 0].set(jnp.nan))})


def test_a_horizon_that_does_not_fit_is_refused():
    with pytest.raises(
        ValueError, match="a horizon of 9 steps does not fit trajectories of 8 steps"
    ):
        tube_of(horizon=9)
