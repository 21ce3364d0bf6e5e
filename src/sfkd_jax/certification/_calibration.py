"""Measured one-step disturbances and their split-conformal bounds."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import betaincinv

from sfkd_jax.rollout import fibers_along, step_disturbances
from sfkd_jax.types import Model, Params, Trajectory

KINDS = ("latent", "position", "yaw", "body")
ROUNDING = 1e-9
"""Far above the rounding error of a share times a count."""
CHUNK = 50
"""Trajectories in a batch."""


def disturbances(
    model: Model, params: Params, trajectories: Trajectory
) -> Float[np.ndarray, "trajectory 4"]:
    """Return the largest one-step disturbances of each trajectory, by `KINDS`.

    Latent |d_k|, position of the pose increment [m], its yaw [rad], and body state
    (2-norm in its own units). Every step starts at the true state. Transport defects
    and switches of e count.

    Args:
        model: any model.
        params: its weights.
        trajectories: a batch.
    """
    count = trajectories.controls.shape[0]
    # The last batch is filled up, so that one program serves all batches
    filled = jax.tree.map(
        lambda leaf: leaf[jnp.arange(-(-count // CHUNK) * CHUNK) % count], trajectories
    )
    parts = [
        jax.tree.map(lambda leaf, k=k: leaf[k : k + CHUNK], filled)
        for k in range(0, count, CHUNK)
    ]
    scores = np.concatenate(
        [np.asarray(_largest(model, params, part), dtype=np.float64) for part in parts]
    )
    return scores[:count]


@partial(jax.jit, static_argnums=0)
def _largest(
    model: Model, params: Params, trajectories: Trajectory
) -> Float[Array, "trajectory 4"]:
    """`disturbances` of one batch of fixed size."""

    def one(trajectory: Trajectory) -> Float[Array, " 4"]:
        fibers, later = fibers_along(model, params, trajectory)
        # One frame for the whole trajectory, in which z of all steps are comparable.
        origin = model.encode(
            jax.tree.map(lambda leaf: leaf[0], fibers), trajectory.states[0]
        )
        each = jax.vmap(
            partial(step_disturbances, model), in_axes=(0, 0, None, 0, 0, 0)
        )
        kinds = each(
            fibers,
            later,
            origin,
            trajectory.states[:-1],
            trajectory.controls,
            trajectory.states[1:],
        )
        # The largest over time: a bound is about whole trajectories, not about steps.
        return jnp.max(kinds, axis=0)

    return jax.vmap(one)(trajectories)


def conformal_quantile(scores: Float[np.ndarray, " trajectory"], level: float) -> float:
    """Return the ⌈(n+1) level⌉-th smallest of n scores.

    A new, exchangeable score exceeds it with probability at most 1 − level.

    Args:
        scores: of calibration trajectories or runs.
        level: 1 − δ.

    Raises:
        ValueError: too few scores for the level, a level outside (0, 1), or scores that
            are not finite.
    """
    if not 0 < level < 1:
        raise ValueError(f"a level must lie between 0 and 1, got {level}")
    # An infinite score would be sorted last and silently dropped from the quantile.
    if not np.all(np.isfinite(scores)):
        raise ValueError("residuals are not finite")
    if not supports(len(scores), level):
        raise ValueError(
            f"{len(scores)} calibration trajectories are too few for level {level}"
        )
    # (n + 1): the new trajectory counts as one of the exchangeable ones.
    return float(np.sort(scores)[math.ceil((len(scores) + 1) * level) - 1])


def supports(count: int, level: float) -> bool:
    """Whether `count` scores suffice for a conformal quantile: ⌈(n+1) level⌉ ≤ n."""
    return math.ceil((count + 1) * level) <= count


def tube_units(
    reference: Float[np.ndarray, "trajectory kind"], *, level: float
) -> Float[np.ndarray, " kind"]:
    """Return units in which the first kind decides the conformal score.

    Its unit is its quantile at `level`; the other kinds exceed their units a tenth as
    often. A tube multiplies the latent bound by up to 1/(1 − α) and adds the others
    once, so these units make it tighter than equal quantiles do.

    Args:
        reference: scores of a split other than the one for calibration.
        level: of the conformal bounds.

    Raises:
        ValueError: scores that are not finite.
    """
    if not np.all(np.isfinite(reference)):
        raise ValueError("residuals are not finite")
    # The other kinds share a tenth of the exceedances: the first kind decides.
    shares = [level, *[1.0 - 0.1 * (1.0 - level)] * (reference.shape[1] - 1)]
    kinds = zip(reference.T, shares, strict=True)
    quantiles = np.asarray([np.quantile(kind, share) for kind, share in kinds])
    # A kind that is always 0 needs no unit
    return np.where(quantiles > 0, quantiles, 1.0)


def conformal_bounds(
    units: Float[np.ndarray, " kind"],
    calibration: Float[np.ndarray, "trajectory kind"],
    *,
    level: float,
) -> Float[np.ndarray, " kind"]:
    """Return joint bounds on all kinds over a whole new trajectory (split-conformal).

    They hold with probability at least `level`. The score of a trajectory is its
    largest kind in `units`; the bound is the ⌈(n+1) level⌉-th smallest score.

    Args:
        units: of each kind, from a split other than `calibration`.
        calibration: scores of the calibration split.
        level: 1 − δ.

    Raises:
        ValueError: too few trajectories for the level, or scores that are not finite.
    """
    # The largest kind of each trajectory in common units: one score, a joint bound.
    return units * conformal_quantile(np.max(calibration / units, axis=1), level)


def coverage(
    bounds: Float[np.ndarray, " kind"],
    held_out: Float[np.ndarray, "trajectory kind"],
    runs: int | None = None,
) -> dict[str, object]:
    """Return the share of held-out trajectories within all bounds, and its interval.

    Args:
        bounds: on each kind.
        held_out: scores of independent trajectories.
        runs: number of independent runs that they were cut from; by default every
            trajectory is one.
    """
    count, share = len(held_out), float(np.mean(np.all(held_out <= bounds, axis=1)))
    return {
        "coverage": share,
        # Segments of one run are dependent: the interval is of independent runs.
        "coverage_ci95": coverage_interval(share, runs or count),
        "coverage_trajectories": count,
        "coverage_runs": runs or count,
    }


def coverage_interval(share: float, runs: int) -> list[float]:
    """Return the 95 % Clopper-Pearson interval of a coverage.

    If the share lies between two counts, the interval covers those of both.

    Args:
        share: of trajectories that were covered.
        runs: number of independent runs that the trajectories were cut from.
    """
    # Both sides rounded outwards: the interval is wider than either count's.
    counts = math.floor(share * runs + ROUNDING), math.ceil(share * runs - ROUNDING)
    return [clopper_pearson(count, runs)[side] for side, count in enumerate(counts)]


def clopper_pearson(
    successes: int, trials: int, *, level: float = 0.95
) -> tuple[float, float]:
    """Return the exact interval of a binomial share (Clopper and Pearson, 1934)."""
    tail, failures = 0.5 * (1.0 - level), trials - successes
    # With no success the lower end is 0 exactly, where betaincinv is undefined.
    low = betaincinv(successes, failures + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, failures, 1.0 - tail) if failures else 1.0
    return float(low), float(high)
