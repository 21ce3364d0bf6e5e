"""Covers of boxes by smaller ones, on each of which a bound is checked.

Every root is the box [-1, 1]^n, with a number that says where it lies. A cover says of
each box whether it is halved along a variable, is a leaf, or lies outside of the
domain. Boxes are in the order of their levels, so that no cover has gaps, and none has
leaves that overlap: the codes either fit the boxes that they make, or are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sfkd_jax.enclosures._forms import MARGIN, UNIT, Form

LEAF = 255
OUTSIDE = 254
AT_ONCE = 512
"""Boxes that are evaluated at once."""
SHIFTS = 12
"""Largest number of variables whose corners are all tried."""
Bounds: TypeAlias = Float[np.ndarray, " box"]


class Boxes(NamedTuple):
    """Boxes inside of roots.

    Attributes:
        roots: number of the root of each, (box,).
        centres: in [-1, 1]^n, (box, variable); multiples of powers of 2, hence exact.
        radii: (box, variable).
    """

    roots: Int[np.ndarray, " box"]
    centres: Float[np.ndarray, "box variable"]
    radii: Float[np.ndarray, "box variable"]

    def some(self, index: Any) -> Boxes:
        """Return some of the boxes."""
        return Boxes(*(part[index] for part in (self.roots, self.centres, self.radii)))

    @property
    def count(self) -> int:
        """Number of boxes."""
        return len(self.roots)

    def halved(self, along: Int[np.ndarray, " box"]) -> Boxes:
        """Return both halves of each box, beside each other."""
        rows = np.arange(self.count)
        radii = self.radii.copy()
        radii[rows, along] *= 0.5
        below = self.centres.copy()
        below[rows, along] -= radii[rows, along]
        above = self.centres.copy()
        above[rows, along] += radii[rows, along]
        centres = np.stack([below, above], axis=1).reshape(-1, below.shape[1])
        return Boxes(self.roots.repeat(2), centres, radii.repeat(2, axis=0))


def whole(roots: int, variables: int) -> Boxes:
    """Return all roots."""
    shape = (roots, variables)
    return Boxes(np.arange(roots), np.zeros(shape), np.ones(shape))


@dataclass(frozen=True, eq=False)
class Question:
    """What is bounded, and where.

    Attributes:
        enclose: boxes -> an enclosure of a vector on each of them.
        measure: enclosures -> bounds of a number of this vector, such as `norms`.
        outside: boxes -> whether each of them is proved to be outside of the domain.
        roots: number of roots.
        variables: number of variables.
    """

    enclose: Callable[[Boxes], Form]
    measure: Callable[[Form], Bounds]
    outside: Callable[[Boxes], Bool[np.ndarray, " box"]]
    roots: int
    variables: int

    def bound(self, boxes: Boxes) -> Bounds:
        """Return proved bounds of the number on each of the boxes."""
        return np.broadcast_to(self.measure(self.enclose(boxes)), boxes.count)


class CoverRefused(Exception):
    """A cover does not prove its bound; the message gives the reason."""


def check_cover(
    question: Question,
    codes: UInt8[np.ndarray, " node"],
    largest: float,
    *,
    share: float = 1.0,
    seed: int = 0,
) -> int:
    """Check that the number is at most `largest` on the whole domain.

    Args:
        question: what is bounded.
        codes: of all boxes, level by level.
        largest: that is claimed.
        share: of the leaves that are evaluated; 1 proves the bound, less is a sample.
        seed: of the sample.

    Returns:
        The number of leaves of the cover.

    Raises:
        CoverRefused: the codes are those of no cover, or the bound fails on a leaf.
    """
    count = 0
    random = np.random.default_rng(seed)
    if not 0.0 <= largest < np.inf:
        raise CoverRefused(f"{largest} is no bound")
    for leaves, outside in levels(codes, question):
        count += leaves.count
        if share < 1.0:
            leaves = leaves.some(random.random(leaves.count) < share)
            outside = outside.some(random.random(outside.count) < share)
        if outside.count and not np.all(question.outside(outside)):
            raise CoverRefused("a box is left out that is not outside of the domain")
        for first in range(0, leaves.count, AT_ONCE):
            part = leaves.some(slice(first, first + AT_ONCE))
            # A bound that is NaN is none.
            fails = ~(question.bound(part) <= largest)
            if np.any(fails):
                where = int(np.argmax(fails))
                raise CoverRefused(
                    f"the bound {largest} is not proved on the leaf of root "
                    f"{part.roots[where]} at {part.centres[where].tolist()}"
                )
    return count


def levels(
    codes: UInt8[np.ndarray, " node"], question: Question
) -> Iterator[tuple[Boxes, Boxes]]:
    """Return leaves and left out boxes, level by level.

    Raises:
        CoverRefused: the codes are those of no cover.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8 or codes.ndim != 1:
        raise CoverRefused("codes are no bytes")
    boxes = whole(question.roots, question.variables)
    first = 0
    while boxes.count:
        level = codes[first : first + boxes.count]
        if len(level) < boxes.count:
            raise CoverRefused("the codes end before all boxes are covered")
        first += boxes.count
        is_leaf = level == LEAF
        is_outside = level == OUTSIDE
        is_split = level < question.variables
        if not np.all(is_leaf | is_outside | is_split):
            raise CoverRefused("a code is no variable")
        yield boxes.some(is_leaf), boxes.some(is_outside)
        boxes = boxes.some(is_split).halved(level[is_split].astype(int))
    if first != len(codes):
        raise CoverRefused("there are codes beyond the last box")


def norms(form: Form) -> Bounds:
    """Return bounds of the 2-norm of vectors, at the corners of the variables.

    A norm is convex, so that of c + Σ a_j ε_j is largest at a corner.
    """
    if len(form.active) > SHIFTS:
        raise ValueError(f"a norm of {len(form.active)} variables, at most {SHIFTS}")
    form = form.linear
    corners = form.centre[None]
    for slope in form.slopes:
        corners = np.concatenate([corners + slope, corners - slope])
    largest = np.sqrt(np.max(np.sum(corners**2, axis=-1), axis=0))
    error = np.sqrt(np.sum(form.error**2, axis=-1))
    # What rounding may have changed in sums of a few numbers.
    lost = 64.0 * UNIT * np.sqrt(np.sum(form.size**2, axis=-1))
    return (largest + error + lost) * (1.0 + MARGIN)


def in_parts(evaluate: Callable[[Boxes], Bounds], boxes: Boxes) -> Bounds:
    """Return the values of many boxes, some at once."""
    parts = [
        evaluate(boxes.some(slice(first, first + AT_ONCE)))
        for first in range(0, boxes.count, AT_ONCE)
    ]
    return np.concatenate(parts) if parts else np.zeros(0)
