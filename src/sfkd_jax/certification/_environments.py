"""Interval branch and bound over a box of environments."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.certification._core import Matrix, Vector
from sfkd_jax.types import Hypernetwork

WIDENED = 1 + 1e-9
"""Factor on the radius of intervals in place of directed rounding in float64."""
Box: TypeAlias = Sequence[Any]
"""Lower and upper corner of a box of environments."""


class BoxBound(NamedTuple):
    """A bound for every environment of a box.

    Attributes:
        upper: upper bound, valid in the whole box.
        lower: value reached at the centre of a cell.
        cells: number of cells.
    """

    upper: float
    lower: float
    cells: int


def bound_over_box(
    network: Hypernetwork,
    box: Box,
    bound_at: Callable[[Matrix], float],
    *,
    tolerance: float = 0.01,
    most_cells: int = 50_000,
) -> BoxBound:
    """Bound b(A(e)) over all e in the box, for a b with |b(A) − b(A')| ≤ ||A − A'||_2.

    On a cell with centre c and half widths h, by the mean value theorem with an
    interval Jacobian M_k ± R_k,

        b(A(e)) ≤ b(A(c)) + Σ_k h_k (||M_k||_2 + ||R_k||_F).

    The cell with the largest bound is halved along the axis with the largest term of
    the sum, until that bound is within `tolerance` of a value reached. If `most_cells`
    is reached first, the bound is valid but less tight.

    Args:
        network: e ↦ A(e).
        box: lower and upper corner.
        bound_at: b, for example `norm_upper`.
        tolerance: relative.
        most_cells: maximum number of cells.
    """
    low, high = (np.asarray(side, dtype=np.float64) for side in box)
    first = _cell(network, 0.5 * (low + high), 0.5 * (high - low), bound_at)
    heap, lower, opened = [(-first[0], 0, first)], first[1], 1
    while -heap[0][0] > lower * (1 + tolerance) and opened < most_cells:
        _, _, (_, _, centre, half, costs) = heapq.heappop(heap)
        axis = int(np.argmax(costs))
        shift = np.where(np.arange(len(half)) == axis, 0.5 * half, 0.0)
        for side in (centre - shift, centre + shift):
            cell = _cell(network, side, half - shift, bound_at)
            lower = max(lower, cell[1])
            opened += 1
            heapq.heappush(heap, (-cell[0], opened, cell))
    return BoxBound(-heap[0][0], lower, opened)


def operator_at(network: Hypernetwork, env: Vector) -> Matrix:
    """Return A(e) in float64."""
    hidden = np.asarray(env, dtype=np.float64)
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        hidden = np.tanh(weight @ hidden + bias)
    entries = network.weights[-1] @ hidden + network.biases[-1]
    return np.asarray(entries).reshape(round(len(entries) ** 0.5), -1)


def _cell(
    network: Hypernetwork,
    centre: Vector,
    half: Vector,
    bound_at: Callable[[Matrix], float],
) -> tuple[float, float, Vector, Vector, Float[np.ndarray, " axis"]]:
    """Upper bound on a cell, value at its centre, the cell, the terms of the sum."""
    middle, radius = _interval_jacobian(network, centre, half)
    size = round(len(middle) ** 0.5)
    costs = [
        width * (np.linalg.norm(m.reshape(size, size), 2) + np.linalg.norm(r))
        for width, m, r in zip(half, middle.T, radius.T, strict=True)
    ]
    value = bound_at(operator_at(network, centre))
    return value + WIDENED * sum(costs), value, centre, half, np.asarray(costs)


def _interval_jacobian(
    network: Hypernetwork, centre: Vector, half: Vector
) -> tuple[Matrix, Matrix]:
    """Middle and radius of the Jacobian of vec A over a cell (interval arithmetic)."""
    low, high = centre - half, centre + half
    middle, radius = np.eye(len(centre)), np.zeros((len(centre), len(centre)))
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        point = weight @ (0.5 * (low + high)) + bias
        spread = np.abs(weight) @ (0.5 * (high - low)) * WIDENED
        low, high = np.tanh(point - spread), np.tanh(point + spread)
        far = np.maximum(np.abs(low), np.abs(high))
        near = np.where(low * high <= 0, 0.0, np.minimum(np.abs(low), np.abs(high)))
        slope = 1.0 - 0.5 * (near**2 + far**2)
        half_slope = 0.5 * (far**2 - near**2) * WIDENED + 1e-15
        middle, radius = weight @ middle, np.abs(weight) @ radius
        radius = (slope + half_slope)[:, None] * radius
        radius = radius + half_slope[:, None] * np.abs(middle)
        middle = slope[:, None] * middle
    last = np.asarray(network.weights[-1])
    return last @ middle, np.abs(last) @ radius * WIDENED
