"""Summary statistics with t intervals over trainings and episodes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import stdtrit

LEVEL = 0.95
SMALLEST_P = 1e-12
"""p-values are not resolved below this."""


class Spread(NamedTuple):
    """How uncertain a mean over trainings and episodes is."""

    mean: float  # of all entries
    error: float  # standard error of the mean
    share: float  # of its variance that the trainings cause, in [0, 1]
    freedom: tuple[int, int]  # degrees of freedom of trainings and of episodes

    def quantile(self, p: float) -> float:
        """Two-sided p-quantile of Student's t, mixed by the shares of the variance."""
        mixed = zip((self.share, 1.0 - self.share), self.freedom, strict=True)
        return sum(-one * float(stdtrit(df, p / 2)) for one, df in mixed if one > 0)


def mean_interval(
    values: Float[np.ndarray, "*seed episode"],
) -> tuple[float, list[float] | None]:
    """Return the mean and its 95 % interval, None if there is one value.

    Trainings and episodes are drawn anew in a repetition: x_ij = m + a_i + b_j + c_ij.
    With the mean squares M_a, M_b, M_c of a two-way analysis of variance,

        var m = max(M_a + M_b − M_c, M_a, M_b) / (number of entries),

    and the quantile of t is Cochran's, w t(trainings − 1) + (1 − w) t(episodes − 1),
    w the share of the trainings in the variance. With three trainings and 16 episodes
    the interval covers 91 to 97 %: least where only the trainings vary beside the rest,
    because their variance is then known from two degrees of freedom
    (tests/evaluation/test_statistics.py). Of a single training it is t of the episodes,
    and says nothing about other trainings.

    Args:
        values: one per episode, or one per training and episode; all trainings drove
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

    None with fewer than two values, or if one is not finite. Of a single training it is
    the p of a t test over episodes. Of three it is too small where the trainings vary
    and, by chance, do not show it: at a nominal 0.25 %, equal rows were told apart in
    0.1 to 2.5 % of simulated tables (tests/evaluation/test_statistics.py).
    """
    spread = _spread(values)
    if spread is None or not np.isfinite([spread.mean, spread.error]).all():
        return None
    # All values equal: either exactly the same, or told apart without doubt.
    if spread.error == 0.0:
        return 0.0 if spread.mean else 1.0
    t = abs(spread.mean) / spread.error
    if t == 0.0 or spread.quantile(SMALLEST_P) <= t:
        return float(t == 0.0)
    touches = root_scalar(lambda p: spread.quantile(p) - t, bracket=(SMALLEST_P, 1.0))
    return float(touches.root)


def holm(p_values: list[float], *, not_made: int = 0) -> list[float]:
    """Return p-values adjusted for a family of comparisons.

    All of those below 0.05 are then true with probability 0.95.

    Args:
        p_values: of the comparisons that were made.
        not_made: number of comparisons of the family that are still to be made. They
            count as if their p were 1, so that the marks of an unfinished table are
            not more than those of the whole.

    Source: Holm, Scandinavian Journal of Statistics 6(2), 1979.
    """
    order = np.argsort(p_values)
    factors = not_made + np.arange(len(p_values), 0, -1)
    # Adjusted p-values keep the order of the raw ones.
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

    Of two numbers of trainings the smaller counts; a single one is compared with each
    of the others.
    """
    both = [np.atleast_2d(np.asarray(part)) for part in (values, reference)]
    count = min(len(part) for part in both)
    # Pairs by the order of seeds; a single training is compared with every other.
    first, second = (part[:count] if count > 1 else part for part in both)
    # Equal episodes cancel what makes an episode hard for both.
    difference = first - second
    mean, interval = mean_interval(difference)
    return {"mean": mean, "ci95": interval, "p": p_value(difference)}


def _spread(values: Float[np.ndarray, "*seed episode"]) -> Spread | None:
    """The mean and its uncertainty, None if there is one value."""
    table = np.atleast_2d(np.asarray(values, dtype=np.float64))
    trainings, episodes = table.shape
    if table.size == 1:
        return None
    mean = float(np.mean(table))
    # One training says nothing about others: this is the t of episodes alone.
    if min(trainings, episodes) == 1:
        error = float(np.std(table, ddof=1) / np.sqrt(table.size))
        freedom = table.size - 1
        return Spread(mean, error, float(episodes == 1), (freedom, freedom))
    freedom = trainings - 1, episodes - 1
    by_training = table.mean(axis=1)
    by_episode = table.mean(axis=0)
    rest = table - by_training[:, None] - by_episode + table.mean()
    of_trainings = episodes * np.var(by_training, ddof=1)
    of_episodes = trainings * np.var(by_episode, ddof=1)
    of_rest = np.sum(rest**2) / (freedom[0] * freedom[1])
    # An estimate of a variance may be negative; the larger parts bound it from below.
    total = max(of_trainings + of_episodes - of_rest, of_trainings, of_episodes)
    share = max(of_trainings - of_rest, 0.0) / total if total > 0 else 0.0
    return Spread(mean, float(np.sqrt(total / table.size)), float(share), freedom)
