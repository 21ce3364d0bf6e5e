"""Measured one-step errors, and split-conformal bounds on what was measured."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import betaincinv

from sfkd_jax.certificate import Coverage
from sfkd_jax.geometry import between
from sfkd_jax.rollout import rollout
from sfkd_jax.types import BODY, POSE, Model, Params, Trajectory

ROUNDING = 1e-9
"""Far above the rounding error of a share times a count."""
BATCH = 50
"""Number of runs in a batch."""
WORST = 5
"""Number of steps of every validation run that a metric is optimised for."""
TAIL = 0.1
"""Share of the runs, those with the largest values, that the tail is fitted to."""


class Residuals(NamedTuple):
    """Prediction errors of every single step of runs.

    Attributes:
        gaps: d_k in latent coordinates.
        outputs: 2-norms of the errors of each output of the frame, by its name.
    """

    gaps: Float[np.ndarray, "run time rank"]
    outputs: dict[str, Float[np.ndarray, "run time"]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors of a step that are bounded."""
        return ("latent", *self.outputs)

    def largest(self) -> Float[np.ndarray, "run error"]:
        """Return the largest errors of each run, in the order of `names`.

        The bounds are about whole runs, and not about single steps.
        """
        sizes = [np.linalg.norm(self.gaps, axis=-1), *self.outputs.values()]
        return np.column_stack([np.max(errors, axis=1) for errors in sizes])


def residuals(model: Model, params: Params, runs: Trajectory) -> Residuals:
    """Measure the prediction error of every step from its true state.

    Defects of the transport and switches of e are part of the errors.
    """
    count = runs.controls.shape[0]
    # The last batch is filled up with first runs, so that one program serves all
    # batches.
    rows_of_batches = jnp.arange(-(-count // BATCH) * BATCH).reshape(-1, BATCH) % count
    gaps = []
    outputs = []
    for rows in rows_of_batches:
        batch = Trajectory(runs.states[rows], runs.controls[rows], runs.envs[rows])
        gaps_of_batch, outputs_of_batch = _errors(model, params, batch)
        gaps.append(np.asarray(gaps_of_batch, np.float64))
        outputs.append(np.asarray(outputs_of_batch, np.float64))
    of_outputs = np.moveaxis(np.concatenate(outputs)[:count], -1, 0)
    return Residuals(
        gaps=np.concatenate(gaps)[:count],
        outputs=dict(zip(model.frame.outputs, of_outputs, strict=True)),
    )


@partial(jax.jit, static_argnums=0)
def _errors(model: Model, params: Params, runs: Trajectory) -> tuple[Array, Array]:
    """Return the fields of `Residuals` for one batch of fixed size.

    The outputs are the last axis, in the order of the frame.
    """

    def errors_of_run(run: Trajectory) -> tuple[Array, Array]:
        predictions = rollout(model, params, run)
        before = run.states[:-1]
        after = run.states[1:]
        errors = predictions.single - after
        if model.frame.has_pose:
            # Poses are compared as motions of one step. Each turns far less than π, so
            # that the difference of the yaw needs no wrap.
            motion_of = jax.vmap(between)
            motion = motion_of(before[:, POSE], predictions.single[:, POSE])
            motion -= motion_of(before[:, POSE], after[:, POSE])
            errors = jnp.concatenate([motion, errors[:, BODY]], axis=1)
        norms = [
            jnp.linalg.norm(errors[:, model.frame.entries(name)], axis=1)
            for name in model.frame.outputs
        ]
        return predictions.defects, jnp.stack(norms, 1)

    return jax.vmap(errors_of_run)(runs)


def worst_gaps(measured: Residuals) -> Float[np.ndarray, "run worst rank"]:
    """Return d of the `WORST` steps of every run with the largest |d|.

    These steps decide the radius of a tube, and so few keep the search fast.
    """
    sizes = np.linalg.norm(measured.gaps, axis=-1)
    worst = np.argsort(sizes, axis=1)[:, -WORST:]
    return np.take_along_axis(measured.gaps, worst[..., None], axis=1)


def conformal_quantile(scores: Float[np.ndarray, " trajectory"], level: float) -> float:
    """Return the ⌈(n+1) level⌉-th smallest of n scores.

    A new, exchangeable score exceeds it with probability at most 1 − level. An infinite
    score is that of a run for which no bound would hold.

    Raises:
        ValueError: a score is NaN, there are too few scores for the level, or too many
            are infinite.
    """
    if np.any(np.isnan(scores)):
        raise ValueError("residuals are not finite")
    check_count(len(scores), level, "calibration trajectories")
    # n + 1, because the new trajectory is one of the exchangeable ones.
    index = math.ceil((len(scores) + 1) * level) - 1
    quantile = float(np.sort(scores)[index])
    if quantile == math.inf:
        raise ValueError(
            f"residuals of {np.sum(np.isinf(scores))} of {len(scores)} runs are not "
            f"finite: more than level {level} allows"
        )
    return quantile


def supports(count: int, level: float) -> bool:
    """Return whether n scores suffice for a conformal quantile: ⌈(n+1) level⌉ ≤ n."""
    return math.ceil((count + 1) * level) <= count


def check_count(count: int, level: float, what: str) -> None:
    """Refuse a level that too few scores cannot support.

    Args:
        count: number of scores.
        level: 1 − δ.
        what: the scores are of, for the message.

    Raises:
        ValueError: there are too few.
    """
    if not supports(count, level):
        # Rounded down, so that the level that is proposed will be accepted.
        highest = math.floor(100 * count / (count + 1)) / 100
        raise ValueError(
            f"{count} {what} are too few for certification.level={level:g}: "
            f"record more, or pass certification.level={highest:g}"
        )


def holds_for(runs: int, level: float) -> str:
    """Return what a bound is about that trajectories of so many runs have given."""
    if supports(runs, level):
        return "new runs like these"
    return f"further segments of the same {runs} runs"


def conformal_bounds(
    reference: Float[np.ndarray, "other error"],
    calibration: Float[np.ndarray, "trajectory error"],
    *,
    level: float,
) -> Float[np.ndarray, " error"]:
    """Return bounds on all errors of a whole new trajectory (split-conformal).

    Together they hold with probability at least `level`. The score of a trajectory is
    the largest of its errors, each in its unit. The bounds are the units times the
    ⌈(n+1) level⌉-th smallest score.

    The unit of the first error is its quantile at `level`. The other errors exceed
    their units a tenth as often. A tube multiplies the first bound by up to 1/(1 − α)
    and adds the others once, so that these units make it tighter than equal quantiles
    do.

    Args:
        reference: errors that fix the units, of a split other than `calibration`.
        calibration: errors that give the scores.
        level: 1 − δ.

    Raises:
        ValueError: the level is not in (0, 1), the calibration is too small for it, or
            an error is not finite.
    """
    if not 0 < level < 1:
        raise ValueError(f"a level must lie between 0 and 1, got {level}")
    if not np.all(np.isfinite(reference)):
        raise ValueError("residuals are not finite")
    others = reference.shape[1] - 1
    levels = [level, *[1.0 - 0.1 * (1.0 - level)] * others]
    units = np.asarray(
        [np.quantile(errors, q) for errors, q in zip(reference.T, levels, strict=True)]
    )
    # An error that is always 0 needs no unit.
    units[units <= 0] = 1.0
    scores = np.max(calibration / units, axis=1)
    return units * conformal_quantile(scores, level)


def alarm_thresholds(
    reference: Float[np.ndarray, "other chart"],
    maxima: Float[np.ndarray, "run chart"],
    *,
    rate: float,
) -> Float[np.ndarray, " chart"]:
    """Return thresholds that a share `rate` of new runs exceeds in any chart.

    So small a rate cannot be counted on any affordable number of runs. The tail of the
    largest value of a run is therefore taken as exponential, and fitted to the share
    `TAIL` of the runs with the largest values.

    Args:
        reference: largest values of runs that fix the unit of every chart, which is its
            0.99-quantile.
        maxima: largest values of the runs that the tail is fitted to.
        rate: share of new runs.
    """
    units = np.quantile(reference, 0.99, axis=0)
    units[units <= 0] = 1.0
    largest = np.max(maxima / units, axis=1)
    start = np.quantile(largest, 1.0 - TAIL)
    mean_excess = float(np.mean(largest[largest > start] - start))
    return units * (start + mean_excess * max(math.log(TAIL / rate), 0.0))


def coverage(
    bounds: Float[np.ndarray, " error"],
    held_out: Float[np.ndarray, "trajectory error"],
    runs: int | None = None,
) -> Coverage:
    """Return the share of held-out trajectories within all bounds, and its interval.

    Args:
        bounds: on the errors.
        held_out: errors of the trajectories.
        runs: number of independent runs that the trajectories were cut from; None if
            every trajectory is a run.
    """
    within = np.all(held_out <= bounds, axis=1)
    return coverage_of(within, runs or len(held_out))


def coverage_of(within: Bool[np.ndarray, " trajectory"], runs: int) -> Coverage:
    """Return the coverage of trajectories.

    Args:
        within: whether all bounds held on a trajectory.
        runs: number of independent runs that the trajectories were cut from.
    """
    share = float(np.mean(within))
    return Coverage(
        share=share,
        # Segments of the same run are dependent, so that the interval counts runs.
        ci95=coverage_interval(share, runs),
        trajectories=len(within),
        runs=runs,
    )


def coverage_interval(share: float, runs: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a coverage (Clopper and Pearson, 1934).

    If the share lies between two counts of runs, the interval contains those of both.
    """
    fewer = math.floor(share * runs + ROUNDING)
    more = math.ceil(share * runs - ROUNDING)
    # At the counts 0 and `runs` the ends are exact, and betaincinv is undefined.
    low = betaincinv(fewer, runs - fewer + 1, 0.025) if fewer else 0.0
    high = betaincinv(more + 1, runs - more, 0.975) if more < runs else 1.0
    return float(low), float(high)
