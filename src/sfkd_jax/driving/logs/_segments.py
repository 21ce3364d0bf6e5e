"""Recorded runs as segments: sampled evenly, cut to one length, assigned to parts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.data import check_shares
from sfkd_jax.driving.logs._logs import Log

SAME_MOMENT = 1e-5
"""Share of a period. A row within it of a moment is taken without interpolation."""
ATTEMPTS = 200
"""Number of random orders of the runs that are tried before runs are cut."""
TOLERANCE = 2.0
"""Factor by which a part may be larger or smaller than its share."""


class Piece(NamedTuple):
    """Evenly sampled steps without a gap, or a stack of such pieces of equal length."""

    states: Float[np.ndarray, "*segment steps_plus_1 state"]
    controls: Float[np.ndarray, "*segment steps control"]
    envs: Float[np.ndarray, "*segment steps environment"]


def pieces(log: Log, dt: float, gap: float) -> Iterator[Piece]:
    """Split a run at its gaps and cuts, and sample each piece at 0, dt, 2 dt, ….

    States are interpolated linearly, yaw after unwrapping. Environments are held from
    the row before (zero order). Controls are averaged over each step, in which every
    command holds from its row to the next.

    Args:
        log: the run.
        dt: sampling period [s].
        gap: longest wait between rows that is bridged, in periods.
    """
    for rows in log.parts(gap, dt):
        time = log.time[rows] - log.time[rows[0]]
        states = log.states[rows]
        moments = dt * np.arange(int(time[-1] / dt + SAME_MOMENT) + 1)
        nearest = time[np.searchsorted(0.5 * (time[1:] + time[:-1]), moments)]
        # A row at such a moment is kept exactly, and not interpolated.
        same = np.abs(nearest - moments) < SAME_MOMENT * dt
        moments = np.where(same, nearest, moments)
        # Unwrapped, because between two rows around a wrap yaw would turn by 2π.
        states[:, 2] = np.unwrap(states[:, 2])
        sampled = [np.interp(moments, time, channel) for channel in states.T]
        # The row that holds at the start of a step, and the one that holds at its end.
        held = np.searchsorted(time, moments[:-1], side="right") - 1
        last = np.searchsorted(time, moments[1:], side="left") - 1
        # The mean command of a step is the difference of the integral of the commands.
        commands = log.controls[rows]
        integral = np.cumsum(np.diff(time)[:, None] * commands[:-1], axis=0)
        integral = np.concatenate([np.zeros((1, commands.shape[1])), integral])
        at_moments = [np.interp(moments, time, channel) for channel in integral.T]
        mean = np.diff(np.column_stack(at_moments), axis=0) / np.diff(moments)[:, None]
        # A command that did not change within the step is kept to the last bit.
        controls = np.where((held == last)[:, None], commands[held], mean)
        yield Piece(np.column_stack(sampled), controls, log.envs[rows[held]])


def segments(
    pieces: list[list[Piece]], steps: int
) -> tuple[Piece, Int[np.ndarray, " segment"]]:
    """Cut the pieces of every run into segments; the rest of a piece is dropped.

    The positions of a segment are relative to its first one, and its yaw begins in
    (−π, π], because float32 cannot resolve positions on Earth.

    Args:
        pieces: of every run.
        steps: of a segment.

    Returns:
        The segments in the order of time, stacked, and the number of the run of each.

    Raises:
        ValueError: no piece is long enough.
    """
    cut: list[Piece] = []
    runs: list[int] = []
    for run, pieces_of_run in enumerate(pieces):
        for piece in pieces_of_run:
            for start in range(0, len(piece.controls) - steps + 1, steps):
                cut.append(_segment(piece, start, start + steps))
                runs.append(run)
    if not cut:
        lengths = (len(piece.controls) for parts in pieces for piece in parts)
        raise ValueError(
            f"the longest run without a gap has {max(lengths, default=0)} steps, "
            f"a segment {steps}; pass dataset.steps"
        )
    return Piece(*map(np.stack, zip(*cut, strict=True))), np.array(runs)


def _segment(piece: Piece, start: int, stop: int) -> Piece:
    """Return the steps from start to stop, with the first position as origin."""
    states = piece.states[start : stop + 1].copy()
    states[:, :2] -= states[0, :2]
    turns = np.ceil((states[0, 2] - np.pi) / (2.0 * np.pi))
    states[:, 2] -= 2.0 * np.pi * turns
    return Piece(states, piece.controls[start:stop], piece.envs[start:stop])


def assign_parts(
    runs: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> tuple[Int[np.ndarray, " segment"], bool]:
    """Assign segments to the four parts, by whole runs if that is possible.

    Whole runs are assigned at random, if the parts come near their shares. Then no run
    is in two parts. Otherwise each run is cut into four stretches of time, one for each
    part. What is measured on such parts holds for more of the same runs, and not for
    new ones.

    Args:
        runs: number of the run of every segment.
        shares: of the parts.
        seed: of the random order of runs.

    Returns:
        The part of every segment, in the order of `PARTS`, and whether every run is in
        one part only.

    Raises:
        ValueError: a part would be empty.
    """
    check_shares(shares)
    numbers, sizes = np.unique(runs, return_counts=True)
    random = np.random.default_rng(seed)
    # With fewer runs than parts, a part would be empty in every order.
    attempts = ATTEMPTS if len(numbers) >= len(shares) else 0
    for _ in range(attempts):
        lacking = np.multiply(shares, len(runs))
        part_of_run = np.empty(len(sizes), dtype=int)
        # Each run in turn goes to the part that lacks most of its share.
        for run in random.permutation(len(numbers)):
            part_of_run[run] = lacking.argmax()
            lacking[part_of_run[run]] -= sizes[run]
        reached = np.bincount(part_of_run, weights=sizes, minlength=len(shares))
        relative = reached / len(runs) / np.asarray(shares)
        if relative.min() >= 1 / TOLERANCE and relative.max() <= TOLERANCE:
            return part_of_run[np.searchsorted(numbers, runs)], True
    # Stretches of time within each run. Training is first and the test is the latest.
    share_of_run = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    by_run = np.argsort(runs, kind="stable")
    parts = np.empty(len(runs), dtype=int)
    parts[by_run] = np.searchsorted(np.cumsum(shares)[:-1], share_of_run)
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(runs)} segments are too few for "
            f"dataset.shares={list(shares)}; record more"
        )
    return parts, False
