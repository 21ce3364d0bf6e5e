"""Measured one-step errors, and split-conformal bounds on what was measured."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import betaincinv

from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, between
from sfkd_jax.rollout import rollout
from sfkd_jax.types import BODY, POSE, Model, Params, Trajectory

KINDS = ("latent", "position", "yaw", "body")
ROUNDING = 1e-9
"""Far above the rounding error of a share times a count."""
CHUNK = 50
"""Runs in a batch."""
TAIL = 0.1
"""Part of the runs whose largest values are fitted."""


class Residuals(NamedTuple):
    """One-step prediction errors of every step of a run, (run, time, …)."""

    gaps: Float[np.ndarray, "run time rank"]  # d_k in latent coordinates
    # 2-norms of the errors of position [m], yaw [rad] and body state; along a path of
    # e_y [m], e_ψ [rad] and the vehicle's own body state.
    outputs: Float[np.ndarray, "run time 3"]

    def largest(self) -> Float[np.ndarray, "run 4"]:
        """Return the largest errors of each run, by `KINDS`.

        A bound is about whole runs, not about steps.
        """
        sizes = np.linalg.norm(self.gaps, axis=-1)
        return np.column_stack([np.max(sizes, axis=1), np.max(self.outputs, axis=1)])


def residuals(model: Model, params: Params, runs: Trajectory) -> Residuals:
    """Measure the error of every step from its true state.

    Transport defects and switches of e count.
    """
    count = runs.controls.shape[0]
    # The last batch is filled up, so that one program serves all batches
    filled = jnp.arange(-(-count // CHUNK) * CHUNK).reshape(-1, CHUNK) % count
    batches = [
        _errors(model, params, jax.tree.map(lambda leaf, rows=rows: leaf[rows], runs))
        for rows in filled
    ]
    gaps, outputs = (
        np.concatenate([np.asarray(part, np.float64) for part in parts])[:count]
        for parts in zip(*batches, strict=True)
    )
    return Residuals(gaps, outputs)


@partial(jax.jit, static_argnums=0)
def _errors(model: Model, params: Params, runs: Trajectory) -> tuple[Array, Array]:
    """`residuals` of one batch of fixed size."""

    def one(run: Trajectory) -> tuple[Array, Array]:
        known = rollout(model, params, run)
        before = run.states[:-1]
        after = run.states[1:]
        miss = (known.single - after)[:, BODY]
        if model.along_path:
            # Path states have their outputs in the body, without a pose.
            kinds = miss[:, LATERAL, None], miss[:, HEADING, None], miss[:, PATH_SPEED:]
        else:
            # As motions of one step: each turns far less than π, so no wrap spoils it.
            moved = jax.vmap(between)
            motion = moved(before[:, POSE], known.single[:, POSE])
            motion -= moved(before[:, POSE], after[:, POSE])
            kinds = motion[:, :2], motion[:, 2:], miss
        sizes = jnp.stack([jnp.linalg.norm(kind, axis=1) for kind in kinds], 1)
        return known.defects, sizes

    return jax.vmap(one)(runs)


def conformal_quantile(scores: Float[np.ndarray, " trajectory"], level: float) -> float:
    """Return the ⌈(n+1) level⌉-th smallest of n scores.

    A new, exchangeable score exceeds it with probability at most 1 − level. Infinite
    scores are those of runs that no bound holds for.
    """
    if np.any(np.isnan(scores)):
        raise ValueError("residuals are not finite")
    check_count(len(scores), level, "calibration trajectories")
    # (n + 1): the new trajectory counts as one of the exchangeable ones.
    found = float(np.sort(scores)[math.ceil((len(scores) + 1) * level) - 1])
    # Too many runs without a bound: there is none at this level.
    if found == math.inf:
        raise ValueError(
            f"residuals of {np.sum(np.isinf(scores))} of {len(scores)} runs are not "
            f"finite: more than level {level} allows"
        )
    return found


def supports(count: int, level: float) -> bool:
    """Whether `count` scores suffice for a conformal quantile: ⌈(n+1) level⌉ ≤ n."""
    return math.ceil((count + 1) * level) <= count


def check_count(count: int, level: float, what: str) -> None:
    """Refuse a level that `count` scores, of so many `what`, do not support."""
    if not supports(count, level):
        # Rounded down, so that the proposed level is accepted.
        highest = math.floor(100 * count / (count + 1)) / 100
        raise ValueError(
            f"{count} {what} are too few for certification.level={level:g}: "
            f"record more, or pass certification.level={highest:g}"
        )


def holds_for(runs: int, level: float) -> str:
    """Return what a bound from trajectories of so many independent runs is about."""
    if supports(runs, level):
        return "new runs like these"
    return f"further segments of the same {runs} runs"


def conformal_bounds(
    reference: Float[np.ndarray, "other kind"],
    calibration: Float[np.ndarray, "trajectory kind"],
    *,
    level: float,
) -> Float[np.ndarray, " kind"]:
    """Return joint bounds on all kinds over a whole new trajectory (split-conformal).

    They hold with probability at least `level`. The score of a trajectory is its
    largest kind in units; the bound is the ⌈(n+1) level⌉-th smallest score. The unit of
    the first kind is its quantile at `level`; the other kinds exceed theirs a tenth as
    often. A tube multiplies the first bound by up to 1/(1 − α) and adds the others
    once, so these units make it tighter than equal quantiles do. `reference` are
    scores that fix the units, of a split other than `calibration`.
    """
    if not 0 < level < 1:
        raise ValueError(f"a level must lie between 0 and 1, got {level}")
    if not np.all(np.isfinite(reference)):
        raise ValueError("residuals are not finite")
    shares = [level, *[1.0 - 0.1 * (1.0 - level)] * (reference.shape[1] - 1)]
    kinds = zip(reference.T, shares, strict=True)
    units = np.asarray([np.quantile(kind, share) for kind, share in kinds])
    units[units <= 0] = 1.0  # a kind that is always 0 needs no unit
    # The largest kind of each trajectory in common units: one score, a joint bound.
    return units * conformal_quantile(np.max(calibration / units, axis=1), level)


def alarm_thresholds(
    reference: Float[np.ndarray, "other chart"],
    maxima: Float[np.ndarray, "run chart"],
    *,
    rate: float,
) -> Float[np.ndarray, " chart"]:
    """Return thresholds that a share `rate` of new runs exceeds in any chart.

    The unit of a chart is its 0.99-quantile over `reference`. The largest value of a
    run in units has a tail that is taken as exponential, fitted to the largest `TAIL`:
    a rate below one in a run cannot be counted on any affordable number of runs.
    """
    units = np.quantile(reference, 0.99, axis=0)
    units[units <= 0] = 1.0
    largest = np.max(maxima / units, axis=1)
    start = np.quantile(largest, 1.0 - TAIL)
    excess = float(np.mean(largest[largest > start] - start))
    return units * (start + excess * max(math.log(TAIL / rate), 0.0))


def coverage(
    bounds: Float[np.ndarray, " kind"],
    held_out: Float[np.ndarray, "trajectory kind"],
    runs: int | None = None,
) -> dict[str, Any]:
    """Return the share of held-out trajectories within all bounds, and its interval.

    They were cut from `runs` independent runs; by default every trajectory is one.
    """
    share = float(np.mean(np.all(held_out <= bounds, axis=1)))
    runs = runs or len(held_out)
    return {
        "coverage": share,
        # Segments of one run are dependent: the interval is of independent runs.
        "coverage_ci95": coverage_interval(share, runs),
        "coverage_trajectories": len(held_out),
        "coverage_runs": runs,
    }


def coverage_interval(share: float, runs: int) -> list[float]:
    """Return the exact 95 % interval of a coverage (Clopper and Pearson, 1934).

    If the share lies between two counts of runs, the interval covers those of both.
    """
    # Both sides rounded outwards: the interval is wider than either count's.
    few = math.floor(share * runs + ROUNDING)
    many = math.ceil(share * runs - ROUNDING)
    # At 0 and 1 the ends are exact, where betaincinv is undefined.
    low = betaincinv(few, runs - few + 1, 0.025) if few else 0.0
    high = betaincinv(many + 1, runs - many, 0.975) if many < runs else 1.0
    return [float(low), float(high)]
