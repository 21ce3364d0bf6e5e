"""Planners that sample plans, and the noise that they perturb a plan with."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sfkd_jax.control.planners._planner import Planner
from sfkd_jax.control.planners._rollouts import Plans
from sfkd_jax.ranges import AtLeastOne, AtLeastTwo, UnitInterval, check_choice
from sfkd_jax.types import Control, Key

DEVICES = "samples"
"""Axis of a mesh of devices over which samples are spread."""
NOISE_KINDS = ("ar1", "white", "spline")


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplingPlanner(Planner):
    """A planner that perturbs a plan with noise, made from standard normal numbers w.

        ar1     ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k
        white   ε_k = w_k
        spline  cubic Lagrange interpolation between w at equidistant knots

    Attributes:
        num_samples: M, the number of plans that are sampled and rolled out in each
            iteration.
        iterations: number of times per control step that plans are sampled and a plan
            is chosen.
        noise: "ar1", "white" or "spline".
        noise_correlation: ρ.
        noise_knots: number of knots, at most one for each step.
    """

    num_samples: AtLeastOne = 1500
    iterations: AtLeastOne = 1
    noise: str = "ar1"
    noise_correlation: UnitInterval = 0.8
    noise_knots: AtLeastTwo = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("noise", self.noise, NOISE_KINDS)
        if self.noise == "spline" and self.noise_knots > self.horizon:
            raise ValueError(
                f"noise_knots must lie in [2, {self.horizon}], got {self.noise_knots}"
            )

    def draw(self, key: Key, std: Control) -> Plans:
        """Return noise for all samples, with one standard deviation for each control.

        The noise is a matrix of weights times white noise. White noise has such a
        matrix as well (the identity): without a product, XLA would draw the numbers one
        by one where they are scaled.
        """
        weights = self._weights()
        shape = (weights.shape[1], self.num_samples, std.shape[0])
        white = spread(jax.random.normal(key, shape))
        # In full precision, because accelerators round factors to ten bits.
        noise = jnp.einsum(
            "tk,kmc->tmc",
            jnp.asarray(weights, dtype=float),
            white,
            precision=jax.lax.Precision.HIGHEST,
        )
        return noise * std[None, None]

    def _weights(self) -> Float[np.ndarray, "horizon number"]:
        """Return the weights of w in ε; every row has length 1."""
        if self.noise == "ar1":
            return autoregression(self.horizon, self.noise_correlation)
        if self.noise == "white":
            return autoregression(self.horizon, 0.0)
        weights = spline(self.horizon, self.noise_knots)
        # With rows of length 1 the noise has the same spread at every step.
        return weights / np.linalg.norm(weights, axis=1, keepdims=True)


def spread(noise: Plans) -> Plans:
    """Return the noise, with its samples spread over devices.

    The rollouts of the samples are then spread as well. This needs a program that is
    traced under `jax.set_mesh` of a mesh with an axis `DEVICES`; elsewhere the noise is
    returned unchanged.
    """
    mesh = jax.sharding.get_abstract_mesh()
    axis_types = dict(zip(mesh.axis_names, mesh.axis_types, strict=True))
    if DEVICES not in axis_types:
        return noise
    if axis_types[DEVICES] != jax.sharding.AxisType.Auto:
        raise ValueError(f"the mesh's axis {DEVICES!r} must be of type AxisType.Auto")
    axes = jax.sharding.PartitionSpec(None, DEVICES)
    return jax.lax.with_sharding_constraint(noise, axes)


def autoregression(horizon: int, rho: float) -> Float[np.ndarray, "horizon horizon"]:
    """Return the weights of w in ε of first order autoregressive noise.

    ε_0 = w_0 already has the stationary variance.
    """
    steps = np.arange(horizon)
    weights = np.tril(rho ** np.abs(steps[:, None] - steps))
    weights[:, 1:] *= np.sqrt(1.0 - rho**2)
    return weights


def spline(horizon: int, knots: int) -> Float[np.ndarray, "horizon knots"]:
    """Return the weights of equidistant knots in a cubic interpolation at each step.

    With fewer than four knots, the order of the interpolation is lower.
    """
    times = np.arange(horizon)[:, None] * (knots - 1.0) / (horizon - 1.0)
    order = min(4, knots)
    # The four knots around a time; at the ends, the first or last four.
    first = np.clip(np.floor(times) - (order - 1) // 2, 0, knots - order)
    near = (first + np.arange(order)).astype(int)
    # These weights reproduce the polynomials 1, t, … around each time.
    powers = (near - times)[:, None] ** np.arange(order)[:, None]
    near_weights = np.linalg.solve(powers, np.eye(order)[:, :1])
    weights = np.zeros((horizon, knots))
    np.put_along_axis(weights, near, near_weights[..., 0], axis=1)
    return weights
