"""Summary statistics with t intervals over trainings and episodes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import stdtrit

LEVEL = 0.95
"""Probability with which an interval covers the mean."""
SMALLEST_P = 1e-12
"""Limit below which p-values are not resolved."""


class Spread(NamedTuple):
    """How uncertain a mean over trainings and episodes is."""

    mean: float  # of all entries
    error: float  # standard error of the mean
    share: float  # of its variance that the trainings cause, in [0, 1]
    freedom: tuple[int, int]  # degrees of freedom of trainings and of episodes

    def quantile(self, p: float) -> float:
        """Return the two-sided p-quantile of Student's t.

        It is the mean of the quantiles of trainings and of episodes, weighted by their
        shares of the variance.
        """
        shares = (self.share, 1.0 - self.share)
        total = 0
        for share, freedom in zip(shares, self.freedom, strict=True):
            if share > 0:
                total += -share * float(stdtrit(freedom, p / 2))
        return total


def mean_interval(
    values: Float[np.ndarray, "*seed episode"],
) -> tuple[float, list[float] | None]:
    """Return the mean and its 95 % interval, None if there is one value.

    The interval is about repetitions in which trainings and episodes are drawn anew:
    x_ij = m + a_i + b_j + c_ij for training i and episode j. With the mean squares
    M_a, M_b, M_c of a two-way analysis of variance,

        var m = max(M_a + M_b − M_c, M_a, M_b) / (number of entries),

    and the quantile of t is Cochran's, w t(trainings − 1) + (1 − w) t(episodes − 1),
    where w is the share of the trainings in the variance.

    With three trainings and 16 episodes the interval covers the mean in 91 to 97 % of
    repetitions. It covers least where only the trainings vary beside the rest, because
    their variance is then known from two degrees of freedom
    (tests/evaluation/test_statistics.py). For a single training the interval is that of
    a t test over episodes, and it says nothing about other trainings.

    Args:
        values: one per episode, or one per training and episode, if all trainings drove
            the same episodes.

    Source: Cochran and Cox, Experimental Designs, 1957, section 4.14.
    """
    spread = _spread(values)
    if spread is None:
        return float(np.mean(values)), None
    half = spread.quantile(1.0 - LEVEL) * spread.error
    return spread.mean, [spread.mean - half, spread.mean + half]


def p_value(values: Float[np.ndarray, "*seed episode"]) -> float | None:
    """Return the p at which the 1 − p interval of `mean_interval` touches 0.

    It is None with fewer than two values, or if one is not finite. For a single
    training it is the p of a t test over episodes. For three trainings it is too small
    if the trainings vary and, by chance, do not show it: at a nominal 0.25 %, equal
    rows were told apart in 0.1 to 2.5 % of simulated tables
    (tests/evaluation/test_statistics.py).
    """
    spread = _spread(values)
    if spread is None or not np.isfinite([spread.mean, spread.error]).all():
        return None
    # All values are equal. A mean other than 0 then differs from 0 without doubt.
    if spread.error == 0.0:
        return 0.0 if spread.mean else 1.0
    t = abs(spread.mean) / spread.error
    if t == 0.0 or spread.quantile(SMALLEST_P) <= t:
        return float(t == 0.0)

    def difference(p: float) -> float:
        return spread.quantile(p) - t

    return float(root_scalar(difference, bracket=(SMALLEST_P, 1.0)).root)


def holm(p_values: list[float], *, not_made: int = 0) -> list[float]:
    """Return p-values adjusted for a family of comparisons.

    With probability 0.95 all differences with an adjusted p below 0.05 are real.

    Args:
        p_values: of the comparisons that were made.
        not_made: number of comparisons of the family that are still to be made. They
            count as if their p were 1. An unfinished table therefore never marks more
            differences than the finished one.

    Source: Holm, Scandinavian Journal of Statistics 6(2), 1979.
    """
    order = np.argsort(p_values)
    factors = not_made + np.arange(len(p_values), 0, -1)
    # The running maximum makes adjusted p-values keep the order of the raw ones.
    raised = np.maximum.accumulate(np.asarray(p_values)[order] * factors)
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted.tolist()


def summary(values: Float[np.ndarray, "*seed episode"]) -> dict[str, Any]:
    """Return mean, std, ci95, median, p95 and worst of one number per episode."""
    mean, interval = mean_interval(values)
    return {
        "mean": mean,
        "std": float(np.std(values, ddof=1)) if np.size(values) > 1 else None,
        "ci95": interval,
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
        "worst": float(np.max(values)),
    }


def paired_difference(
    values: Float[np.ndarray, "*seed episode"],
    reference: Float[np.ndarray, "*other_seed episode"],
) -> dict[str, Any]:
    """Return mean, interval and p of values − reference over equal episodes.

    If both have several trainings, as many pairs are compared as the smaller number of
    trainings allows. A single training is compared with each of the others.
    """
    table = np.atleast_2d(np.asarray(values))
    reference_table = np.atleast_2d(np.asarray(reference))
    count = min(len(table), len(reference_table))
    # Trainings are paired in the order of their seeds. A single one is broadcast.
    if count > 1:
        table = table[:count]
        reference_table = reference_table[:count]
    # Both drove the same episodes: how hard an episode is cancels in the difference.
    difference = table - reference_table
    mean, interval = mean_interval(difference)
    return {"mean": mean, "ci95": interval, "p": p_value(difference)}


def _spread(values: Float[np.ndarray, "*seed episode"]) -> Spread | None:
    """Return the mean and its uncertainty, None if there is one value."""
    table = np.atleast_2d(np.asarray(values, dtype=np.float64))
    trainings, episodes = table.shape
    if table.size == 1:
        return None
    mean = float(np.mean(table))
    # A single training says nothing about others: the t test of episodes alone remains.
    if min(trainings, episodes) == 1:
        error = float(np.std(table, ddof=1) / np.sqrt(table.size))
        freedom = table.size - 1
        return Spread(mean, error, float(episodes == 1), (freedom, freedom))
    freedom = (trainings - 1, episodes - 1)
    training_means = table.mean(axis=1)
    episode_means = table.mean(axis=0)
    rest = table - training_means[:, None] - episode_means + table.mean()
    # The mean squares M_a, M_b and M_c of `mean_interval`.
    training_square = episodes * np.var(training_means, ddof=1)
    episode_square = trainings * np.var(episode_means, ddof=1)
    rest_square = np.sum(rest**2) / (freedom[0] * freedom[1])
    # The estimate may come out too small, even negative. Each of the two mean squares
    # alone bounds it from below.
    total = max(
        training_square + episode_square - rest_square, training_square, episode_square
    )
    share = max(training_square - rest_square, 0.0) / total if total > 0 else 0.0
    return Spread(mean, float(np.sqrt(total / table.size)), float(share), freedom)
