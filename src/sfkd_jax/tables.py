"""Tables over evenly divided axes, and multilinear interpolation in them."""

from __future__ import annotations

from itertools import product
from math import prod

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def corners(
    at: Float[Array, " axis"],
    low: Float[Array, " axis"],
    high: Float[Array, " axis"],
    counts: tuple[int, ...],
) -> tuple[Int[Array, " corner"], Float[Array, " corner"]]:
    """Return flat indices and weights of grid points for multilinear interpolation.

    Args:
        at: where to interpolate.
        low: lower ends of the axes.
        high: upper ends of the axes.
        counts: number of grid points on each axis.
    """
    last = np.asarray(counts) - 1
    # Outside the axes the value at their ends is used, never an extrapolated one.
    position = jnp.clip((at - low) / (high - low), 0.0, 1.0) * last
    # The index is at most that of the last but one point, so it has an upper neighbour.
    index = jnp.minimum(jnp.floor(position).astype(int), last - 1)
    beyond = position - index
    sides = np.asarray(list(product((0, 1), repeat=len(counts))))
    strides = np.asarray([prod(counts[axis + 1 :]) for axis in range(len(counts))])
    weights = jnp.prod(jnp.where(sides == 1, beyond, 1.0 - beyond), axis=1)
    return jnp.sum(index * strides) + sides @ strides, weights


def interpolated(
    table: Float[Array, "*axes_and_shape"],
    rows: Int[Array, " corner"],
    weights: Float[Array, " corner"],
    axes: int,
) -> Float[Array, "*shape"]:
    """Return the value of a table at the place of some corners.

    Args:
        table: values over the grid.
        rows: of `corners`.
        weights: of `corners`.
        axes: number of axes of the grid; the further ones are those of a value.
    """
    points = table.reshape(-1, *table.shape[axes:])
    return jnp.tensordot(weights, points[rows], 1)
