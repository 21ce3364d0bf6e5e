"""Savitzky-Golay smoothing: the filter's definition, and its use in the planner."""

from fractions import Fraction
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, jit, straight
from scipy.signal import savgol_filter

from sfkd_jax import control, evaluation, models, plants, scenarios

PLANT = plants.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
WIDE = {"control_low": (-1e3, -1e3), "control_high": (1e3, 1e3)}
HORIZON = 6
OFFSET = np.float32([0.0, 0.3, 0.0, 10.0])
ENV = np.float32([0.7, 3.0])
REFERENCE = straight(HORIZON)
WINDOWS = [(5, 2), (5, 0), (7, 3), (3, 1), (9, 4)]
LAWS = {
    "feedback": control.path_feedback(wheelbase=PLANT.wheelbase),
    "plain": control.no_feedback(),
}


# ---- the filter --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("window", "order", "numerators", "denominator"),
    [
        (5, 2, [-3, 12, 17, 12, -3], 35),
        (5, 3, [-3, 12, 17, 12, -3], 35),
        (7, 2, [-2, 3, 6, 7, 6, 3, -2], 21),
        (7, 4, [5, -30, 75, 131, 75, -30, 5], 231),
        (3, 1, [1, 1, 1], 3),
    ],
)
def test_the_filter_has_the_published_coefficients_exactly(
    window, order, numerators, denominator
):
    centre = control.savitzky_golay_weights(window=window, order=order)[window // 2]
    assert centre == [Fraction(numerator, denominator) for numerator in numerators]


@pytest.mark.parametrize(("window", "order"), WINDOWS)
def test_the_fit_is_the_orthogonal_projection_onto_polynomials(window, order):
    """H = Hᵀ = H² with trace order + 1, and H reproduces every power up to the order,
    exactly.
    """
    fit = np.array(control.savitzky_golay_weights(window=window, order=order))
    points = np.array([Fraction(i - window // 2) for i in range(window)])
    assert np.all(fit == fit.T)
    assert np.all(fit @ fit == fit)
    assert np.trace(fit) == order + 1
    for power in range(order + 1):
        assert np.all(fit @ points**power == points**power)


@pytest.mark.parametrize(("window", "order"), WINDOWS)
def test_a_plan_is_smoothed_as_the_record_that_it_continues(window, order):
    """Against scipy, whose mode "interp" makes the same one-sided fit at the end."""
    half = window // 2
    record = np.random.default_rng(0).standard_normal((half + 12, 2))
    smooth = control.plan_smoother(horizon=12, window=window, order=order)
    expected = savgol_filter(record, window, order, axis=0, mode="interp")[half:]
    np.testing.assert_allclose(
        smooth(jnp.asarray(record[:half]), jnp.asarray(record[half:])),
        expected,
        atol=2e-6,
    )


@pytest.mark.parametrize(("window", "horizon"), [(5, 3), (5, 6), (9, 5), (9, 20)])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_a_polynomial_that_continues_the_past_stays_what_it_is(window, horizon, order):
    """Also for the shortest horizon. A polynomial of higher order is changed, and so is
    a plan after another past.
    """
    half = window // 2
    smooth = control.plan_smoother(horizon=horizon, window=window, order=order)
    times = np.linspace(-1.0, 1.0, half + horizon)[:, None]

    def change(record, past=None):
        smoothed = smooth(
            jnp.asarray(record[:half] if past is None else past),
            jnp.asarray(record[half:]),
        )
        return np.max(np.abs(smoothed - record[half:]))

    saved = np.sum(
        [(k + 1) * np.hstack([times, -times]) ** k for k in range(order + 1)], axis=0
    )
    assert change(saved) < 1e-5
    assert change(saved + times ** (order + 1)) > 1e-3
    assert change(saved, np.zeros((half, 2))) > 1e-2


def test_a_plan_without_a_filter_is_the_same_array():
    plan = jnp.ones((4, 2))
    assert control.plan_smoother(horizon=4, window=0, order=2)(plan[:0], plan) is plan


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"smoothing_window": 4}, "odd"),
        ({"smoothing_window": 1}, "at least 3"),
        ({"smoothing_window": -5}, "at least 3"),
        (
            {"smoothing_window": 5, "smoothing_order": 4},
            r"smoothing_order must lie in \[0, 3\]",
        ),
        ({"smoothing_window": 5, "smoothing_order": -1}, "smoothing_order"),
        ({"smoothing_window": 13}, "horizon of at least 7"),
    ],
)
def test_invalid_filters_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        planner("plain", **settings)


# ---- in the planner ----------------------------------------------------------------------------------------------


def planner(law, **settings):
    settings = {
        "num_samples": 16,
        "horizon": HORIZON,
        "smoothing_window": 5,
        **settings,
    }
    box = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
    cost = control.tracking_cost(dt=0.1)
    limits = {name: settings.pop(name, LIMITS[name]) for name in LIMITS}
    task = control.path_tracking(
        models.physics(PLANT.nominal), cost, LAWS[law], dt=0.1, **limits
    )
    return control.mppi(task, **settings, **box)


@cache
def compiled(law, **settings):
    controller = planner(law, **settings)
    return controller, jit(controller.act)


def act(state, law="plain", observation=OFFSET, **settings):
    return compiled(law, **settings)[1]({}, state, observation, ENV, REFERENCE)


def started(law="plain", **settings):
    return compiled(law, **settings)[0].init(jax.random.key(0))


def test_the_chosen_plan_is_the_weighted_one_smoothed_after_what_was_applied():
    """The planner without a filter gives the plan before smoothing; no limit is active."""
    _, state, _ = act(started(**WIDE), **WIDE)
    _, state, _ = act(state, **WIDE)
    _, smoothed, _ = act(state, **WIDE)
    _, rough, _ = act(
        state._replace(past=jnp.zeros((0, 2))), smoothing_window=0, **WIDE
    )
    chosen, raw = (
        np.concatenate([after.previous[None], after.plan[:-1]])
        for after in (smoothed, rough)
    )
    record = np.concatenate([state.past, raw])
    np.testing.assert_allclose(
        chosen, savgol_filter(record, 5, 2, axis=0, mode="interp")[2:], atol=1e-5
    )
    assert np.max(np.abs(chosen - raw)) > 1e-2


@pytest.mark.parametrize(
    ("offset", "noise_std"), [(0.3, (0.06, 0.6)), (5.0, (1e3, 1e3))]
)
def test_the_past_is_what_was_applied_within_the_limits_and_through_a_blackout(
    offset, noise_std
):
    """Around nothing, perturbations are controls. Before the first step there was none.

    From 5 m off the path the best plan is at its limits, and the filter overshoots
    where it begins.
    """
    low, high = np.float32(PLANT.control_low), np.float32(PLANT.control_high)
    state, applied = started(noise_std=noise_std), [np.zeros(2), np.zeros(2)]
    for step in range(7):
        np.testing.assert_array_equal(state.past, applied[-2:])
        seen = (
            np.full(4, np.nan, np.float32)
            if step in (3, 4)
            else np.float32([0, offset, 0, 10])
        )
        action, state, info = act(state, observation=seen, noise_std=noise_std)
        assert bool(info["healthy"]) == (step not in (3, 4))
        assert np.all((low <= action) & (action <= high))
        assert np.all((low <= state.controls) & (state.controls <= high))
        np.testing.assert_array_equal(
            state.plan, state.controls
        )  # clipped, so that no plan leaves the limits
        applied.append(action)
    assert bool(np.any(np.array(applied) == low)) == (offset == 5.0)
    assert np.all(np.array(applied)[2:] != 0)


def test_around_a_feedback_law_the_past_is_what_was_added_to_it():
    curvature = control.reference_curvature(REFERENCE)[0]
    state = started("feedback")
    for offset in (
        0.3,
        -0.2,
        5.0,
    ):  # the last one is beyond what the actuators can do about it
        seen = jnp.asarray([0.0, offset, 0.1, 9.0])
        action, state, _ = act(state, "feedback", seen)
        lawful = LAWS["feedback"](
            control.path_errors(seen, REFERENCE[0], curvature),
            curvature,
            REFERENCE[0, 3],
        )
        np.testing.assert_allclose(state.past[-1], action - lawful, atol=1e-6)


def test_what_is_predicted_is_the_drive_of_the_smoothed_plan():
    _, state, info = act(started())
    _, state, info = act(state)
    reached, step = OFFSET, jit(PLANT.nominal)
    for action, predicted in zip(
        [state.previous, *state.controls[:-1]], info["predicted_states"], strict=True
    ):
        reached = step(reached, action, ENV)
        np.testing.assert_allclose(predicted, reached, atol=1e-5)


def test_without_a_filter_nothing_is_kept_of_the_past():
    state = started(smoothing_window=0)
    assert state.past.shape == (0, 2)
    assert act(state, smoothing_window=0)[1].past.shape == (0, 2)


def test_a_smoothed_plan_steers_more_calmly_and_still_reaches_the_path():
    road = scenarios.Scenario(
        jnp.asarray(OFFSET),
        *[jnp.tile(jnp.asarray([[0.9, 0.0]]), (60, 1))] * 2,
        scenarios.path_from_curvature(jnp.zeros(300), spacing=0.5),
        jnp.asarray(10.0),
    )
    keys, rates = jax.random.split(jax.random.key(0), 4), {}
    for window in (0, 5):
        controller = planner(
            "plain", num_samples=64, noise_std=(0.06, 0.6), smoothing_window=window
        )
        drive = partial(
            evaluation.simulate, PLANT.nominal, controller, {}, dt=0.1, horizon=HORIZON
        )
        episodes = jax.tree.map(
            np.asarray, jit(jax.vmap(drive, in_axes=(None, 0)))(road, keys)
        )
        assert np.all(np.abs(episodes.lateral[:, -20:]) < 0.1)
        assert np.all(episodes.signals["healthy"])
        rates[window] = np.mean(
            np.abs(np.diff(episodes.controls[:, :, 0], axis=1)), axis=1
        )
    assert np.all(rates[5] < 0.8 * rates[0])
