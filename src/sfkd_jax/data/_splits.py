"""Data sets split by trajectory, windows of them, scales and coverage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import between
from sfkd_jax.types import BODY, POSE, Key, Space, Trajectory

SCENARIOS = ("s1", "s2", "held", "switching")
"""Scenarios of generated segments: uniform road, wet road with gusts, e held anywhere
in E, and e switching anywhere in E.
"""


class Dataset(NamedTuple):
    """Four sets of trajectories, disjoint by trajectory, and the environment box E.

    Attributes:
        train: to fit weights.
        validation: to select weights.
        calibration: to measure d_bar.
        test: for reported numbers only.
        env_low: lower corner of E.
        env_high: upper corner of E.
        drives: number of independent drives that each part was cut from, by its name;
            None where every trajectory is one.
        scenarios: index into `SCENARIOS` of every trajectory of each part, by its name;
            None for recorded drives.
    """

    train: Trajectory
    validation: Trajectory
    calibration: Trajectory
    test: Trajectory
    env_low: Float[Array, " environment"]
    env_high: Float[Array, " environment"]
    drives: Mapping[str, int] | None = None
    scenarios: Mapping[str, Int[Array, " segment"]] | None = None


PARTS = Dataset._fields[:4]
"""Names of the parts of a data set."""
BINS = 10
VISITED = 0.001
"""Share of all samples from which a bin counts as visited."""


def scenario_labels(counts: Mapping[str, int]) -> Int[np.ndarray, " segment"]:
    """Return indices into `SCENARIOS` of segments that are ordered by scenario."""
    codes = np.asarray([SCENARIOS.index(name) for name in counts], dtype=np.int32)
    return np.repeat(codes, list(counts.values()))


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
    _check_finite(trajectories)
    _check_box(trajectories, env_low, env_high)
    order = jax.random.permutation(key, count)
    rows = jnp.split(order, edges)
    parts = [jax.tree.map(lambda a, i=index: a[i], trajectories) for index in rows]
    dataset = Dataset(
        *parts, env_low=jnp.asarray(env_low), env_high=jnp.asarray(env_high)
    )
    if scenarios is None:
        return dataset
    labels = {name: scenarios[index] for name, index in zip(PARTS, rows, strict=True)}
    return dataset._replace(scenarios=labels)


def _check_finite(trajectories: Trajectory) -> None:
    """Refuse states or controls that are not finite."""
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in trajectories[:2]]
    if not all(map(bool, finite)):
        names = " and ".join(
            name
            for name, good in zip(Trajectory._fields, finite, strict=False)
            if not good
        )
        raise ValueError(
            f"{names} of the trajectories are not finite: "
            "check the vehicle that drove them"
        )


def _check_box(
    trajectories: Trajectory,
    env_low: Float[Array, " environment"],
    env_high: Float[Array, " environment"],
) -> None:
    """Refuse environments outside E, or a box of another size."""
    envs = trajectories.envs.reshape(-1, trajectories.envs.shape[-1])
    if not envs.shape[-1:] == jnp.shape(env_low) == jnp.shape(env_high):
        raise ValueError(
            f"environment.low and environment.high need {envs.shape[-1]} entries, "
            f"got {env_low} and {env_high}"
        )
    if not bool(jnp.all((envs >= env_low - 1e-5) & (envs <= env_high + 1e-5))):
        raise ValueError(f"environments leave the box [{env_low}, {env_high}]")


def first_share(trajectories: Trajectory, share: float) -> Trajectory:
    """Return the first share of the trajectories, at least one.

    Raises:
        ValueError: a share outside (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"training.data_share must lie in (0, 1], got {share}")
    count = max(1, round(share * trajectories.states.shape[0]))
    return jax.tree.map(lambda leaf: leaf[:count], trajectories)


def measure_space(dataset: Dataset) -> Space:
    """Measure the scales of s and u over the training part, and those of e over E."""
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
    """Draw `batch` windows uniformly over trajectories and start times.

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
    """Cut three windows of every trajectory: at its start, middle and end.

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


def coverage(
    values: Mapping[str, Float[np.ndarray, " sample"]],
) -> dict[str, dict[str, float]]:
    """Return range, middle 99.8 % and the share of visited bins of every channel.

    A bin is a tenth of the range; it is visited if it holds 0.1 % of the samples.

    Returns:
        name -> {"low", "high", "low_998", "high_998", "bins_visited"}; a constant
        channel visits no bin.
    """
    covered = {}
    for name, samples in values.items():
        low, high = float(samples.min()), float(samples.max())
        middle = np.quantile(samples, [0.001, 0.999])
        counts = (
            np.histogram(samples, BINS, (low, high))[0]
            if high > low
            else np.zeros(BINS)
        )
        visited = float(np.mean(counts >= max(1.0, VISITED * len(samples))))
        covered[name] = {
            "low": low,
            "high": high,
            "low_998": float(middle[0]),
            "high_998": float(middle[1]),
        }
        covered[name] |= {"bins_visited": visited}
    return covered


def coverage_lines(
    groups: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> Iterator[str]:
    """Yield the lines of a table of coverage, one per channel."""
    yield (
        f"{'coverage':28}{'lowest':>11}{'highest':>11}{'middle 99.8 %':>24}"
        f"{'tenths visited':>16}"
    )
    for group, rows in groups.items():
        for name, row in rows.items():
            middle = f"{row['low_998']:.4g} … {row['high_998']:.4g}"
            ends = f"{row['low']:11.4g}{row['high']:11.4g}"
            visited = f"{round(10 * row['bins_visited']):>13}/10"
            yield f"{f'{group}: {name}':28}{ends}{middle:>24}{visited}"
