"""Data sets in four parts, windows and scales of them, and runs in path coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import PathFeedback, between, is_valid, path_state, wrap_angle
from sfkd_jax.scenarios import Path, point_at, project
from sfkd_jax.types import BODY, POSE, Key, Scalar, Space, State, Trajectory


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


def check_shares(shares: tuple[float, ...]) -> None:
    """Check the shares of training, validation, calibration and test.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1.
    """
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
    env_low: Float[Array, " environment"],
    env_high: Float[Array, " environment"],
    scenarios: Int[Array, " segment"] | None = None,
) -> Dataset:
    """Split trajectories at random into training, validation, calibration and test.

    Args:
        trajectories: a batch.
        key: consumed.
        shares: of the four parts.
        env_low: lower corner of E.
        env_high: upper corner of E.
        scenarios: index into `SCENARIOS` of every trajectory, or None.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1, an empty part,
            numbers that are not finite, or an environment outside E.
    """
    check_shares(shares)
    count = trajectories.states.shape[0]
    edges = np.round(np.cumsum(shares)[:-1] * count).astype(int)
    if min(np.diff([0, *edges, count])) < 1:
        raise ValueError(f"{count} trajectories are too few for shares {tuple(shares)}")
    for name in ("states", "controls"):
        if not bool(jnp.all(jnp.isfinite(getattr(trajectories, name)))):
            raise ValueError(
                f"{name} of the trajectories are not finite: "
                "check the vehicle that drove them"
            )
    envs = trajectories.envs.reshape(-1, trajectories.envs.shape[-1])
    if not envs.shape[-1:] == jnp.shape(env_low) == jnp.shape(env_high):
        raise ValueError(
            f"environment.low and environment.high need {envs.shape[-1]} entries, "
            f"got {env_low} and {env_high}"
        )
    # Not "any outside": a NaN is neither inside nor outside.
    if not bool(jnp.all((envs >= env_low - 1e-5) & (envs <= env_high + 1e-5))):
        raise ValueError(f"environments leave the box [{env_low}, {env_high}]")
    rows = jnp.split(jax.random.permutation(key, count), edges)
    parts = [jax.tree.map(lambda a, i=index: a[i], trajectories) for index in rows]
    # Labels in the same order, so that a part knows its scenarios.
    labels = None
    if scenarios is not None:
        labels = {
            name: scenarios[index] for name, index in zip(PARTS, rows, strict=True)
        }
    corners = {"env_low": jnp.asarray(env_low), "env_high": jnp.asarray(env_high)}
    return Dataset(*parts, **corners, scenarios=labels)


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


def windows(
    trajectories: Trajectory,
    rows: Int[Array, " batch"],
    starts: Int[Array, " batch"],
    *,
    length: int,
) -> Trajectory:
    """Cut one window of `length` steps per row, from its start.

    Raises:
        ValueError: windows longer than the trajectories.
    """
    if length > (steps := trajectories.controls.shape[1]):
        # A slice out of range would be shifted, not refused.
        raise ValueError(
            f"windows of {length} steps do not fit trajectories of {steps} steps"
        )
    sizes = Trajectory(length + 1, length, length)  # pyright: ignore

    def cut(row: Int[Array, ""], start: Int[Array, ""]) -> Trajectory:
        return jax.tree.map(
            lambda leaf, size: jax.lax.dynamic_slice_in_dim(leaf[row], start, size),
            trajectories,
            sizes,
        )

    return jax.vmap(cut)(rows, starts)


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


def to_path(
    driven: Trajectory, path: Path, law: PathFeedback, speeds: Float[Array, " time"]
) -> Trajectory:
    """Return one run as path states ξ_k and w_k = (u_k − law(ξ_k; …), κ_k, v_k).

    Each state is projected onto the path by Newton steps from the foot point of the
    state before, the first one from the nearest sample of the path. κ_k is the turn of
    the path between two foot points over their distance.

    Args:
        driven: states (T + 1, state) in the world, the controls that were applied,
            environments.
        path: that the run followed.
        law: (ξ, κ, v_ref, e) -> u, not clipped.
        speeds: v_ref [m/s], (T,).
    """
    states = driven.states

    def follow(
        carry: tuple[Scalar, State], state: State
    ) -> tuple[tuple[Scalar, State], tuple[Scalar, Scalar]]:
        s, before = carry
        ahead = jnp.hypot(state[0] - before[0], state[1] - before[1])
        s, lateral = project(path, state[:2], s + ahead)
        return (s, state), (s, lateral)

    nearest = jnp.argmin(jnp.hypot(*(path.points[:, :2] - states[0, :2]).T))
    start = (nearest * path.spacing, states[0])
    _, (progress, laterals) = jax.lax.scan(follow, start, states)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, progress)
    headings = wrap_angle(states[:, 2] - points[:, 2])
    coordinates = jnp.column_stack([laterals, headings, states[:, BODY]])
    along, turned = jnp.diff(progress), wrap_angle(jnp.diff(points[:, 2]))
    # A car that stands turns by 0 over 0: the curvature at its foot point instead.
    moved = jnp.abs(along) > 1e-2
    curvatures = jnp.where(moved, turned / jnp.where(moved, along, 1.0), points[:-1, 3])
    feedback = jax.vmap(law)(coordinates[:-1], curvatures, speeds, driven.envs)
    inputs = jnp.column_stack([driven.controls - feedback, curvatures, speeds])
    return Trajectory(jax.vmap(path_state)(coordinates), inputs, driven.envs)


def check_on_path(trajectories: Trajectory) -> None:
    """Refuse runs that left their path.

    Raises:
        ValueError: the number of runs with 1 − κ e_y ≤ 0.2 or states that are not
            finite.
    """
    lateral = trajectories.states[..., :-1, BODY.start]
    valid = jnp.all(is_valid(lateral, trajectories.controls[..., 2]), axis=-1)
    valid &= jnp.all(jnp.isfinite(trajectories.states), axis=(-2, -1))
    if not bool(jnp.all(valid)):
        raise ValueError(
            f"{int(jnp.sum(~valid))} of {valid.size} runs left their path "
            "(1 - kappa e_y <= 0.2): dataset.law does not stabilise the car"
        )
