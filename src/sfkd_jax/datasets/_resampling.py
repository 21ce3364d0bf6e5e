"""From rows at the moments of a recorder to segments at the period of a model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.datasets._logs import Log

SAME_MOMENT = 1e-5
"""Moments this share of a period apart are one: what was recorded there is taken as it
is.
"""


class Piece(NamedTuple):
    """A stretch of a drive without a gap, sampled evenly: states at every moment, u and e up to the last but one."""

    states: Float[np.ndarray, "time_plus_1 state"]
    controls: Float[np.ndarray, "time control"]
    envs: Float[np.ndarray, "time environment"]


class Segments(NamedTuple):
    """Pieces cut to one length, (segment, …); `drives` says which drive each is from, in the order of time.

    A position is counted from the segment's first, and yaw begins in (−π, π]: float32
    has no digits to spare for where on Earth a robot drove.
    """

    states: Float[np.ndarray, "segment steps_plus_1 state"]
    controls: Float[np.ndarray, "segment steps control"]
    envs: Float[np.ndarray, "segment steps environment"]
    drives: Int[np.ndarray, " segment"]


def pieces(log: Log, *, dt: float, gap: float) -> list[Piece]:
    """A drive split at its gaps and sampled every dt from each first moment on.

    States are interpolated linearly, yaw after unwrapping; controls and environments
    are held from the row before (zero order), so that a switch stays one.

    Args:
        log: rows that are finite, at increasing moments.
        dt: [s].
        gap: the longest wait that is bridged, in periods: of the log or dt, whichever
            is longer.
    """
    waits = np.diff(log.time)
    edges = (
        np.flatnonzero(waits > gap * max(dt, float(np.median(waits)))) + 1
        if len(waits)
        else []
    )
    return [
        _sampled(
            log.time[rows] - log.time[rows[0]],
            log.states[rows],
            log.controls[rows],
            log.envs[rows],
            dt,
        )
        for rows in np.split(np.arange(len(log.time)), edges)
    ]


def _sampled(
    time: Float[np.ndarray, " time"],
    states: Float[np.ndarray, "time state"],
    controls: Float[np.ndarray, "time control"],
    envs: Float[np.ndarray, "time environment"],
    dt: float,
) -> Piece:
    """One stretch at the moments 0, dt, 2 dt, …; rows at these moments come out as they are."""
    moments = dt * np.arange(int(time[-1] / dt + SAME_MOMENT) + 1)
    nearest = np.searchsorted(0.5 * (time[1:] + time[:-1]), moments)
    moments = np.where(
        np.abs(time[nearest] - moments) < SAME_MOMENT * dt, time[nearest], moments
    )
    smooth = np.column_stack([states[:, :2], np.unwrap(states[:, 2]), states[:, 3:]])
    held = np.searchsorted(time, moments, side="right")[:-1] - 1
    sampled = np.column_stack(
        [np.interp(moments, time, channel) for channel in smooth.T]
    )
    return Piece(sampled, controls[held], envs[held])


def segments(found: list[list[Piece]], *, steps: int) -> Segments:
    """Pieces of drives cut into segments of `steps` steps end to end; what is left of a piece is dropped.

    Raises:
        ValueError: no piece is as long as a segment.
    """
    cut: list[tuple[Piece, int]] = []
    for drive, parts in enumerate(found):
        for part in parts:
            for start in range(0, len(part.controls) - steps + 1, steps):
                stop = start + steps
                states = part.states[start : stop + 1].copy()
                states[:, :2] -= states[0, :2]
                states[:, 2] -= (
                    2.0 * np.pi * np.ceil((states[0, 2] - np.pi) / (2.0 * np.pi))
                )
                cut.append(
                    (
                        Piece(states, part.controls[start:stop], part.envs[start:stop]),
                        drive,
                    )
                )
    if not cut:
        longest = max(
            (len(part.controls) for parts in found for part in parts), default=0
        )
        raise ValueError(
            f"the longest drive without a gap has {longest} steps, a segment {steps}; pass dataset.steps"
        )
    states, controls, envs = (
        np.stack(arrays) for arrays in zip(*(piece for piece, _ in cut), strict=True)
    )
    return Segments(states, controls, envs, np.array([drive for _, drive in cut]))
