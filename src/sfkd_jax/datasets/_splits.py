"""Splits by trajectory, windows, and the scales measured on the training split."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.core.se2 import between
from sfkd_jax.types import BODY, POSE, Key, Space, Trajectory


class Dataset(NamedTuple):
    """Four sets of trajectories, disjoint by trajectory, and the environment box E they were drawn from.

    Attributes:
        train: fits weights.
        validation: selects.
        calibration: sets d_bar.
        test: reports, nothing else.
        env_low, env_high: E.
        drives: how many independent drives each part was cut from, by its name; None
            where every trajectory is one.
    """

    train: Trajectory
    validation: Trajectory
    calibration: Trajectory
    test: Trajectory
    env_low: Float[Array, " environment"]
    env_high: Float[Array, " environment"]
    drives: Mapping[str, int] | None = None


def check_shares(shares: tuple[float, ...]) -> None:
    """Of training, validation, calibration and test.

    Raises:
        ValueError: shares that are not four, positive and of sum 1.
    """
    if len(shares) != 4 or not min(shares) > 0 or not abs(sum(shares) - 1.0) <= 1e-6:
        raise ValueError(
            f"dataset.shares must be four positive numbers of sum 1, got {tuple(shares)}"
        )


def split(
    trajectories: Trajectory,
    key: Key,
    *,
    shares: tuple[float, float, float, float],
    env_low: Float[Array, " environment"],
    env_high: Float[Array, " environment"],
) -> Dataset:
    """Deal whole trajectories to train, validation, calibration and test.

    Raises:
        ValueError: shares that are not four, positive and of sum 1, a set left empty,
            numbers that are not finite, an environment outside E.
    """
    check_shares(shares)
    count = trajectories.states.shape[0]
    edges = np.round(np.cumsum(shares)[:-1] * count).astype(int)
    if min(np.diff([0, *edges, count])) < 1:
        raise ValueError(f"{count} trajectories are too few for shares {tuple(shares)}")
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in trajectories[:2]]
    if not all(map(bool, finite)):
        names = " and ".join(
            name
            for name, good in zip(Trajectory._fields, finite, strict=False)
            if not good
        )
        raise ValueError(
            f"{names} of the trajectories are not finite: check the vehicle that drove them"
        )
    envs = trajectories.envs.reshape(-1, trajectories.envs.shape[-1])
    if not envs.shape[-1:] == jnp.shape(env_low) == jnp.shape(env_high):
        raise ValueError(
            f"dataset.env_low and env_high need {envs.shape[-1]} entries, got {env_low} and {env_high}"
        )
    if not bool(jnp.all((envs >= env_low - 1e-5) & (envs <= env_high + 1e-5))):
        raise ValueError(f"environments leave the box [{env_low}, {env_high}]")
    order = jax.random.permutation(key, count)
    parts = [
        jax.tree.map(lambda a, i=index: a[i], trajectories)
        for index in jnp.split(order, edges)
    ]
    return Dataset(*parts, env_low=jnp.asarray(env_low), env_high=jnp.asarray(env_high))


def first_share(trajectories: Trajectory, share: float) -> Trajectory:
    """The first of the trajectories, at least one: a smaller data set inside a larger one.

    Raises:
        ValueError: a share outside (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"training.data_share must lie in (0, 1], got {share}")
    count = max(1, round(share * trajectories.states.shape[0]))
    return jax.tree.map(lambda leaf: leaf[:count], trajectories)


def measure_space(dataset: Dataset) -> Space:
    """Centres and half widths of s and u over the training split, of e over its box, moments of the increments."""
    train = dataset.train
    increments = jax.vmap(jax.vmap(between))(
        train.states[:, :-1, POSE], train.states[:, 1:, POSE]
    )
    increments = increments.reshape(-1, 3)
    body = _range(train.states[..., BODY])
    control = _range(train.controls)
    centre, half = (
        0.5 * (dataset.env_high + dataset.env_low),
        0.5 * (dataset.env_high - dataset.env_low),
    )
    return Space(
        *body,
        *control,
        centre,
        _away_from_zero(half),
        increments.mean(axis=0),
        _away_from_zero(increments.std(axis=0)),
    )


def windows(
    trajectories: Trajectory,
    rows: Int[Array, " batch"],
    starts: Int[Array, " batch"],
    *,
    length: int,
) -> Trajectory:
    """Cut one window of `length` steps per row, from its start."""

    def cut(row: Int[Array, ""], start: Int[Array, ""]) -> Trajectory:
        def piece(leaf: Array, size: int) -> Array:
            return jax.lax.dynamic_slice_in_dim(leaf[row], start, size)

        return Trajectory(
            piece(trajectories.states, length + 1),
            piece(trajectories.controls, length),
            piece(trajectories.envs, length),
        )

    return jax.vmap(cut)(rows, starts)


def random_windows(
    trajectories: Trajectory, key: Key, *, batch: int, length: int
) -> Trajectory:
    """`batch` windows drawn evenly over trajectories and start times.

    Raises:
        ValueError: windows longer than the trajectories.
    """
    count, steps = trajectories.controls.shape[:2]
    _check_length(length, steps)
    row_key, start_key = jax.random.split(key)
    rows = jax.random.randint(row_key, (batch,), 0, count)
    starts = jax.random.randint(start_key, (batch,), 0, steps - length + 1)
    return windows(trajectories, rows, starts, length=length)


def spread_windows(trajectories: Trajectory, *, length: int) -> Trajectory:
    """Every trajectory cut at three places: start, middle and end.

    Raises:
        ValueError: windows longer than the trajectories.
    """
    count, steps = trajectories.controls.shape[:2]
    _check_length(length, steps)
    rows = jnp.tile(jnp.arange(count), 3)
    starts = jnp.repeat(jnp.asarray([0, (steps - length) // 2, steps - length]), count)
    return windows(trajectories, rows, starts, length=length)


def _check_length(length: int, steps: int) -> None:
    """Refuse windows that do not fit."""
    if length > steps:
        raise ValueError(
            f"windows of {length} steps do not fit trajectories of {steps} steps"
        )


def _range(
    values: Float[Array, "*batch n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Centre and half width of the middle 99.8 %, per channel."""
    flat = values.reshape(-1, values.shape[-1])
    low, high = jnp.quantile(flat, jnp.asarray([0.001, 0.999]), axis=0)
    return 0.5 * (low + high), _away_from_zero(0.5 * (high - low))


def _away_from_zero(scale: Float[Array, " n"]) -> Float[Array, " n"]:
    """A channel that never moves gets scale 1."""
    return jnp.where(scale > 1e-6, scale, 1.0)
