"""The rows made of scores: what they hold, how they are compared and pooled."""

import numpy as np
import pytest

from sfkd_jax.driving.simulation import compare, pool, row
from sfkd_jax.driving.simulation.metrics import METRICS


def scored(level, count=4):
    """Scores of episodes that get worse one by one."""
    scores = {metric.name: np.zeros(count) for metric in METRICS if metric.measure}
    worse = level * (1 + 0.1 * np.arange(count))
    for name in ("rmse_m", "rmse_episodes_m", "max_deviation_m"):
        scores[name] = worse
    return scores


def made(level, system, *, count=4, **changes):
    about = {
        "system": system,
        "scenario": "s3",
        "vehicle": "kinematic",
        "sampling": "feedback",
        "env": "measured",
        "seeds": [0],
        **changes,
    }
    return row(scored(level, count), about)


def test_a_row_holds_every_measure_and_null_for_what_does_not_apply():
    entry = made(0.1, "sfkd")
    measured = {metric.name for metric in METRICS if metric.measure}
    given = {"ratio_to_oracle", "difference_to_sfkd"}
    assert measured | given | {"system", "scenario", "seeds"} <= set(entry)
    np.testing.assert_allclose(entry["rmse_m"]["mean"], 0.115)
    np.testing.assert_allclose(entry["max_deviation_m"], 0.13)


def test_comparisons_are_ratios_to_the_oracle_and_paired_differences_to_ours():
    levels = {"oracle": 0.1, "sfkd": 0.2, "nominal": 0.5}
    oracle, ours, other = compare([made(level, name) for name, level in levels.items()])
    ratios = [entry["ratio_to_oracle"] for entry in (oracle, ours, other)]
    np.testing.assert_allclose(ratios, [1.0, 2.0, 5.0])
    assert ours["difference_to_sfkd"] is None
    np.testing.assert_allclose(other["difference_to_sfkd"]["mean"], 0.3 * 1.15)
    assert oracle["difference_to_sfkd"]["ci95"][1] < 0
    (only,) = compare([made(0.5, "nominal")])
    assert only["ratio_to_oracle"] is only["difference_to_sfkd"] is None


@pytest.mark.parametrize(
    "change",
    [{"scenario": "s1"}, {"vehicle": "dynamic"}, {"sampling": "plain"}, {"count": 3}],
)
def test_rows_of_other_episodes_or_another_sampling_are_not_paired(change):
    (_, other) = compare([made(0.2, "sfkd"), made(0.5, "icode", **change)])
    assert other["difference_to_sfkd"] is None


def test_two_trainings_of_three_episodes_are_not_paired_with_three_of_two():
    ours = pool([made(0.2, "sfkd", count=3, seeds=[k]) for k in range(2)])
    theirs = pool([made(0.5, "icode", count=2, seeds=[k]) for k in range(3)])
    assert compare([ours, theirs])[1]["difference_to_sfkd"] is None


def test_a_quadratic_program_is_paired_with_what_samples_around_feedback():
    plain, feedback = made(0.1, "sfkd", sampling="plain"), made(0.2, "sfkd")
    *_, qp = compare([plain, feedback, made(0.5, "koopman_mpc", sampling=None)])
    np.testing.assert_allclose(qp["difference_to_sfkd"]["mean"], 0.3 * 1.15)


def test_pooling_joins_the_episodes_of_all_seeds_and_averages_the_rest():
    rows = [made(level, "sfkd", seeds=[k]) for k, level in enumerate((0.1, 0.3))]
    pooled = pool(rows)
    assert pooled["seeds"] == [0, 1]
    np.testing.assert_allclose(pooled["rmse_m"]["mean"], 0.2 * 1.15)
    assert pool(rows[:1]) == rows[0]
