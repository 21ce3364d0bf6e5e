"""Random perturbations of a plan, with the same variance at every step."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sfkd_jax.control.planners._planner import Planner, Plans
from sfkd_jax.ranges import AtLeastOne, AtLeastTwo, UnitInterval, check_choice
from sfkd_jax.types import Control, Key

KINDS = ("ar1", "white", "spline")


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplingPlanner(Planner):
    """A planner that perturbs a plan with noise out of standard normal numbers w.

        ar1     ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k
        white   ε_k = w_k
        spline  cubic Lagrange interpolation between w at equidistant knots

    Attributes:
        num_samples: M, plans that are sampled and rolled out per iteration.
        iterations: of sampling and choosing per control step.
        noise: "ar1", "white" or "spline".
        noise_correlation: ρ.
        noise_knots: number of knots, at most one a step.
    """

    num_samples: AtLeastOne = 1500
    iterations: AtLeastOne = 1
    noise: str = "ar1"
    noise_correlation: UnitInterval = 0.8
    noise_knots: AtLeastTwo = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("noise", self.noise, KINDS)
        if self.noise == "spline" and self.noise_knots > self.horizon:
            raise ValueError(
                f"noise_knots must lie in [2, {self.horizon}], got {self.noise_knots}"
            )

    def draw(self, key: Key, std: Control) -> Plans:
        """Return noise of a standard deviation for each control."""
        knots = self.noise_knots if self.noise == "spline" else self.horizon
        shape = (knots, self.num_samples, std.shape[0])
        white = jax.random.normal(key, shape)
        if self.noise == "white":
            return white * std[None, None]
        if self.noise == "ar1":
            factor = autoregression(self.horizon, self.noise_correlation)
        else:
            factor = spline(self.horizon, self.noise_knots)
            # Rows of unit length: the same spread at every step.
            factor = factor / np.linalg.norm(factor, axis=1, keepdims=True)
        # Full precision: accelerators otherwise round float32 factors to ten bits.
        table, exact = jnp.asarray(factor, dtype=float), jax.lax.Precision.HIGHEST
        noise = jnp.einsum("tk,kmc->tmc", table, white, precision=exact)
        # Scaled last: XLA would draw numbers one by one if a scale followed at once.
        return noise * std[None, None]


def autoregression(horizon: int, rho: float) -> Float[np.ndarray, "horizon horizon"]:
    """Weights of w in ε; ε_0 = w_0, which has the stationary variance already."""
    steps = np.arange(horizon)
    factor = np.tril(rho ** np.abs(steps[:, None] - steps))
    factor[:, 1:] *= np.sqrt(1.0 - rho**2)
    return factor


def spline(horizon: int, knots: int) -> Float[np.ndarray, "horizon knots"]:
    """Weights of cubic interpolation at each step between equidistant knots.

    With fewer than four knots, the order is lower.
    """
    times = np.arange(horizon)[:, None] * (knots - 1.0) / (horizon - 1.0)
    order = min(4, knots)
    # The four knots around a time; at the ends, the first or last four.
    first = np.clip(np.floor(times) - (order - 1) // 2, 0, knots - order)
    near = (first + np.arange(order)).astype(int)
    # Weights that reproduce the polynomials 1, t, …, around each time.
    powers = (near - times)[:, None] ** np.arange(order)[:, None]
    factor = np.zeros((horizon, knots))
    weights = np.linalg.solve(powers, np.eye(order)[:, :1])
    np.put_along_axis(factor, near, weights[..., 0], axis=1)
    return factor
