"""Every metric of the table: what it measures, how it is pooled, how it is written."""

import json
import math

import jax
import numpy as np
import pytest
from test_scores import CALM, DT, STEPS, about, episode

from sfkd_jax.evaluation import pool, row, score
from sfkd_jax.evaluation.formats import DASH
from sfkd_jax.evaluation.metrics import (
    BY_NAME,
    METRICS,
    Metric,
    Recording,
    in_table,
    text_table,
)

MEASURED = [metric for metric in METRICS if metric.measure]
SHOWN = [metric for metric in METRICS if metric.label]
LEVELS = (0.1, 0.2, 0.6, 0.9)
"""Constant deviations of four episodes [m]; the last car leaves its lane."""
EXPECTED = {
    # name: (per episode, of the row, of two rows with seeds 0 and 1)
    "rmse_m": (LEVELS, 0.45, 0.45),
    "rmse_episodes_m": (LEVELS, list(LEVELS), [*LEVELS, *LEVELS]),
    "max_deviation_m": (LEVELS, 0.9, 0.9),
    "rmse_after_switch_m": ((math.nan, 0.2, 0.6, 0.9), 1.7 / 3, 1.7 / 3),
    "smoothness_rad_per_s": ((0.01, 0.02, 0.06, 0.09), 0.045, 0.045),
    "departures": ((False, False, False, True), 1, 2),
    "unhealthy_steps": ((0.1, 0.2, 0.6, 0.9), 0.45, 0.45),
    "ess": ((10.0, 20.0, 60.0, 90.0), 40.0, 40.0),
}


def batch():
    """Four constant deviations; all but the first meet a switch of friction."""
    time, index = np.arange(1, STEPS + 1) * DT, np.arange(STEPS)
    parts, envs = [], np.repeat(CALM, len(LEVELS), axis=0)
    for number, level in enumerate(LEVELS):
        flagged = index < round(level * STEPS)
        part = episode(
            np.full(STEPS, level),
            steering=0.1 * level * time,
            ess=np.full(STEPS, 100.0 * level),
            healthy=~flagged,
        )
        parts.append(part)
        envs[number, 100:, 0] = 0.3 if number else 0.9
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined, envs


def made(seed=0):
    scores = score(*batch(), dt=DT)
    return row(scores, about("sfkd", seeds=[seed]), (1.5, 2.5), {})


def mean_of(value):
    return value["mean"] if isinstance(value, dict) else value


@pytest.mark.parametrize("metric", MEASURED, ids=lambda metric: metric.name)
def test_a_metric_measures_episodes_one_by_one_and_pools_to_json(metric):
    joined, envs = batch()
    values = score(joined, envs, dt=DT)[metric.name]
    assert values.shape == (len(LEVELS),)
    for k, value in enumerate(values):
        alone = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], joined)
        own = score(alone, envs[k : k + 1], dt=DT)[metric.name]
        np.testing.assert_array_equal(own, [value])
    for entry in (made(), pool([made(0), made(1)])):
        json.dumps(entry[metric.name], allow_nan=False)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_metric_of_known_episodes_is_exact_and_pools_as_stated(name):
    metric = BY_NAME[name]
    per_episode, of_row, of_seeds = EXPECTED[name]
    np.testing.assert_allclose(
        score(*batch(), dt=DT)[metric.name], per_episode, rtol=1e-12
    )
    np.testing.assert_allclose(mean_of(metric.value(made())), of_row, rtol=1e-12)
    pooled = pool([made(0), made(1)])
    np.testing.assert_allclose(mean_of(metric.value(pooled)), of_seeds, rtol=1e-12)
    assert pool([made()]) == made()


@pytest.mark.parametrize("metric", SHOWN, ids=lambda metric: metric.name)
@pytest.mark.parametrize(
    "value", [None, math.nan, math.inf, "text", [], [None, 1.0], {}, {"mean": None}]
)
def test_what_is_no_number_is_written_as_a_dash(metric, value):
    assert metric.write(value) == DASH
    keys = metric.name.split(".")
    record = {"v1_tube": "certified"} if keys[0] == "violation" else {}
    nested = {keys[0]: record | {keys[-1]: value}} if keys[1:] else {keys[0]: value}
    for mm in (False, True):
        assert metric.text(nested, mm=mm) == DASH
        assert metric.text({}, mm=mm) == DASH


@pytest.mark.parametrize("metric", SHOWN, ids=lambda metric: metric.name)
def test_a_shown_metric_has_a_label_of_its_own_and_a_table(metric):
    assert metric.table
    assert metric in in_table(metric.table)
    assert [one.label for one in METRICS].count(metric.label) == 1
    assert metric.head() == metric.label + (f" [{metric.unit}]" if metric.unit else "")
    written = metric.write([0.25, 0.5] if metric.name.endswith("ci95") else 0.25)
    assert written not in (DASH, "")
    if metric.mm is not None:
        assert metric.unit == "m"
        assert metric.head(mm=True).endswith("[mm]")


def test_names_are_unique_and_measured_metrics_can_be_pooled():
    assert len(BY_NAME) == len(METRICS)
    assert all(metric.pool for metric in MEASURED)


@pytest.mark.parametrize(
    ("name", "record", "text", "in_mm"),
    [
        ("rmse_m", {"rmse_m": {"mean": 0.1234, "std": 0.01}}, "0.123 ± 0.010", "123.4"),
        ("rmse_m.ci95", {"rmse_m": {"ci95": [0.1, 0.25]}}, "0.100 to 0.250", None),
        ("max_deviation_m", {"max_deviation_m": 0.4321}, "0.432", "432"),
        ("departures", {"departures": 3}, "3", None),
        ("unhealthy_steps", {"unhealthy_steps": 0.0001}, "< 0.1", None),
        ("ess", {"ess": 41.7}, "42", None),
        ("alpha", {"alpha": 0.93207}, "0.9321", None),
        ("act_ms.p50", {"act_ms": {"p50": 3.214}}, "3.21", None),
    ],
)
def test_a_metric_is_written_with_its_digits(name, record, text, in_mm):
    metric = BY_NAME[name]
    assert metric.text(record) == text
    assert metric.text(record, mm=True) == (in_mm or text)


def test_a_claim_is_read_for_the_tube_it_is_about():
    certified, conformal = (
        BY_NAME["violation.v1"],
        BY_NAME["violation.v1_conformal"],
    )
    own = {"v1": 0.1, "v1_tube": "certified", "v1_conformal": 0.2}
    in_use = {"v1": 0.3, "v1_tube": "conformal", "v1_conformal": 0.3}
    assert certified.value({"violation": own}) == 0.1
    assert conformal.value({"violation": own}) == 0.2
    assert certified.value({"violation": in_use}) is None
    assert conformal.value({"violation": in_use}) == 0.3


def test_a_new_metric_takes_one_entry(monkeypatch):
    def largest_steering(drive):
        return np.max(np.abs(drive.controls[..., 0]), axis=1)

    new = Metric(
        "largest_steering_rad",
        "Largest steering",
        "rad",
        "tracking",
        measure=largest_steering,
        pool=lambda values: float(np.max(values)),
    )
    for module in ("metrics", "_rows"):
        monkeypatch.setattr(f"sfkd_jax.evaluation.{module}.METRICS", (*METRICS, new))
    assert made()["largest_steering_rad"] == pytest.approx(0.1 * 0.9 * STEPS * DT)
    assert pool([made(0), made(1)])["largest_steering_rad"] == pytest.approx(1.8)
    assert new in in_table("tracking")


def test_a_printed_table_is_aligned_and_in_millimetres():
    rows = [
        {"system": "sfkd", "rmse_m": {"mean": 0.0342}, "max_deviation_m": 0.1368},
        {"system": "nominal", "rmse_m": {"mean": 0.12}},
    ]
    head, *lines = text_table(rows, "rmse_m", "max_deviation_m")
    assert head.split("   ")[-1] == "Largest deviation [mm]"
    assert [line.split() for line in lines] == [
        ["sfkd", "34.2", "137"],
        ["nominal", "120.0", DASH],
    ]
    assert len({len(line) for line in (head, *lines)}) == 1


@pytest.mark.parametrize("metric", MEASURED, ids=lambda metric: metric.name)
def test_a_metric_names_the_signals_that_it_needs(metric):
    """Then an entry of the table is all that a new metric takes."""
    joined, envs = batch()
    fields = {name: getattr(joined, name) for name in ("lateral", "states", "controls")}
    named = {name: joined.signals[name] for name in metric.records}
    alone = metric.measure(Recording(dt=DT, envs=envs, **fields, signals=named))
    np.testing.assert_array_equal(alone, score(joined, envs, dt=DT)[metric.name])
