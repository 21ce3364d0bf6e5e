"""Data sets in four parts, and windows, scales and the coverage of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import between
from sfkd_jax.rollout import windows
from sfkd_jax.types import BODY, POSE, Key, Space, Trajectory


class Dataset(NamedTuple):
    """Four sets of trajectories, disjoint by trajectory, and the environment box E.

    Attributes:
        train: to fit weights.
        validation: to select weights.
        calibration: to measure d̄, the bound of the disturbance of a step.
        test: for reported numbers only.
        env_low: lower corner of E.
        env_high: upper corner of E.
        runs: number of independent runs that each part was cut from, by the name of the
            part; None if every trajectory is a run.
        scenarios: label of every trajectory, a whole number, by the name of the part;
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
"""Half width of E where nobody measured the environment, so that no model reads it."""
BINS = 10
"""Number of bins of the range of a channel, see `coverage`."""
VISITED = 0.001
"""Share of all samples from which on a bin counts as visited."""


def check_shares(shares: tuple[float, ...]) -> None:
    """Check the shares of training, validation, calibration and test.

    Raises:
        ValueError: they are not four positive numbers of sum 1.
    """
    # Negated comparisons, because those with NaN are false.
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

    Args:
        trajectories: a batch, states (segment, T + 1, state).
        key: of the random order; consumed.
        shares: of the four parts, positive and of sum 1.
        env_low: lower corner of E, in units of e.
        env_high: upper corner of E.
        scenarios: label of every trajectory, a whole number, or None.

    Raises:
        ValueError: a part would be empty, a number is not finite, or an environment is
            outside of E.
    """
    check_shares(shares)
    count = trajectories.states.shape[0]
    sizes = sizes_of_parts(count, shares)
    if min(sizes) < 1:
        raise ValueError(f"{count} trajectories are too few for shares {tuple(shares)}")
    # On the host. On a device every one of the many operations would be a program.
    trajectories = jax.device_get(trajectories)
    for name in ("states", "controls"):
        if not np.isfinite(getattr(trajectories, name)).all():
            raise ValueError(
                f"{name} of the trajectories are not finite: "
                "check the plant that made them"
            )
    envs = trajectories.envs.reshape(-1, trajectories.envs.shape[-1])
    if not envs.shape[-1:] == np.shape(env_low) == np.shape(env_high):
        raise ValueError(
            f"environment.low and environment.high need {envs.shape[-1]} entries, "
            f"got {env_low} and {env_high}"
        )
    # "Not all inside" instead of "any outside": a NaN is neither.
    low = np.asarray(env_low) - 1e-5
    high = np.asarray(env_high) + 1e-5
    if not np.all((envs >= low) & (envs <= high)):
        raise ValueError(f"environments leave the box [{env_low}, {env_high}]")
    order = jax.device_get(jax.random.permutation(key, count))
    rows_of_parts = np.split(order, np.cumsum(sizes)[:-1])
    parts = [
        Trajectory(
            states=trajectories.states[rows],
            controls=trajectories.controls[rows],
            envs=trajectories.envs[rows],
        )
        for rows in rows_of_parts
    ]
    labels = None
    if scenarios is not None:
        labels_of_parts = [np.asarray(scenarios)[rows] for rows in rows_of_parts]
        labels = dict(zip(PARTS, jax.device_put(labels_of_parts), strict=True))
    return Dataset(
        *jax.device_put(parts),
        env_low=jnp.asarray(env_low),
        env_high=jnp.asarray(env_high),
        scenarios=labels,
    )


def environment_box(
    envs: Float[Array, "*batch environment"] | Float[np.ndarray, "*batch environment"],
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    *,
    known: bool,
) -> tuple[Float[Array, " environment"], Float[Array, " environment"]]:
    """Return the corners of E.

    Args:
        envs: environments of the data.
        low: lower corner, or None to derive both corners from the data.
        high: upper corner, or None to derive both corners from the data.
        known: whether somebody measured the environments. If so, E reaches as far as
            they do; if not, E is wide. This is not told from the values, since an
            entry that is 0 throughout may have been measured to be 0.
    """
    values = np.asarray(envs).reshape(-1, np.shape(envs)[-1])
    lower: Any = low
    upper: Any = high
    if low is None or high is None:
        if known:
            lower = values.min(axis=0)
            upper = values.max(axis=0)
        else:
            upper = np.full(values.shape[1], UNBOUNDED)
            lower = -upper
    return jnp.asarray(lower, dtype=jnp.float32), jnp.asarray(upper, dtype=jnp.float32)


def sizes_of_parts(count: int, shares: Sequence[float]) -> list[int]:
    """Return the sizes of the four parts of `count` trajectories."""
    edges = np.round(np.cumsum(shares)[:-1] * count).astype(int)
    return np.diff([0, *edges, count]).tolist()


def measure_space(dataset: Dataset) -> Space:
    """Measure the scales of s and u over the training part, and those of e over E."""
    train = dataset.train
    body_mean, body_scale = _middle(train.states[..., BODY])
    control_mean, control_scale = _middle(train.controls)
    increments = jax.vmap(jax.vmap(between))(
        train.states[:, :-1, POSE], train.states[:, 1:, POSE]
    ).reshape(-1, 3)
    return Space(
        body_mean=body_mean,
        body_scale=body_scale,
        control_mean=control_mean,
        control_scale=control_scale,
        env_mean=0.5 * (dataset.env_high + dataset.env_low),
        env_scale=_away_from_zero(0.5 * (dataset.env_high - dataset.env_low)),
        increment_mean=increments.mean(axis=0),
        increment_scale=_away_from_zero(increments.std(axis=0)),
    )


def _middle(
    values: Float[Array, "*batch n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return centre and half width of the middle 99.8 %, per channel."""
    flat = values.reshape(-1, values.shape[-1])
    # Quantiles instead of the extremes, which a single outlier would set.
    low, high = jnp.quantile(flat, jnp.asarray([0.001, 0.999]), axis=0)
    return 0.5 * (low + high), _away_from_zero(0.5 * (high - low))


def _away_from_zero(scale: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the scales, with 1 for a channel that never moves."""
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
    # The starts are fixed, so that validation losses of two trainings are comparable.
    starts = jnp.repeat(jnp.asarray([0, (steps - length) // 2, steps - length]), count)
    return windows(trajectories, rows, starts, length=length)


def coverage(
    values: Mapping[str, Float[np.ndarray, " sample"]],
) -> dict[str, dict[str, float]]:
    """Return range, middle 99.8 % and the share of visited bins of every channel.

    A bin is a tenth of the range. It is visited if it holds 0.1 % of the samples. A
    constant channel visits none.
    """
    covered = {}
    for name, samples in values.items():
        low = float(samples.min())
        high = float(samples.max())
        low_998, high_998 = np.quantile(samples, [0.001, 0.999]).tolist()
        counts = np.zeros(BINS)
        if high > low:
            counts, _ = np.histogram(samples, BINS, (low, high))
        visited = counts >= max(1, VISITED * len(samples))
        covered[name] = {
            "low": low,
            "high": high,
            "low_998": low_998,
            "high_998": high_998,
            "bins_visited": float(np.mean(visited)),
        }
    return covered
