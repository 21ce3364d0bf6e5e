"""Data sets in four parts, windows and scales of them, and runs in path coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._logs import Log
from sfkd_jax.geometry import between, is_valid
from sfkd_jax.rollout import windows
from sfkd_jax.types import BODY, POSE, Key, Space, Trajectory


class Dataset(NamedTuple):
    """Four sets of trajectories, disjoint by trajectory, and the environment box E.

    Attributes:
        train: to fit weights.
        validation: to select weights.
        calibration: to measure d_bar.
        test: for reported numbers only.
        env_low: lower corner of E.
        env_high: upper corner of E.
        runs: number of independent runs that each part was cut from, by its name; None
            where every trajectory is one.
        scenarios: index into `SCENARIOS` of every trajectory of each part, by its name;
            None for recorded runs.
    """

    train: Trajectory
    validation: Trajectory
    calibration: Trajectory
    test: Trajectory
    env_low: Float[Array, " environment"]
    env_high: Float[Array, " environment"]
    runs: Mapping[str, int] | None = None
    scenarios: Mapping[str, Int[Array, " segment"]] | None = None


PARTS = Dataset._fields[:4]
"""Names of the parts of a data set."""
UNBOUNDED = 1e6
"""Half width of E where nobody measured the environment and no model reads it."""
SAME_MOMENT = 1e-5
"""Rows within this share of a period of a moment are taken without interpolation."""
ATTEMPTS = 200
"""Orders of the runs that are tried before runs are cut."""
TOLERANCE = 2.0
"""A part may be this many times larger or smaller than its share."""
BINS = 10
VISITED = 0.001
"""Share of all samples from which a bin counts as visited."""


def check_shares(shares: tuple[float, ...]) -> None:
    """Check the shares of training, validation, calibration and test."""
    if len(shares) != 4 or not min(shares) > 0 or not abs(sum(shares) - 1.0) <= 1e-6:
        raise ValueError(
            "dataset.shares must be four positive numbers of sum 1, "
            f"got {tuple(shares)}"
        )


def split(
    trajectories: Trajectory,
    key: Key,
    *,
    shares: tuple[float, float, float, float],
    env_low: Float[Array, " environment"] | tuple[float, ...],
    env_high: Float[Array, " environment"] | tuple[float, ...],
    scenarios: Int[Array, " segment"] | None = None,
) -> Dataset:
    """Split a batch at random into training, validation, calibration and test.

    An empty part, numbers that are not finite and an environment outside E are refused.

    Args:
        trajectories: a batch, states (segment, T + 1, state).
        shares: of the four parts, positive and of sum 1.
        env_low: lower corner of E, in units of e.
        env_high: upper corner of E.
        scenarios: index into `SCENARIOS` of every trajectory, or None.
    """
    check_shares(shares)
    count = trajectories.states.shape[0]
    sizes = sizes_of_parts(count, shares)
    if min(sizes) < 1:
        raise ValueError(f"{count} trajectories are too few for shares {tuple(shares)}")
    # On the host: each of the many operations would be a program of its own.
    trajectories = jax.device_get(trajectories)
    for name in ("states", "controls"):
        if not np.isfinite(getattr(trajectories, name)).all():
            raise ValueError(
                f"{name} of the trajectories are not finite: "
                "check the vehicle that drove them"
            )
    envs = trajectories.envs.reshape(-1, trajectories.envs.shape[-1])
    if not envs.shape[-1:] == np.shape(env_low) == np.shape(env_high):
        raise ValueError(
            f"environment.low and environment.high need {envs.shape[-1]} entries, "
            f"got {env_low} and {env_high}"
        )
    # Not "any outside": a NaN is neither inside nor outside.
    low = np.asarray(env_low) - 1e-5
    high = np.asarray(env_high) + 1e-5
    if not np.all((envs >= low) & (envs <= high)):
        raise ValueError(f"environments leave the box [{env_low}, {env_high}]")
    rows = jax.device_get(jax.random.permutation(key, count))
    rows = np.split(rows, np.cumsum(sizes)[:-1])
    parts = jax.device_put(
        [jax.tree.map(lambda a, i=index: a[i], trajectories) for index in rows]
    )
    # Labels in the same order, so that a part knows its scenarios.
    labels = None
    if scenarios is not None:
        own = jax.device_put([np.asarray(scenarios)[index] for index in rows])
        labels = dict(zip(PARTS, own, strict=True))
    corners = {"env_low": jnp.asarray(env_low), "env_high": jnp.asarray(env_high)}
    return Dataset(*parts, **corners, scenarios=labels)


def environment_box(
    envs: Float[Array, "*batch environment"] | Float[np.ndarray, "*batch environment"],
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    *,
    known: bool,
) -> tuple[Float[Array, " environment"], Float[Array, " environment"]]:
    """Return the corners of E: as given, or as far as the environments reach.

    E is wide if they are not `known`: nobody measured them.
    """
    values = np.asarray(envs).reshape(-1, np.shape(envs)[-1])
    corners: Iterable[Any] = (low, high)
    if low is None or high is None:
        wide = np.full(values.shape[1], UNBOUNDED)
        # Not by the values: a slope that is 0 throughout was measured to be 0.
        corners = (values.min(axis=0), values.max(axis=0)) if known else (-wide, wide)
    lower, upper = (jnp.asarray(corner, dtype=jnp.float32) for corner in corners)
    return lower, upper


class Piece(NamedTuple):
    """Evenly sampled steps without a gap, or a stack of as long ones."""

    states: Float[np.ndarray, "*segment steps_plus_1 state"]
    controls: Float[np.ndarray, "*segment steps control"]
    envs: Float[np.ndarray, "*segment steps environment"]


def pieces(log: Log, dt: float, gap: float) -> Iterator[Piece]:
    """Split a run at its gaps and cuts, and sample each piece at 0, dt, 2 dt, ….

    States are interpolated linearly, yaw after unwrapping; environments are held from
    the row before (zero order), controls averaged over the step as they were held.
    """
    for rows in log.parts(gap, dt):
        time = log.time[rows] - log.time[rows[0]]
        states = log.states[rows]
        moments = dt * np.arange(int(time[-1] / dt + SAME_MOMENT) + 1)
        nearest = time[np.searchsorted(0.5 * (time[1:] + time[:-1]), moments)]
        # Rows at these moments are kept exactly.
        same = np.abs(nearest - moments) < SAME_MOMENT * dt
        moments = np.where(same, nearest, moments)
        # Interpolated through a wrap, yaw would turn by 2π between two rows.
        states[:, 2] = np.unwrap(states[:, 2])
        sampled = [np.interp(moments, time, channel) for channel in states.T]
        # Of the row before: a later one was not yet known to the robot.
        held = np.searchsorted(time, moments[:-1], side="right") - 1
        last = np.searchsorted(time, moments[1:], side="left") - 1
        # Rows jitter around the moments, and the robot follows a command from its row.
        commands = log.controls[rows]
        given = np.cumsum(np.diff(time)[:, None] * commands[:-1], axis=0)
        given = np.concatenate([np.zeros((1, commands.shape[1])), given])
        given = np.column_stack([np.interp(moments, time, total) for total in given.T])
        mean = np.diff(given, axis=0) / np.diff(moments)[:, None]
        # One that did not change is kept to the last bit.
        controls = np.where((held == last)[:, None], commands[held], mean)
        yield Piece(np.column_stack(sampled), controls, log.envs[rows[held]])


def segments(
    pieces: list[list[Piece]], steps: int
) -> tuple[Piece, Int[np.ndarray, " segment"]]:
    """Cut the pieces of every run end to end; the rest of a piece is dropped.

    Positions are relative to the first of a segment, and its yaw begins in (−π, π]:
    float32 cannot resolve positions on Earth. The segments come in the order of time,
    with the number of the run of each.
    """
    cut: list[Piece] = []
    runs: list[int] = []
    for run, piece in ((k, piece) for k, parts in enumerate(pieces) for piece in parts):
        for start in range(0, len(piece.controls) - steps + 1, steps):
            stop = start + steps
            states = piece.states[start : stop + 1].copy()
            states[:, :2] -= states[0, :2]
            turns = np.ceil((states[0, 2] - np.pi) / (2.0 * np.pi))
            states[:, 2] -= 2.0 * np.pi * turns
            cut.append(
                Piece(states, piece.controls[start:stop], piece.envs[start:stop])
            )
            runs.append(run)
    if not cut:
        lengths = (len(piece.controls) for parts in pieces for piece in parts)
        raise ValueError(
            f"the longest run without a gap has {max(lengths, default=0)} steps, "
            f"a segment {steps}; pass dataset.steps"
        )
    return Piece(*map(np.stack, zip(*cut, strict=True))), np.array(runs)


def assign_parts(
    runs: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> tuple[Int[np.ndarray, " segment"], bool]:
    """Assign whole runs at random if the parts come near their shares.

    Otherwise cut each run into four stretches of time. Parts made of whole runs share
    no run. Parts made of stretches are neighbours in time, and what is measured on them
    holds for more of the same runs, not for new ones.

    Returns:
        The part of every segment, in the order of `PARTS`, and whether every run is in
        one part only.
    """
    check_shares(shares)
    numbers, sizes = np.unique(runs, return_counts=True)
    random = np.random.default_rng(seed)
    # Fewer runs than parts: one part would be empty in every order.
    for _ in range(ATTEMPTS if len(numbers) >= len(shares) else 0):
        lacking = np.multiply(shares, len(runs))
        owner = np.empty(len(sizes), dtype=int)
        # Each run in turn goes to the part that lacks most of its share.
        for run in random.permutation(len(numbers)):
            owner[run] = lacking.argmax()
            lacking[owner[run]] -= sizes[run]
        reached = np.bincount(owner, weights=sizes, minlength=len(shares))
        relative = reached / len(runs) / np.asarray(shares)
        if relative.min() >= 1 / TOLERANCE and relative.max() <= TOLERANCE:
            return owner[np.searchsorted(numbers, runs)], True
    # In time within each run: training first, so that the test is the latest.
    order = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    parts = np.empty(len(runs), dtype=int)
    parts[np.argsort(runs, kind="stable")] = np.searchsorted(
        np.cumsum(shares)[:-1], order
    )
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(runs)} segments are too few for "
            f"dataset.shares={list(shares)}; record more"
        )
    return parts, False


def sizes_of_parts(count: int, shares: Sequence[float]) -> list[int]:
    """Return the sizes of the four parts of `count` trajectories."""
    edges = np.round(np.cumsum(shares)[:-1] * count).astype(int)
    return np.diff([0, *edges, count]).tolist()


def measure_space(dataset: Dataset) -> Space:
    """Measure the scales of s and u over the training part, and those of e over E."""
    train = dataset.train
    increments = jax.vmap(jax.vmap(between))(
        train.states[:, :-1, POSE], train.states[:, 1:, POSE]
    ).reshape(-1, 3)
    return Space(
        *_range(train.states[..., BODY]),
        *_range(train.controls),
        0.5 * (dataset.env_high + dataset.env_low),
        _away_from_zero(0.5 * (dataset.env_high - dataset.env_low)),
        increments.mean(axis=0),
        _away_from_zero(increments.std(axis=0)),
    )


def _range(
    values: Float[Array, "*batch n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Centre and half width of the middle 99.8 %, per channel."""
    flat = values.reshape(-1, values.shape[-1])
    # Not the extremes, which a single outlier would set.
    low, high = jnp.quantile(flat, jnp.asarray([0.001, 0.999]), axis=0)
    return 0.5 * (low + high), _away_from_zero(0.5 * (high - low))


def _away_from_zero(scale: Float[Array, " n"]) -> Float[Array, " n"]:
    """A channel that never moves gets scale 1."""
    return jnp.where(scale > 1e-6, scale, 1.0)


def random_windows(
    trajectories: Trajectory, key: Key, *, batch: int, length: int
) -> Trajectory:
    """Draw `batch` windows uniformly over trajectories and start times."""
    count, steps = trajectories.controls.shape[:2]
    row_key, start_key = jax.random.split(key)
    rows = jax.random.randint(row_key, (batch,), 0, count)
    starts = jax.random.randint(start_key, (batch,), 0, steps - length + 1)
    return windows(trajectories, rows, starts, length=length)


def spread_windows(trajectories: Trajectory, *, length: int) -> Trajectory:
    """Cut three windows of every trajectory: at its start, middle and end."""
    count, steps = trajectories.controls.shape[:2]
    rows = jnp.tile(jnp.arange(count), 3)
    # Fixed starts: validation losses of two trainings are comparable.
    starts = jnp.repeat(jnp.asarray([0, (steps - length) // 2, steps - length]), count)
    return windows(trajectories, rows, starts, length=length)


def check_on_path(trajectories: Trajectory) -> None:
    """Refuse runs with 1 − κ e_y ≤ 0.2 or states that are not finite."""
    lateral = trajectories.states[..., :-1, BODY.start]
    valid = jnp.all(is_valid(lateral, trajectories.controls[..., 2]), axis=-1)
    valid &= jnp.all(jnp.isfinite(trajectories.states), axis=(-2, -1))
    if not bool(jnp.all(valid)):
        raise ValueError(
            f"{int(jnp.sum(~valid))} of {valid.size} runs left their path "
            "(1 - kappa e_y <= 0.2): dataset.law does not stabilise the car"
        )


def coverage(
    values: Mapping[str, Float[np.ndarray, " sample"]],
) -> dict[str, dict[str, float]]:
    """Return range, middle 99.8 % and the share of visited bins of every channel.

    A bin is a tenth of the range; it is visited if it holds 0.1 % of the samples. A
    constant channel visits none.
    """
    covered = {}
    for name, samples in values.items():
        low = float(samples.min())
        high = float(samples.max())
        middle = np.quantile(samples, [0.001, 0.999]).tolist()
        counts = np.zeros(BINS)
        if high > low:
            counts = np.histogram(samples, BINS, (low, high))[0]
        covered[name] = {
            "low": low,
            "high": high,
            "low_998": middle[0],
            "high_998": middle[1],
            "bins_visited": float(np.mean(counts >= max(1, VISITED * len(samples)))),
        }
    return covered
