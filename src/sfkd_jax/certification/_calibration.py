"""What is measured, not proved: one-step disturbances on trajectories that no weight has seen."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.rollouts import defects
from sfkd_jax.se2 import between
from sfkd_jax.types import BODY, POSE, Model, Params, Trajectory


class Disturbance(NamedTuple):
    """Per trajectory, the largest one-step disturbance of each kind, (trajectory, kind).

    Kinds: latent |d_k|, position of the pose increment [m], its yaw [rad], body state (2-norm in its own units).
    """

    scores: Float[np.ndarray, "trajectory 4"]


KINDS = ("latent", "position", "yaw", "body")


def disturbances(model: Model, params: Params, trajectories: Trajectory) -> Disturbance:
    """One-step residuals from true states, transport defect and switch steps included; maximum over each trajectory."""

    def one(trajectory: Trajectory) -> Float[Array, " 4"]:
        gap, predicted = defects(model, params, trajectory)
        before, after = trajectory.states[:-1, POSE], trajectory.states[1:, POSE]
        motion = jax.vmap(between)(before, predicted[:, POSE]) - jax.vmap(between)(before, after)
        body = predicted[:, BODY] - trajectory.states[1:, BODY]
        kinds = (gap, motion[:, :2], motion[:, 2:], body)
        return jnp.stack([jnp.max(jnp.linalg.norm(kind, axis=1)) for kind in kinds])

    scores = jax.jit(lambda data: jax.lax.map(one, data, batch_size=64))(trajectories)
    return Disturbance(np.asarray(scores, dtype=np.float64))


def conformal_bounds(
    reference: Disturbance, calibration: Disturbance, *, level: float
) -> tuple[Float[np.ndarray, " 4"], float]:
    """Bounds on all four kinds at once, valid for a whole new trajectory with probability ≥ level.

    Split-conformal: the score of a trajectory is its largest kind in units of `reference`'s 95 % quantiles (another
    split, so the units are fixed beforehand); the bound is the ⌈(n+1) level⌉-th smallest calibration score.

    Raises:
        ValueError: too few trajectories for the level, or scores that are not finite.
    """
    if not np.all(np.isfinite(reference.scores)) or not np.all(np.isfinite(calibration.scores)):
        raise ValueError("residuals are not finite")
    units = np.quantile(reference.scores, 0.95, axis=0)
    units = np.where(units > 0, units, 1.0)
    scores = np.sort(np.max(calibration.scores / units, axis=1))
    rank = math.ceil((len(scores) + 1) * level)
    if rank > len(scores):
        raise ValueError(f"{len(scores)} calibration trajectories are too few for level {level}")
    return units * scores[rank - 1], float(scores[rank - 1])


def coverage(bounds: Float[np.ndarray, " 4"], held_out: Disturbance) -> tuple[float, tuple[float, float]]:
    """Share of held-out trajectories inside all four bounds, with its 95 % Clopper-Pearson interval."""
    inside = int(np.sum(np.all(held_out.scores <= bounds, axis=1)))
    return inside / len(held_out.scores), clopper_pearson(inside, len(held_out.scores))


def clopper_pearson(successes: int, trials: int, *, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a binomial proportion, by bisection on the binomial tail."""
    tail = (1 - level) / 2

    def at_least(p: float, count: int) -> float:
        """P(X ≥ count), X ~ Binomial(trials, p), summed in logs."""
        ks = np.arange(count, trials + 1)
        logs = np.array([math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1) for k in ks])
        return float(np.sum(np.exp(logs + ks * math.log(p) + (trials - ks) * math.log1p(-p))))

    def bisect(count: int, target: float) -> float:
        """The p at which P(X ≥ count) reaches the target; it grows with p."""
        low, high = 1e-12, 1 - 1e-12
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if at_least(middle, count) < target else (low, middle)
        return 0.5 * (low + high)

    lower = 0.0 if successes == 0 else bisect(successes, tail)
    upper = 1.0 if successes == trials else bisect(successes + 1, 1 - tail)
    return lower, upper
