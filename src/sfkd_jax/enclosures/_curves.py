"""Functions of one number, applied to forms; and softmax."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool

from sfkd_jax.enclosures._forms import (
    MARGIN,
    UNIT,
    Array,
    Form,
    Pairs,
    aligned,
    kept_pairs,
    rounded,
)

Bounds: TypeAlias = Callable[[Array, Array], tuple[Array, Array]]
LIBRARY = 32 * UNIT
"""Relative error of tanh, exp, sin, cos and sqrt of numpy; a few UNIT are stated."""
SLACK = 1e-13
"""Above the errors of numbers of about 1 that are made of a few values of these."""


class Curve(NamedTuple):
    """A function of one number, with what encloses it.

    Attributes:
        value: g(c).
        slope: g'(c).
        bend: g''(c).
        curvature: ends of an interval -> bounds of g'' there.
        third: ends of an interval -> a bound of the size of the third derivative.
        span: ends of an interval -> bounds of g there, or None.
    """

    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    bend: Callable[[Array], Array]
    curvature: Bounds
    third: Callable[[Array, Array], Array]
    span: Bounds | None = None


def applied(curve: Curve, form: Form) -> Form:
    """Return g(x) = g(c) + g'(c) (x - c) + g''(ζ) (x - c)² / 2 for a ζ in the range.

    Where x depends on curved variables, by L = Σ a_j ε_j of these, the quadratic part
    is g''(c) L² / 2, and what remains is at most

        |g''(c)| (|L| S + S² / 2) + |g'''(ζ)| |x - c|³ / 6,   S = |x - c - L|.

    Where the whole span of g is narrower than what remains, a constant with this span
    is the enclosure.
    """
    value = curve.value(form.centre)
    slope = curve.slope(form.centre)
    reach = form.radius + 4.0 * UNIT * form.size
    low = form.centre - reach
    high = form.centre + reach
    least, most = curve.curvature(low, high)
    below = 0.5 * form.radius**2 * np.minimum(least, 0.0)
    above = 0.5 * form.radius**2 * np.maximum(most, 0.0)
    shift = 0.5 * (below + above)
    rest = 0.5 * (above - below)
    kept = kept_pairs(form, form, form.curved)
    form = aligned(form, form.active, tuple(sorted({*form.pairs, *kept})))
    parts = form.parts * slope
    if kept:
        smaller = _third_order(curve, form, kept, curve.third(low, high))
        use = smaller < rest
        shift = np.where(use, 0.0, shift)
        rest = np.where(use, smaller, rest)
        half = np.where(use, 0.5 * curve.bend(form.centre), 0.0)
        for i, j in kept:
            product = (1.0 if i == j else 2.0) * form.slope(i) * form.slope(j)
            row = 1 + len(form.active) + form.pairs.index((i, j))
            parts[row] += half * product
    parts[0] = value + shift
    error = np.abs(slope) * form.error + rest
    error = error + 4.0 * LIBRARY * (
        np.abs(value) + (np.abs(slope) + 1.0) * form.radius
    )
    if curve.span is not None:
        bottom, top = curve.span(low, high)
        half = 0.5 * (top - bottom) + 8.0 * LIBRARY * np.maximum(abs(top), abs(bottom))
        flat = half < error
        error = np.where(flat, half, error)
        parts = np.where(flat, 0.0, parts)
        parts[0] = np.where(flat, 0.5 * (bottom + top), parts[0])
    sizes = np.abs(parts).sum(axis=0) + error + np.abs(shift) + np.abs(value)
    return rounded(form.of(parts, error), sizes, 8)


def _third_order(curve: Curve, form: Form, kept: Pairs, third: Array) -> Array:
    """Return what remains beside g''(c) L² / 2, see `applied`."""
    bend = np.abs(curve.bend(form.centre))
    indices = sorted({index for pair in kept for index in pair})
    along = np.zeros(())
    for index in indices:
        along = along + np.abs(form.slope(index))
    # Everything but L, with what rounding changes in the difference.
    beside = np.maximum(form.radius - along, 0.0) + 16.0 * UNIT * form.size
    remains = bend * (along * beside + 0.5 * beside**2) + third * form.radius**3 / 6.0
    return remains + 8.0 * LIBRARY * (bend + 1.0) * form.radius**2


def softmax(form: Form) -> Form:
    """Return softmax of a vector, from its second derivative along a segment.

    Along x + t v it is w_i ((v_i - v̄)² - Var v), for weights w somewhere on the segment
    and v̄ = Σ w_j v_j. With D_ij a bound of |v_i - v_j| and w_j ≤ h_j,

        w_i ≤ h_i = 1 / Σ_j exp(x_j - x_i - D_ij),
        |v_i - v̄| ≤ Σ_j h_j D_ij,   Var v ≤ Σ_j h_j D_jk² for every k.
    """
    form = form.linear
    centre = form.centre
    top = centre.max(axis=1, keepdims=True)
    raised = np.exp(centre - top)
    weights = raised / raised.sum(axis=1, keepdims=True)
    apart = np.abs(form.slopes[..., :, None] - form.slopes[..., None, :]).sum(axis=0)
    apart = apart + form.error[:, :, None] + form.error[:, None, :]
    apart = apart * (1.0 + MARGIN) + 8.0 * UNIT * form.size.max(axis=1)[:, None, None]
    below = np.exp(centre[:, None, :] - centre[:, :, None] - apart).sum(axis=2)
    # x_i - x_i is 0 and not within D_ii.
    own = np.exp(-np.diagonal(apart, axis1=1, axis2=2))
    highest = np.minimum(1.0 / (below - own + 1.0), 1.0) * (1.0 + MARGIN)
    off = np.einsum("bj,bij->bi", highest, apart)
    off = np.minimum(off, apart.max(axis=2)) * (1.0 + MARGIN)
    variance = np.einsum("bj,bjk->bk", highest, apart**2).min(axis=1)[:, None]
    above = 0.5 * highest * off**2 * (1.0 + MARGIN)
    under = 0.5 * highest * variance * (1.0 + MARGIN)
    mean = np.sum(weights * form.parts, axis=-1, keepdims=True)
    parts = weights * (form.parts - mean)
    spread = np.sum(weights * form.error, axis=1, keepdims=True)
    error = weights * (form.error + spread) + 0.5 * (above + under)
    parts[0] = weights + 0.5 * (above - under)
    # All weights are between 0 and h.
    wide = ~(2.0 * (np.abs(parts[1:]).sum(axis=0) + error) <= highest)
    parts = np.where(wide, 0.0, parts)
    parts[0] = np.where(wide, 0.5 * highest, parts[0])
    error = np.where(wide, 0.5 * highest, error) + SLACK * (1.0 + 8.0 * form.size)
    return rounded(form.of(parts, error), 4.0 * (1.0 + form.size), 64)


def _tanh_curvature(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of -2 t (1 - t²), t = tanh x, with extrema at t = ±1/√3."""
    ends = np.tanh(np.stack([low, high]))
    bent = -2.0 * ends * (1.0 - ends**2)
    turn = 3.0**-0.5
    largest = 4.0 / 3.0 * turn
    inside = (ends[0] <= turn + SLACK) & (ends[1] >= turn - SLACK)
    least = np.where(inside, -largest, bent.min(axis=0))
    inside = (ends[0] <= -turn + SLACK) & (ends[1] >= -turn - SLACK)
    most = np.where(inside, largest, bent.max(axis=0))
    return least - SLACK, most + SLACK


def _tanh_third(low: Array, high: Array) -> Array:
    """A bound of |(1 - t²) (6 t² - 2)|, which is 2 at t = 0, and 2/3 at t² = 2/3."""
    squares = np.tanh(np.stack([low, high])) ** 2
    values = np.abs((1.0 - squares) * (6.0 * squares - 2.0)).max(axis=0)
    values = np.maximum(values, 2.0 / 3.0)
    return np.where((low <= 0.0) & (high >= 0.0), 2.0, values) + SLACK


def _monotone(function: Callable[[Array], Array]) -> Bounds:
    """Return the span of a rising function."""
    return lambda low, high: (function(low), function(high))


def _wave(function: Callable[[Array], Array]) -> Bounds:
    """Return bounds of a function with slopes in [-1, 1] and values in [-1, 1]."""

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        middle = function(0.5 * (low + high))
        reach = 0.5 * (high - low) * (1.0 + MARGIN) + SLACK
        reach = reach + 8.0 * UNIT * np.maximum(np.abs(low), np.abs(high))
        return np.maximum(middle - reach, -1.0), np.minimum(middle + reach, 1.0)

    return bounds


def _exp_curvature(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of exp."""
    return np.exp(low) * (1.0 - MARGIN), np.exp(high) * (1.0 + MARGIN)


def _crosses(low: Array, high: Array) -> Bool[np.ndarray, ...]:
    """Return whether 0 may be in an interval."""
    return ~((low > 0.0) | (high < 0.0))


def _inverse_curvature(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of 2 / x³ on an interval without 0; infinite otherwise."""
    ends = np.sort(np.stack([2.0 / low**3, 2.0 / high**3]), axis=0)
    slack = MARGIN * np.abs(ends)
    crosses = _crosses(low, high)
    least = np.where(crosses, -np.inf, ends[0] - slack[0])
    return least, np.where(crosses, np.inf, ends[1] + slack[1])


def _inverse_third(low: Array, high: Array) -> Array:
    """A bound of 6 / x⁴ on an interval without 0; infinite otherwise."""
    nearest = np.minimum(np.abs(low), np.abs(high))
    bound = 6.0 / nearest**4 * (1.0 + MARGIN)
    return np.where(_crosses(low, high), np.inf, bound)


def _root_curvature(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of -x^(-3/2) / 4 above 0; infinite otherwise."""
    least = -0.25 * low**-1.5 * (1.0 + MARGIN)
    return np.where(low > 0.0, least, -np.inf), np.zeros_like(high)


TANH = Curve(
    value=np.tanh,
    slope=lambda c: 1.0 - np.tanh(c) ** 2,
    bend=lambda c: -2.0 * np.tanh(c) * (1.0 - np.tanh(c) ** 2),
    curvature=_tanh_curvature,
    third=_tanh_third,
    span=_monotone(np.tanh),
)
EXP = Curve(
    value=np.exp,
    slope=np.exp,
    bend=np.exp,
    curvature=_exp_curvature,
    third=lambda low, high: np.exp(high) * (1.0 + MARGIN),
    span=_monotone(np.exp),
)
SIN = Curve(
    value=np.sin,
    slope=np.cos,
    bend=lambda c: -np.sin(c),
    curvature=_wave(lambda c: -np.sin(c)),
    third=lambda low, high: np.ones_like(low),
    span=_wave(np.sin),
)
COS = Curve(
    value=np.cos,
    slope=lambda c: -np.sin(c),
    bend=lambda c: -np.cos(c),
    curvature=_wave(lambda c: -np.cos(c)),
    third=lambda low, high: np.ones_like(low),
    span=_wave(np.cos),
)
INVERSE = Curve(
    value=lambda c: 1.0 / c,
    slope=lambda c: -1.0 / c**2,
    bend=lambda c: 2.0 / c**3,
    curvature=_inverse_curvature,
    third=_inverse_third,
)
ROOT = Curve(
    value=np.sqrt,
    slope=lambda c: 0.5 / np.sqrt(c),
    bend=lambda c: -0.25 * c**-1.5,
    curvature=_root_curvature,
    third=lambda low, high: np.where(
        low > 0.0, 0.375 * low**-2.5 * (1.0 + MARGIN), np.inf
    ),
)
CURVES = {"tanh": TANH, "exp": EXP, "sin": SIN, "cos": COS, "sqrt": ROOT}
"""By the names of primitives."""
