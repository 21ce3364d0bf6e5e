"""Every metric of the table: what it measures, how it is pooled, how it is written."""

import json
import math

import jax
import numpy as np
import pytest

from sfkd_jax.driving.simulation import Episode, pool, row, score
from sfkd_jax.driving.simulation.metrics import BY_NAME, METRICS, Recording, switches
from sfkd_jax.evaluation.formats import DASH

DT, STEPS = 0.1, 200
CAR_SIZE = (4.5, 2.0)
TIME = np.arange(1, STEPS + 1) * DT
MEASURED = [metric for metric in METRICS if metric.measure]
SHOWN = [metric for metric in METRICS if metric.label]
LEVELS = (0.1, 0.2, 0.6, 0.9)
"""Constant deviations of four episodes [m]; the last car leaves its lane."""
MEAN_SQUARE = (STEPS + 1) * (2 * STEPS + 1) / (6 * STEPS**2)
"""Of k / STEPS over the steps k = 1, 2, …, STEPS."""
EXPECTED = {
    # name: (per episode, of the row, of two rows with seeds 0 and 1)
    "rmse_m": (LEVELS, 0.45, 0.45),
    "rmse_episodes_m": (LEVELS, list(LEVELS), [*LEVELS, *LEVELS]),
    "max_deviation_m": (LEVELS, 0.9, 0.9),
    "smoothness_rad_per_s": ((0.01, 0.02, 0.06, 0.09), 0.045, 0.045),
    "departures": ((False, False, False, True), 1, 2),
    "unhealthy_steps": ((0.1, 0.2, 0.6, 0.9), 0.45, 0.45),
    "ess": ((10.0, 20.0, 60.0, 90.0), 40.0, 40.0),
    "collisions": ((0, 0, 0, 1), 1, 2),
    "clearance_m": ((0.8, 0.7, 0.3, -0.05), -0.05, -0.05),
    "below_claim": ((0, 0, 100, 100), 200, 400),
    "mean_speed_mps": (
        tuple(10.0 * level * MEAN_SQUARE for level in LEVELS),
        4.5 * MEAN_SQUARE,
        4.5 * MEAN_SQUARE,
    ),
}


def episode(lateral, steering=0.0, states=None, ess=1.0, healthy=True, near=np.inf):
    """One episode as a batch, with what matters given and the rest at rest."""
    steps = len(lateral)
    controls = np.zeros((1, steps, 2))
    controls[0, :, 0] = steering
    return Episode(
        states=np.zeros((1, steps + 1, 4)) if states is None else states[None],
        controls=controls,
        lateral=np.asarray(lateral, dtype=float)[None],
        progress=np.zeros((1, steps)),
        signals={
            "effective_samples": np.full((1, steps), ess),
            "healthy": np.full((1, steps), healthy),
            "gap": np.full((1, steps), near),
            "clearance": np.full((1, steps), 0.5) * np.where(near == np.inf, np.nan, 1),
        },
    )


def measured(name, lateral, **changes):
    """A metric of one episode."""
    return score(episode(lateral, **changes), dt=DT, size=CAR_SIZE)[name][0]


def test_a_sinusoid_has_the_rmse_of_a_sinusoid():
    """Over whole periods: amplitude / √2."""
    lateral = 0.3 * np.sin(2 * np.pi * TIME / 3.0)
    assert measured("rmse_m", lateral) == pytest.approx(0.3 / np.sqrt(2), rel=1e-12)
    assert measured("max_deviation_m", lateral) == pytest.approx(0.3, rel=0.01)


def test_the_first_two_seconds_do_not_count():
    lateral = np.where(TIME <= 2.0 + 1e-9, 5.0, 0.1)
    assert measured("rmse_m", lateral) == pytest.approx(0.1, rel=1e-12)
    assert not measured("departures", lateral)
    late = np.where(TIME <= 2.1 + 1e-9, 5.0, 0.1)
    assert measured("max_deviation_m", late) == 5.0


@pytest.mark.parametrize(
    ("channel", "to", "counts"),
    [(0, 0.3, True), (0, 0.88, False), (1, -8.0, True), (1, 5.0, False)],
)
def test_a_switch_is_a_jump_of_friction_or_wind(channel, to, counts):
    envs = np.array(np.broadcast_to([0.9, 0.0], (STEPS, 2)))
    envs[100:, channel] = to
    assert np.flatnonzero(switches(envs)).tolist() == [100] * counts


@pytest.mark.parametrize(
    ("deviation", "departed"),
    [(0.84, False), (-0.84, False), (0.86, True), (-3.0, True), (np.nan, True)],
)
def test_a_car_departs_when_its_side_leaves_the_lane(deviation, departed):
    """A lane of 3.5 m and a car of 1.8 m leave 0.85 m to either side."""
    lateral = np.where(np.arange(STEPS) == 150, deviation, 0.0)
    assert measured("departures", lateral) == departed


@pytest.mark.parametrize("when", [0, 5, STEPS])
def test_a_state_that_is_not_finite_is_a_departure_whenever_it_happens(when):
    states = np.zeros((STEPS + 1, 4))
    states[when, 3] = np.nan
    assert measured("departures", np.zeros(STEPS), states=states)


def batch():
    """Four constant deviations."""
    parts = []
    for level in LEVELS:
        healthy = np.arange(STEPS) >= round(level * STEPS)
        signals = {"ess": 100.0 * level, "healthy": healthy}
        signals["near"] = np.where(TIME > 10.0, (0.9 - level, -0.05)[level > 0.8], 2.0)
        steering = 0.1 * level * TIME
        # The speed grows with the square of the time: its mean is not its median.
        states = np.zeros((STEPS + 1, 4))
        states[:, 3] = 10.0 * level * np.linspace(0.0, 1.0, STEPS + 1) ** 2
        lateral = np.full(STEPS, level)
        parts.append(episode(lateral, steering=steering, states=states, **signals))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def made(seed=0):
    about = {"system": "sfkd", "scenario": "s3", "seeds": [seed]}
    return row(score(batch(), dt=DT, size=CAR_SIZE), about)


@pytest.mark.parametrize("metric", MEASURED, ids=lambda metric: metric.name)
def test_a_metric_measures_episodes_one_by_one_by_the_signals_it_names(metric):
    joined = batch()
    values = score(joined, dt=DT, size=CAR_SIZE)[metric.name]
    assert values.shape == (len(LEVELS),)
    assert metric.pool
    assert BY_NAME[metric.name] is metric
    for k, value in enumerate(values):
        alone = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], joined)
        parts = {one: getattr(alone, one) for one in ("lateral", "states", "controls")}
        named = {name: alone.signals[name] for name in metric.records}
        run = Recording(dt=DT, size=CAR_SIZE, signals=named, **parts)
        np.testing.assert_array_equal(metric.measure(run), [value])
    for entry in (made(), pool([made(0), made(1)])):
        json.dumps(entry[metric.name], allow_nan=False)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_metric_of_known_episodes_is_exact_and_pools_as_stated(name):
    per_episode, of_row, of_seeds = EXPECTED[name]
    pooled, values = (
        pool([made(0), made(1)]),
        score(batch(), dt=DT, size=CAR_SIZE)[name],
    )
    np.testing.assert_allclose(values, per_episode, rtol=1e-12)
    for entry, expected in ((made(), of_row), (pooled, of_seeds)):
        value = BY_NAME[name].value(entry)
        value = value["mean"] if isinstance(value, dict) else value
        np.testing.assert_allclose(value, expected, rtol=1e-12)


@pytest.mark.parametrize("metric", SHOWN, ids=lambda metric: metric.name)
def test_a_shown_metric_has_a_table_and_writes_what_is_no_number_as_a_dash(metric):
    assert metric.table
    assert [one.label for one in METRICS].count(metric.label) == 1
    assert metric.head() == metric.label + (f" [{metric.unit}]" if metric.unit else "")
    assert metric.write([0.25, 0.5] if metric.name.endswith("ci95") else 0.25) != DASH
    key, *rest = metric.name.split(".")
    for value in (None, math.nan, math.inf, "text", [], [None, 1.0], {}):
        record = {rest[0]: value} if rest else value
        assert metric.text({key: record}) == DASH
