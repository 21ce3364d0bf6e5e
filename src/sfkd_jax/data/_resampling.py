"""Resample recorded drives, cut them into segments, and assign these to the parts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.data._logs import Log
from sfkd_jax.data._splits import check_shares

ATTEMPTS = 200
"""Orders of the drives that are tried before drives are cut."""
TOLERANCE = 2.0
"""A part may be this many times larger or smaller than its share."""
SAME_MOMENT = 1e-5
"""Rows within this share of a period of a moment are taken without interpolation."""


class Piece(NamedTuple):
    """A stretch of a drive without a gap, sampled evenly.

    Attributes:
        states: at every moment.
        controls: at every moment but the last.
        envs: at every moment but the last.
    """

    states: Float[np.ndarray, "time_plus_1 state"]
    controls: Float[np.ndarray, "time control"]
    envs: Float[np.ndarray, "time environment"]


class Segments(NamedTuple):
    """Segments of one length, in the order of time.

    Positions are relative to the first of a segment, and its yaw begins in (−π, π]:
    float32 cannot resolve positions on Earth.

    Attributes:
        states: (segment, steps + 1, state).
        controls: (segment, steps, control).
        envs: (segment, steps, environment).
        drives: number of the drive that each segment is from.
    """

    states: Float[np.ndarray, "segment steps_plus_1 state"]
    controls: Float[np.ndarray, "segment steps control"]
    envs: Float[np.ndarray, "segment steps environment"]
    drives: Int[np.ndarray, " segment"]


def pieces(log: Log, *, dt: float, gap: float) -> list[Piece]:
    """Split a drive at its gaps and cuts, and sample each piece every dt.

    States are interpolated linearly, yaw after unwrapping; controls and environments
    are held from the row before (zero order).

    Args:
        log: rows that are finite, at increasing moments between cuts.
        dt: [s].
        gap: the longest wait that is bridged, in periods: of the log or dt, whichever
            is longer.
    """
    waits, joined = np.diff(log.time), log.joined
    period = float(np.median(waits[joined])) if joined.any() else 0.0
    edges = np.flatnonzero((waits > gap * max(dt, period)) | ~joined) + 1
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
    """Sample one stretch at 0, dt, 2 dt, …; rows at these moments are kept exactly."""
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


def segments(drives: list[list[Piece]], *, steps: int) -> Segments:
    """Cut pieces into segments end to end; the rest of a piece is dropped.

    Args:
        drives: the pieces of every drive.
        steps: of a segment.

    Raises:
        ValueError: no piece is as long as a segment.
    """
    cut: list[tuple[Piece, int]] = []
    for drive, pieces_of_drive in enumerate(drives):
        for piece in pieces_of_drive:
            starts = range(0, len(piece.controls) - steps + 1, steps)
            cut += [(_segment(piece, start, steps), drive) for start in starts]
    if not cut:
        lengths = (len(piece.controls) for parts in drives for piece in parts)
        raise ValueError(
            f"the longest drive without a gap has {max(lengths, default=0)} steps, "
            f"a segment {steps}; pass dataset.steps"
        )
    states, controls, envs = (
        np.stack(arrays) for arrays in zip(*(piece for piece, _ in cut), strict=True)
    )
    return Segments(states, controls, envs, np.array([drive for _, drive in cut]))


def _segment(piece: Piece, start: int, steps: int) -> Piece:
    """`steps` steps of a piece, positions relative to the first, yaw in (−π, π]."""
    stop = start + steps
    states = piece.states[start : stop + 1].copy()
    states[:, :2] -= states[0, :2]
    states[:, 2] -= 2.0 * np.pi * np.ceil((states[0, 2] - np.pi) / (2.0 * np.pi))
    return Piece(states, piece.controls[start:stop], piece.envs[start:stop])


class Assignment(NamedTuple):
    """The part of every segment.

    Attributes:
        parts: number of the part, in the order of `PARTS`.
        whole: whether every drive is in one part only.
    """

    parts: Int[np.ndarray, " segment"]
    whole: bool


def assign_parts(
    drives: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> Assignment:
    """Assign whole drives at random if the parts come near their shares.

    Otherwise cut each drive into four stretches of time. Parts made of whole drives
    share no drive. Parts made of stretches are neighbours in time, and what is measured
    on them holds for more of the same drives, not for new ones.

    Args:
        drives: number of the drive of every segment.
        shares: of the parts.
        seed: of the random order of drives.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1, or too few
            segments for them.
    """
    check_shares(shares)
    whole = _whole_drives(drives, np.asarray(shares), seed)
    if whole is not None:
        return Assignment(whole, whole=True)
    sizes = np.unique(drives, return_counts=True)[1]
    order = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    parts = np.empty(len(drives), dtype=int)
    parts[np.argsort(drives, kind="stable")] = np.searchsorted(
        np.cumsum(shares)[:-1], order
    )
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(drives)} segments are too few for "
            f"dataset.shares={list(shares)}; record more"
        )
    return Assignment(parts, whole=False)


def _whole_drives(
    drives: Int[np.ndarray, " segment"], shares: Float[np.ndarray, " part"], seed: int
) -> Int[np.ndarray, " segment"] | None:
    """Parts made of whole drives; None if no attempt comes near the shares."""
    names, sizes = np.unique(drives, return_counts=True)
    if len(names) < len(shares):
        return None
    random = np.random.default_rng(seed)
    for _ in range(ATTEMPTS):
        owner = _distribute(sizes, shares, random.permutation(len(names)))
        reached = np.bincount(owner, weights=sizes, minlength=len(shares))
        relative = reached / len(drives) / shares
        if relative.min() >= 1 / TOLERANCE and relative.max() <= TOLERANCE:
            return owner[np.searchsorted(names, drives)]
    return None


def _distribute(
    sizes: Int[np.ndarray, " drive"],
    shares: Float[np.ndarray, " part"],
    order: Int[np.ndarray, " drive"],
) -> Int[np.ndarray, " drive"]:
    """Give each drive in turn to the part that lacks most of its share."""
    lacking, owner = shares * sizes.sum(), np.empty(len(sizes), dtype=int)
    for drive in order:
        owner[drive] = lacking.argmax()
        lacking[owner[drive]] -= sizes[drive]
    return owner
