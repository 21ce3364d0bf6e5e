"""What is measured, not proved: one-step disturbances on trajectories that no weight has seen."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import betaincinv

from sfkd_jax.core.rollouts import fibers_along, step_disturbances
from sfkd_jax.types import Model, Params, Trajectory


class Disturbance(NamedTuple):
    """Per trajectory, the largest one-step disturbance of each kind, (trajectory, kind).

    Kinds: latent |d_k|, position of the pose increment [m], its yaw [rad], body state
    (2-norm in its own units).
    """

    scores: Float[np.ndarray, "trajectory 4"]


KINDS = ("latent", "position", "yaw", "body")
ROUNDING = 1e-9
"""Far above what share times count loses to rounding."""
CHUNK = 50
"""Trajectories in one batch."""


def disturbances(model: Model, params: Params, trajectories: Trajectory) -> Disturbance:
    """One-step residuals from true states, transport defect and switch steps included; maximum over each trajectory."""
    count = trajectories.controls.shape[0]
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
    return Disturbance(scores[:count])


@partial(jax.jit, static_argnums=0)
def _largest(
    model: Model, params: Params, trajectories: Trajectory
) -> Float[Array, "trajectory 4"]:
    """The same for a batch of one fixed size, so that splits of any length share a compilation."""

    def one(trajectory: Trajectory) -> Float[Array, " 4"]:
        fibers, later = fibers_along(model, params, trajectory)
        origin = model.encode(
            jax.tree.map(lambda leaf: leaf[0], fibers), trajectory.states[0]
        )
        each = jax.vmap(
            partial(step_disturbances, model), in_axes=(0, 0, None, 0, 0, 0)
        )
        found = each(
            fibers,
            later,
            origin,
            trajectory.states[:-1],
            trajectory.controls,
            trajectory.states[1:],
        )
        return jnp.max(found, axis=0)

    return jax.vmap(one)(trajectories)


def conformal_quantile(scores: Float[np.ndarray, " trajectory"], level: float) -> float:
    """The ⌈(n+1) level⌉-th smallest of n scores: a new, exchangeable score exceeds it with probability ≤ 1 − level.

    Raises:
        ValueError: too few scores for the level, a level that is none, or scores that
            are not finite.
    """
    if not 0 < level < 1:
        raise ValueError(f"a level must lie between 0 and 1, got {level}")
    if not np.all(np.isfinite(scores)):
        raise ValueError("residuals are not finite")
    if not supports(len(scores), level):
        raise ValueError(
            f"{len(scores)} calibration trajectories are too few for level {level}"
        )
    return float(np.sort(scores)[math.ceil((len(scores) + 1) * level) - 1])


def supports(count: int, level: float) -> bool:
    """Whether ⌈(n+1) level⌉ ≤ n: of fewer scores none is high enough for the level."""
    return math.ceil((count + 1) * level) <= count


def even_units(reference: Disturbance) -> Float[np.ndarray, " 4"]:
    """Units in which all kinds are alike: the 95 % quantiles of another split than the one that is calibrated on."""
    return _quantiles(reference, np.full(len(KINDS), 0.95))


def tube_units(reference: Disturbance, *, level: float) -> Float[np.ndarray, " 4"]:
    """Units in which the latent kind decides: its quantile at `level`; the others' one is missed a tenth as often.

    Every tube multiplies the latent bound by up to 1/(1 − α) and adds the others once:
    what makes the others wider and the latent one tighter makes the tube tighter.
    """
    return _quantiles(
        reference,
        np.where(np.asarray(KINDS) == "latent", level, 1.0 - 0.1 * (1.0 - level)),
    )


def _quantiles(
    reference: Disturbance, shares: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, " 4"]:
    """A quantile of each kind; 1 of a kind that is always 0.

    Raises:
        ValueError: scores that are not finite.
    """
    if not np.all(np.isfinite(reference.scores)):
        raise ValueError("residuals are not finite")
    found = np.asarray(
        [
            np.quantile(kind, share)
            for kind, share in zip(reference.scores.T, shares, strict=True)
        ]
    )
    return np.where(found > 0, found, 1.0)


def conformal_bounds(
    units: Float[np.ndarray, " 4"], calibration: Disturbance, *, level: float
) -> Float[np.ndarray, " 4"]:
    """Bounds on all four kinds at once, valid for a whole new trajectory with probability ≥ level.

    Split-conformal: the score of a trajectory is its largest kind in `units`, which
    another split fixed beforehand; the bound is the ⌈(n+1) level⌉-th smallest
    calibration score.

    Raises:
        ValueError: too few trajectories for the level, or scores that are not finite.
    """
    return units * conformal_quantile(np.max(calibration.scores / units, axis=1), level)


def coverage(bounds: Float[np.ndarray, " 4"], held_out: Disturbance) -> float:
    """Share of held-out trajectories inside all four bounds."""
    return float(np.mean(np.all(held_out.scores <= bounds, axis=1)))


def interval(share: float, drives: int) -> list[float]:
    """95 % interval of a share counted on trajectories that were cut from so many independent drives.

    Clopper-Pearson of `drives` trials; where the share falls between two counts, from
    the lower one to the upper one.
    """
    counts = math.floor(share * drives + ROUNDING), math.ceil(share * drives - ROUNDING)
    return [clopper_pearson(count, drives)[side] for side, count in enumerate(counts)]


def clopper_pearson(
    successes: int, trials: int, *, level: float = 0.95
) -> tuple[float, float]:
    """The exact interval of a binomial proportion (Clopper and Pearson, 1934)."""
    tail, failures = 0.5 * (1.0 - level), trials - successes
    low = betaincinv(successes, failures + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, failures, 1.0 - tail) if failures else 1.0
    return float(low), float(high)
