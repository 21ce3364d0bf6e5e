"""What films draw on their frames: places seen from a car, areas, and the wind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.patches import FancyArrowPatch, Polygon
from PIL import Image

from sfkd_jax.report import style

SECONDS = 13.5
"""How much of the episode is shown [s]."""
EVERY = 2
"""Number of time steps that a frame lasts."""
TRAIL = 20
"""Number of time steps that a trail covers."""


def draw_frames(
    figure: Any, steps: range, draw: Callable[[int], None]
) -> Iterator[Image.Image]:
    """Yield a frame for each step, drawn over what is the same in all frames.

    Args:
        figure: with what no frame changes.
        steps: of the episode.
        draw: draws what is shown at a step, see `draw_once`.
    """
    canvas = figure.canvas
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for step in steps:
        canvas.restore_region(background)
        draw(step)
        yield Image.fromarray(np.array(canvas.buffer_rgba())[..., :3])


def draw_once(axes: Any, artist: Any) -> None:
    """Draw something over what the axes already show, without keeping it."""
    axes.add_artist(artist)
    axes.draw_artist(artist)
    artist.remove()


def rotation_into(yaw: float | np.floating) -> Float[np.ndarray, "2 2"]:
    """Return the rotation into a frame with this yaw [rad]."""
    return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


def beside(points: Any, offset: Any = 0.0) -> np.ndarray:
    """Return places beside points, (2, point).

    Args:
        points: (point, column): x, y, yaw, ….
        offset: how far to the left of the points the places are [m].
    """
    left = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])])
    return points[:, :2].T + offset * left


def into_view(centre: Any, places: Any) -> np.ndarray:
    """Return places, (2, point), in the frame of a centre (x, y, yaw, …)."""
    return rotation_into(centre[2]) @ (places - centre[:2, None])


def seen_from(centre: Any, points: Any, offset: Any = 0.0) -> np.ndarray:
    """Return places `beside` points, in the frame of a centre (x, y, yaw, …)."""
    return into_view(centre, beside(points, offset))


def area_between(line: Any, other: Any, **look: Any) -> Polygon:
    """Return the area between two lines, each (2, point)."""
    return Polygon(np.hstack([line, other[:, ::-1]]).T, **look)


def surface_colour(friction: Any) -> tuple[float, ...]:
    """Return white for a dry road, blue grey for a slippery one."""
    slippery = float(np.clip((0.9 - friction) / 0.6, 0.0, 1.0))
    return tuple(1.0 - slippery * np.array([0.14, 0.10, 0.05]))


def draw_wind(axes: Any, wind: Any, where: float) -> None:
    """Draw an arrow across the view, as long as the wind is strong.

    Args:
        axes: to draw on.
        wind: side wind [m/s].
        where: distance ahead at which the arrow is drawn [m].
    """
    if abs(wind) <= 0.1:
        return
    middle = float(np.mean(axes.get_ylim()))
    start = (where, middle - 0.4 * wind)
    end = (where, middle + 0.4 * wind)
    look = {"arrowstyle": "-|>", "color": style.DARK, "lw": 2.5}
    draw_once(axes, FancyArrowPatch(start, end, mutation_scale=10, **look))
