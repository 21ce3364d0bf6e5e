"""Smooth positions that are noisy, or far apart."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

SMOOTHINGS = (1e-4, 1e6)
"""Range of the weight of the penalty that smooths positions: from a path through them
to one that bends over some 30 samples.
"""


def smooth(
    points: Float[np.ndarray, "point 2"],
    spacing: float,
    closed: bool,
    tolerance: float,
) -> tuple[Float[np.ndarray, "sample 4"], float]:
    """Return the smoothest path that is as near to positions as the tolerance.

    It has the smallest sum of squared third differences, and its yaw and curvature are
    those of a cubic spline through it.

    Args:
        points: positions [m].
        spacing: between samples [m].
        closed: whether the last position is the first one.
        tolerance: root mean square distance from the positions [m].

    Returns:
        x [m], y [m], yaw [rad] and curvature [1/m] at equal distances, and these [m].
    """
    from scipy.interpolate import CubicSpline

    laps = 3 if closed else 1
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = float(steps.sum())
    # Around a lap nothing ends: it is smoothed with the laps before and after.
    along = np.append(0.0, np.cumsum(np.tile(steps, laps)))
    points = np.concatenate([*[points[:-1]] * laps, points[-1:]])
    gaps = laps * max(math.ceil(length / spacing), 3)
    grid = along[-1] / gaps * np.arange(gaps + 1)
    low, high = np.log(SMOOTHINGS)
    # The distance from the positions grows with the weight.
    for _ in range(40):
        middle = 0.5 * (low + high)
        smooth = _penalised(along, points, grid, math.exp(middle))
        off = np.stack([np.interp(along, grid, axis) for axis in smooth.T]) - points.T
        if np.sum(off**2) < tolerance**2 * len(points):
            low = middle
        else:
            high = middle
    curve = CubicSpline(grid, _penalised(along, points, grid, math.exp(low)))
    # Of the middle lap, or of all.
    fine = np.linspace(0.0, length, 20 * gaps // laps + 1) + (laps // 2) * length
    way = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
    way = np.append(0.0, np.cumsum(way))
    count = int(way[-1] / spacing + 1e-6) + 1
    if closed:
        spacing = way[-1] / (count - 1)
    at = np.interp(spacing * np.arange(count), way, fine)
    x, y = curve(at).T
    along_x, along_y = curve(at, 1).T
    turn_x, turn_y = curve(at, 2).T
    yaw = np.unwrap(np.arctan2(along_y, along_x))
    bend = (along_x * turn_y - along_y * turn_x) / np.hypot(along_x, along_y) ** 3
    return np.stack([x, y, yaw, bend], axis=1), float(spacing)


def _penalised(
    along: Float[np.ndarray, " point"],
    points: Float[np.ndarray, "point 2"],
    grid: Float[np.ndarray, " node"],
    weight: float,
) -> Float[np.ndarray, "node 2"]:
    """Return the nodes f that minimise Σ |f(s_i) − p_i|² + weight Σ |Δ³f|².

    Args:
        along: s_i [m].
        points: p_i [m].
        grid: where the nodes are [m], equally spaced; f is linear between them.
        weight: of the third differences Δ³f.
    """
    from scipy.linalg import solveh_banded

    step = grid[1] - grid[0]
    count = len(grid)
    before = np.clip((along / step).astype(int), 0, count - 2)
    share = along / step - before
    # The upper diagonals of the normal equations; the last row is the main diagonal.
    bands = np.zeros((4, count))
    np.add.at(bands[3], before, (1.0 - share) ** 2)
    np.add.at(bands[3], before + 1, share**2)
    np.add.at(bands[2], before + 1, share * (1.0 - share))
    # Solved for what the nodes are beside straight lines between the positions: far
    # from the origin, rounding would otherwise bend the path.
    lines = np.stack([np.interp(grid, along, axis) for axis in points.T], axis=1)
    off = points - (1.0 - share)[:, None] * lines[before]
    off -= share[:, None] * lines[before + 1]
    wanted = np.zeros((count, 2))
    np.add.at(wanted, before, (1.0 - share)[:, None] * off)
    np.add.at(wanted, before + 1, share[:, None] * off)
    stencil = (-1.0, 3.0, -3.0, 1.0)
    kinks = np.diff(lines, n=3, axis=0)
    for first, left in enumerate(stencil):
        wanted[first : count - 3 + first] -= weight * left * kinks
        for second, right in enumerate(stencil[first:], start=first):
            # The difference from the node k on has the node k + second in this column.
            columns = slice(second, count - 3 + second)
            bands[3 - (second - first), columns] += weight * left * right
    # What nothing determines, as between few positions, is straight.
    bands[3] += min(1e-8 * weight, 1e-6)
    return lines + solveh_banded(bands, wanted)
