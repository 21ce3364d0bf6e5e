"""What is to be seen of a car in its lane, in the world: films and the viewer draw it.

A line is the array (2, point) of its x and y [m]. An outline is a line around an area,
counted against the clock, whose last point is not its first.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.driving.lanes import Obstacles
from sfkd_jax.report.frames import beside, rotation_into

Line: TypeAlias = Float[np.ndarray, "2 point"]
"""Places [m]."""

BODY = (
    ((1, 0.9, -1, -1, 0.9, 1), (0.8, 1, 1, -1, -1, -0.8)),
    ((0.45, 0.15, 0.15, 0.45), (0.7, 0.6, -0.6, -0.7)),
    ((-0.6, -0.75, -0.75, -0.6), (0.55, 0.6, -0.6, -0.55)),
)
"""Outline, front and rear window of the car, in shares of half its size."""
CORNERS = 48
"""Number of points of the outline of an obstacle."""


class LaneScene(NamedTuple):
    """A car in its lane at one step.

    Attributes:
        car: outlines of the parts of `BODY`.
        reference: that is followed, from the last places of the car on.
        corridor: left and right edge of the certified corridor around the reference;
            None where none is claimed.
        obstacles: their outlines.
        needed: outline of what the middle of the car keeps clear of, for each obstacle.
    """

    car: tuple[Line, ...]
    reference: Line
    corridor: tuple[Line, Line] | None
    obstacles: tuple[Line, ...]
    needed: tuple[Line, ...]


def scene_of(
    state: Float[np.ndarray, " state"],
    reference: Float[np.ndarray, "point column"],
    bound: float,
    obstacles: Obstacles,
    *,
    half: tuple[float, float],
) -> LaneScene:
    """Return what is to be seen at a step.

    Args:
        state: of the car: x, y, yaw, ….
        reference: x, y, yaw, … of what was followed, and of what is followed next.
        bound: claimed half width of the corridor [m]; NaN where none is claimed.
        obstacles: where they are at their first step.
        half: half of length and width of the car [m].
    """
    claimed = bool(np.isfinite(bound))
    corridor = None
    if claimed:
        corridor = (beside(reference, bound), beside(reference, -bound))
    margin = half[1] + (bound if claimed else 0.0)
    rows = [row for row in zip(*map(np.asarray, obstacles), strict=True) if row[-1]]
    return LaneScene(
        car=car_at(state, half),
        reference=beside(reference),
        corridor=corridor,
        obstacles=tuple(_around(*row[:-1]) for row in rows),
        needed=tuple(_around(*row[:-1], margin=margin) for row in rows),
    )


def car_at(
    pose: Float[np.ndarray, " column"], half: tuple[float, float]
) -> tuple[Line, ...]:
    """Return the outlines of the parts of a car.

    Args:
        pose: x, y, yaw, ….
        half: half of its length and width [m].
    """
    turn = rotation_into(-pose[2])
    size = np.asarray(half)[:, None]
    place = np.asarray(pose)[:2, None]
    return tuple(turn @ (size * np.asarray(part)) + place for part in BODY)


def _around(
    position: Float[np.ndarray, "step 2"],
    yaw: Any,
    half: Float[np.ndarray, " 2"],
    radius: Any,
    margin: float = 0.0,
) -> Line:
    """Return the outline of a row of `Obstacles`, grown by a margin [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)])
    box = (radius + margin) * around + np.sign(around) * half[:, None]
    return rotation_into(-yaw) @ box + position[0][:, None]
