"""Quadratic forms with a remainder: sound arithmetic over many boxes at once.

A form encloses a function of the variables of a box, x_j = centre_j + radius_j ε_j with
|ε_j| ≤ 1, by

    c + Σ_j a_j ε_j + Σ_{i≤j} q_ij ε_i ε_j + [-r, r],

where i and j are among the `curved` variables. Common terms of two forms cancel in
their difference. The remainder is of third order in the radii of curved variables, and
of second order in others. Sources: de Figueiredo and Stolfi, Affine arithmetic:
concepts and applications, Numerical Algorithms 37 (2004); Makino and Berz, Taylor
models and other validated functional inclusion methods, 2003.

Everything is computed in float64, rounded to nearest. Each operation adds to r what
rounding may have changed: of a sum of n products at most γ_n times the sum of their
sizes (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1), in any
order of summation. The functions of numpy are taken to be right to `LIBRARY`. Overflow
makes a form infinite or NaN, which no comparison accepts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

Array: TypeAlias = Float[np.ndarray, "..."]
Pairs: TypeAlias = tuple[tuple[int, int], ...]
UNIT = 2.0**-53
MARGIN = 1e-11
"""Relative margin of sums of fewer than `LARGEST` numbers that are 0 or above."""
LARGEST = 10_000
TINY = 1e-290
"""Above what underflow loses in one operation."""


@dataclass(frozen=True, eq=False)
class Form:
    """An enclosure of arrays, for each box.

    Attributes:
        parts: c, then a, then q: (1 + active + pairs, box, *shape); an axis of 1 box
            for what all boxes share.
        active: variables that the form depends on, in rising order.
        pairs: pairs of variables of q, in rising order.
        curved: variables whose products are kept.
        error: r ≥ 0, (box, *shape).
    """

    parts: Array
    active: tuple[int, ...]
    pairs: Pairs
    curved: frozenset[int]
    error: Array

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a value."""
        return self.error.shape[1:]

    @property
    def centre(self) -> Array:
        """The constant parts c."""
        return self.parts[0]

    @property
    def slopes(self) -> Array:
        """The slopes a, (active, box, *shape)."""
        return self.parts[1 : 1 + len(self.active)]

    @cached_property
    def spread(self) -> Array:
        """Σ |a_j| + Σ |q_ij|, rounded."""
        return np.abs(self.parts[1:]).sum(axis=0)

    @cached_property
    def size(self) -> Array:
        """|c| + spread + r, rounded: no value is larger, but for rounding."""
        return np.abs(self.centre) + self.spread + self.error

    @cached_property
    def radius(self) -> Array:
        """A bound of |x - c|."""
        return (self.spread + self.error) * (1.0 + MARGIN) + TINY

    @cached_property
    def range(self) -> tuple[Array, Array]:
        """Bounds of the values."""
        linear = self.linear
        radius = linear.radius + 4.0 * UNIT * linear.size
        with np.errstate(invalid="ignore"):
            return linear.centre - radius, linear.centre + radius

    @cached_property
    def linear(self) -> Form:
        """The form without pairs, which are part of its error."""
        if not self.pairs:
            return self
        first = 1 + len(self.active)
        parts = self.parts[:first].copy()
        error = self.error
        for (i, j), part in zip(self.pairs, self.parts[first:], strict=True):
            # A square is between 0 and 1, so that half of it belongs to the centre.
            error = error + (0.5 if i == j else 1.0) * np.abs(part)
            if i == j:
                parts[0] += 0.5 * part
        form = Form(parts, self.active, (), self.curved, error)
        return rounded(form, self.size, len(self.parts))

    def mapped(self, change: Callable[[Array], Array]) -> Form:
        """Return a change of all parts that moves entries alone.

        Args:
            change: (row, *shape) -> (row, *new shape).
        """
        rows = self.parts.shape[:2]
        parts = change(self.parts.reshape(rows[0] * rows[1], *self.shape))
        return self.of(parts.reshape(*rows, *parts.shape[1:]), change(self.error))

    def of(self, parts: Array, error: Array) -> Form:
        """Return a form of other parts of the same variables."""
        return Form(parts, self.active, self.pairs, self.curved, error)

    def slope(self, index: int) -> Array:
        """Return the slope of a variable."""
        return self.parts[1 + self.active.index(index)]


def constant(value: Array) -> Form:
    """Return the form of an exact array that all boxes share."""
    return of_boxes(np.asarray(value, np.float64)[None])


def of_boxes(values: Float[np.ndarray, "box ..."]) -> Form:
    """Return the form of exact arrays, one for each box."""
    values = np.asarray(values, np.float64)
    return Form(values[None], (), (), frozenset(), np.zeros_like(values))


def variables(
    centres: Float[np.ndarray, "box variable"],
    radii: Float[np.ndarray, "box variable"],
    curved: Iterable[int] = (),
) -> Form:
    """Return the vector of all variables of boxes.

    Args:
        centres: of the boxes.
        radii: of the boxes.
        curved: variables whose products are kept.
    """
    count = centres.shape[1]
    parts = np.zeros((1 + count, *centres.shape))
    parts[0] = centres
    for index in range(count):
        parts[1 + index, :, index] = radii[:, index]
    active = tuple(range(count))
    return Form(parts, active, (), frozenset(curved), np.zeros_like(parts[0]))


def rounded(form: Form, sizes: Array, terms: int) -> Form:
    """Return a computed form with what rounding may have changed.

    Args:
        form: as computed.
        sizes: of all terms of all parts of the form, summed.
        terms: number of roundings of each part, LARGEST at most.
    """
    lost = 2.0 * (terms + len(form.parts) + 4) * UNIT * sizes
    return form.of(form.parts, (form.error + lost) * (1.0 + MARGIN) + TINY)


def aligned(form: Form, active: tuple[int, ...], pairs: Pairs) -> Form:
    """Return a form with parts of 0 of further variables and pairs."""
    if form.active == active and form.pairs == pairs:
        return form
    parts = np.zeros((1 + len(active) + len(pairs), *form.parts.shape[1:]))
    rows = [1 + active.index(index) for index in form.active]
    rows += [1 + len(active) + pairs.index(pair) for pair in form.pairs]
    parts[[0, *rows]] = form.parts
    return Form(parts, active, pairs, form.curved, form.error)


def pruned(form: Form) -> Form:
    """Return a form without the variables and pairs whose parts are all 0.

    A variable of a pair stays: a form without active variables is a constant.
    """
    count = len(form.active)
    has = [bool(np.any(part)) for part in form.parts[1:]]
    of_pairs = {index for pair in compress(form.pairs, has[count:]) for index in pair}
    for row, index in enumerate(form.active):
        has[row] |= index in of_pairs
    if all(has):
        return form
    active = tuple(compress(form.active, has[:count]))
    pairs = tuple(compress(form.pairs, has[count:]))
    return Form(form.parts[[True, *has]], active, pairs, form.curved, form.error)


def union(forms: Iterable[Form]) -> tuple[tuple[int, ...], Pairs, frozenset[int]]:
    """Return the variables, pairs and curved variables of some forms together."""
    forms = [*forms]
    active = {index for form in forms for index in form.active}
    pairs = {pair for form in forms for pair in form.pairs}
    curved = {index for form in forms for index in form.curved}
    return tuple(sorted(active)), tuple(sorted(pairs)), frozenset(curved)


def add(left: Form, right: Form) -> Form:
    """Return x + y."""
    sizes = left.size + right.size
    error = left.error + right.error
    active, pairs, curved = union((left, right))
    if not right.active:
        left, right = right, left
    if not left.active:
        # A constant changes the centre alone.
        parts = right.parts + np.zeros_like(left.parts)
        parts[0] += left.parts[0]
    else:
        parts = aligned(left, active, pairs).parts + aligned(right, active, pairs).parts
    return rounded(Form(parts, active, pairs, curved, error), sizes, 2)


def negative(form: Form) -> Form:
    """Return -x, exactly."""
    return form.of(-form.parts, form.error)


def multiply(left: Form, right: Form) -> Form:
    """Return x y entry by entry."""
    sizes = left.size * right.size
    active, pairs, curved = union((left, right))
    if not right.active:
        left, right = right, left
    if not left.active:
        error = np.abs(left.centre) * right.error + left.error * right.size
        parts = right.parts * left.centre
        return rounded(Form(parts, active, pairs, curved, error), sizes, 4)
    error = np.abs(left.centre) * right.error + np.abs(right.centre) * left.error
    spread = left.radius * right.radius
    kept = kept_pairs(left, right, curved)
    pairs = tuple(sorted({*pairs, *kept}))
    left = aligned(left, active, pairs)
    right = aligned(right, active, pairs)
    parts = left.parts * right.centre
    parts += right.parts * left.centre
    parts[0] = left.centre * right.centre
    for pair in kept:
        i, j = pair
        first = left.slope(i) * right.slope(j)
        other = left.slope(j) * right.slope(i) if i != j else np.zeros(())
        parts[1 + len(active) + pairs.index(pair)] += first + other
        # Products of slopes that are kept are no part of the remainder.
        spread = spread - np.abs(first) - np.abs(other)
    error = error + np.maximum(spread, 0.0)
    return rounded(Form(parts, active, pairs, curved, error), 4.0 * sizes, 8)


def kept_pairs(left: Form, right: Form, curved: frozenset[int]) -> Pairs:
    """Return the pairs whose products of slopes are kept."""
    first = [index for index in left.active if index in curved]
    second = [index for index in right.active if index in curved]
    return tuple(sorted({(min(i, j), max(i, j)) for i in first for j in second}))


def total(form: Form, axes: tuple[int, ...]) -> Form:
    """Return the sum over axes of the shape."""
    terms = int(np.prod([form.shape[axis] for axis in axes]))
    _require_few(terms)
    over = tuple(axis + 1 for axis in axes)
    parts = form.parts.sum(axis=tuple(axis + 2 for axis in axes))
    summed = form.of(parts, form.error.sum(axis=over))
    return rounded(summed, form.size.sum(axis=over), terms)


def weighted(form: Form, weights: Float[np.ndarray, "out last"]) -> Form:
    """Return W x over the last axis of x, for exact weights."""
    _require_few(weights.shape[1])
    sizes = np.abs(weights).T
    product = form.of(form.parts @ weights.T, form.error @ sizes)
    return rounded(product, form.size @ sizes, weights.shape[1])


def _require_few(terms: int) -> None:
    """Raise a ValueError if a sum is longer than its margin allows."""
    if terms > LARGEST:
        raise ValueError(f"a sum of {terms} terms; the margins are for {LARGEST}")


def larger(left: Form, right: Form) -> Form:
    """Return max(x, y) = y + max(x - y, 0), with the chord of a kink inside."""
    gap = add(left, negative(right))
    low, high = gap.range
    kink = ~((low >= 0.0) | (high <= 0.0))
    # Any share in [0, 1] is sound: 0 ≤ max(g, 0) - share g ≤ room.
    share = np.where(kink, np.clip(high / (high - low), 0.0, 1.0), low >= 0.0)
    room = np.maximum((1.0 - share) * high, -share * low) * (1.0 + MARGIN)
    half = 0.5 * np.where(kink, room, 0.0)
    parts = gap.parts * share
    parts[0] += half
    part = gap.of(parts, gap.error * share + half)
    return add(right, rounded(part, gap.size + half, 4))
