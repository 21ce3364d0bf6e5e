"""Branch and bound: a cover on whose leaves a bound holds. Nothing here is trusted."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from sfkd_jax.enclosures._covers import (
    LEAF,
    OUTSIDE,
    Boxes,
    Question,
    in_parts,
    whole,
)

AHEAD = 3
"""Halvings that are chosen at once, since a choice costs as much as `variables` bounds.
"""
FALL = 0.25
"""What is left of the gain of a halving after the halving: bounds are of second order.
"""


class Found(NamedTuple):
    """The result of a search.

    Attributes:
        codes: of the cover; where the search ended early, open boxes are leaves.
        open: boxes on which the bound is not proved.
        largest: the largest bound of a leaf, open ones included.
        leaves: number of leaves.
        seconds: that the search took [s].
    """

    codes: UInt8[np.ndarray, " node"]
    open: Boxes
    largest: float
    leaves: int
    seconds: float


def search_cover(
    question: Question,
    target: float,
    *,
    along: Sequence[int] = (),
    first: Sequence[int] = (),
    most: int = 10_000_000,
    seconds: float = np.inf,
    told: Callable[[str], None] | None = None,
) -> Found:
    """Return a cover on whose leaves the number is at most `target`.

    Args:
        question: what is bounded.
        target: bound that leaves must reach.
        along: variables that are halved; () for all.
        first: variables along which all boxes are halved first, without bounds.
        most: boxes of a level, beyond which the search ends.
        seconds: after which it ends at the next level [s].
        told: is given a line of progress on each level.
    """
    began = time.perf_counter()
    boxes = whole(question.roots, question.variables)
    codes = []
    for index in first:
        codes.append(np.full(boxes.count, index, np.uint8))
        boxes = boxes.halved(np.full(boxes.count, index))
    # Boxes of one family share the choice of their next halvings.
    families = boxes.roots
    planned = np.full((boxes.count, AHEAD), -1)
    along = along or range(question.variables)
    leaves = 0
    largest = 0.0
    while True:
        outside = question.outside(boxes)
        bounds = np.zeros(boxes.count)
        bounds[~outside] = in_parts(question.bound, boxes.some(~outside))
        is_open = ~(bounds <= target)
        ends = boxes.count > most or time.perf_counter() - began > seconds
        level = np.full(boxes.count, LEAF, np.uint8)
        level[outside] = OUTSIDE
        leaves += int(np.sum(~is_open & ~outside))
        largest = max(largest, float(np.max(bounds[~is_open], initial=0.0)))
        if told is not None:
            told(f"level {len(codes)}: {boxes.count} boxes, {np.sum(is_open)} open")
        if ends or not np.any(is_open):
            codes.append(level)
            worst = float(np.max(bounds, initial=0.0))
            return Found(
                codes=np.concatenate(codes),
                open=boxes.some(is_open),
                largest=max(largest, worst),
                leaves=leaves + int(np.sum(is_open)),
                seconds=time.perf_counter() - began,
            )
        rest = boxes.some(is_open)
        plan = planned[is_open]
        families = _plan_families(question, rest, plan, families[is_open], along)
        level[is_open] = plan[:, 0]
        codes.append(level)
        boxes = rest.halved(plan[:, 0])
        planned = np.roll(plan, -1, axis=1)
        planned[:, -1] = -1
        planned = planned.repeat(2, axis=0)
        families = families.repeat(2)


def _plan_families(
    question: Question,
    boxes: Boxes,
    plan: Int[np.ndarray, "box ahead"],
    families: Int[np.ndarray, " box"],
    along: Sequence[int],
) -> Int[np.ndarray, " box"]:
    """Fill in the plans of boxes that have none, and return their families.

    One box is asked for all of a family; then each of them is a family of its own.
    """
    new = plan[:, 0] < 0
    if not np.any(new):
        return families
    _, one, of = np.unique(families[new], return_index=True, return_inverse=True)
    plan[new] = _planned(question, boxes.some(new).some(one), along)[of]
    return np.where(new, np.arange(boxes.count), families)


def _remainders(question: Question, boxes: Boxes) -> Float[np.ndarray, " box"]:
    """Return the sizes of what is not linear on each box."""

    def of_part(part: Boxes) -> np.ndarray:
        error = question.enclose(part).error
        return np.broadcast_to(np.linalg.norm(error, axis=-1), part.count)

    return in_parts(of_part, boxes)


def _planned(
    question: Question, boxes: Boxes, along: Sequence[int]
) -> Int[np.ndarray, "box ahead"]:
    """Return the variables of the next halvings of each box.

    They are those that make the remainder smaller. Halving what is linear would give
    smaller bounds at the centre of the box, and the same at its corners.
    """
    before = _remainders(question, boxes)
    gains = np.full((boxes.count, question.variables), -np.inf)
    for index in along:
        radii = boxes.radii.copy()
        radii[:, index] *= 0.5
        gains[:, index] = before - _remainders(question, boxes._replace(radii=radii))
    # Where nothing is finite, the widest variable comes first.
    may = np.isin(np.arange(question.variables), along)
    gains = np.where(may & ~np.isfinite(gains), 1e300 * boxes.radii, gains)
    chosen = np.empty((boxes.count, AHEAD), int)
    rows = np.arange(boxes.count)
    for step in range(AHEAD):
        chosen[:, step] = np.argmax(gains, axis=1)
        gains[rows, chosen[:, step]] *= FALL
    return chosen
