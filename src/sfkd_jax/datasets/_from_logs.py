"""A data set from logged drives: read, checked, resampled, cut, dealt; everything that is noticed is said."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.datasets._checks import Finding, check_motion, check_rows
from sfkd_jax.datasets._coverage import coverage, coverage_lines
from sfkd_jax.datasets._dealing import deal
from sfkd_jax.datasets._logs import Columns, Log, read_logs
from sfkd_jax.datasets._plausible import check_steering, check_units
from sfkd_jax.datasets._ranges import Ends, check_ranges
from sfkd_jax.datasets._resampling import Segments, pieces, segments
from sfkd_jax.datasets._splits import Dataset
from sfkd_jax.types import BODY, Trajectory

SHORTEST = 3
"""Rows without which a drive cannot even be looked at."""
ANYTHING = 1e6
"""How far an environment reaches that nobody measured and no model reads."""
MOST_SAID = 20
"""Lines that are said about logs; of more, only their number."""


class Logged(NamedTuple):
    """A data set from logs, and what it covers: {"state", "control", "environment"} -> channel -> `coverage`."""

    dataset: Dataset
    coverage: dict[str, dict[str, dict[str, float]]]


def from_logs(
    path: str,
    columns: Columns,
    *,
    dt: float,
    wheelbase: float,
    limits: Ends = (None, None),
    told: bool = True,
    say: Callable[[str], None] = print,
    steps: int = 50,
    gap: float = 2.5,
    shares: tuple[float, float, float, float] = (0.6, 0.1, 0.2, 0.1),
    seed: int = 0,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
) -> Logged:
    """Read drives, refuse what cannot be right, sample every dt, cut into segments, deal by whole drives.

    Args:
        path: a file, a folder or a glob of .csv, .npz and .parquet.
        columns: how they name what they hold.
        dt: of the model [s].
        wheelbase: that steering is compared with [m].
        limits: of the controls, low and high.
        told: whether the environment must be in the logs.
        say: takes every line for a person.
        steps: of a segment.
        gap: the longest wait between rows that is bridged, in periods.
        shares: of training, validation, calibration and test.
        seed: of the deal.
        env_low, env_high: the box E; None: as far as the logs reach.

    Raises:
        ValueError: the first reason why the logs are refused; the others have been
            said.
    """
    logs, unread = read_logs(path, columns, dt=dt, told=told)
    findings = [Finding(line) for line in unread]
    sound: list[Log] = []
    for log in logs:
        found = list(_check(log, columns, dt, gap, steps))
        findings += found
        sound += (
            []
            if any(finding.refused for finding in found) or len(log.time) < SHORTEST
            else [log]
        )
    if sound:
        findings += check_steering(sound, columns, wheelbase=wheelbase)
        findings += check_ranges(sound, columns, limits=limits, box=(env_low, env_high))
    _tell(findings, say)
    cut = segments([pieces(log, dt=dt, gap=gap) for log in sound], steps=steps)
    dealt = deal(cut.drives, shares=shares, seed=seed)
    counts = np.bincount(dealt.parts, minlength=4).tolist()
    say(_summary(sound, cut, counts, dt))
    if not dealt.whole:
        say(
            "warning: too few drives to deal whole; each was cut in time, and coverage speaks of the same drives only"
        )
    dataset = _dataset(cut, dealt.parts, (env_low, env_high))
    covered = _covered(cut, columns)
    for line in coverage_lines(covered):
        say(line)
    return Logged(dataset, covered)


def _check(
    log: Log, columns: Columns, dt: float, gap: float, steps: int
) -> Iterator[Finding]:
    """All that one drive can show; what depends on sound rows is looked at when they are."""
    found = list(check_rows(log, columns))
    yield from found
    if found:
        return
    length = log.time[-1] - log.time[0]
    if length < (steps - 1e-3) * dt:
        yield Finding(
            f"{log.whole}: only {length:.4g} s, a segment is {steps * dt:.4g} s; not used",
            refused=False,
        )
    if len(log.time) < SHORTEST:
        return
    units = list(check_units(log, columns))
    yield from units
    if not any(finding.refused for finding in units):
        yield from check_motion(log, columns, dt=dt, gap=gap)


def _tell(findings: list[Finding], say: Callable[[str], None]) -> None:
    """Say what was found; if something is refused, the first of it is the error."""
    warned = [f"warning: {finding.line}" for finding in findings if not finding.refused]
    refused = [finding.line for finding in findings if finding.refused]
    for lines in (warned, refused[1:]):
        for line in lines[:MOST_SAID]:
            say(line)
        if len(lines) > MOST_SAID:
            say(f"and {len(lines) - MOST_SAID} lines more like these")
    if refused:
        raise ValueError(
            refused[0]
            + (f" (the first of {len(refused)} findings)" if refused[1:] else "")
        )


def _summary(logs: list[Log], cut: Segments, counts: list[int], dt: float) -> str:
    """How much was read and what became of it."""
    seconds = sum(log.time[-1] - log.time[0] for log in logs)
    steps = cut.controls.shape[1]
    rate = np.median(np.concatenate([np.diff(log.time) for log in logs]))
    parts = ", ".join(
        f"{count} {name}" for count, name in zip(counts, Dataset._fields, strict=False)
    )
    return (
        f"{len(logs)} drives, {seconds:.0f} s at {1 / rate:.4g} Hz; sampled every {dt:g} s (states linearly, yaw "
        f"unwrapped; controls and environment held); {len(cut.drives)} segments of {steps} steps, "
        f"{100 * len(cut.drives) * steps * dt / seconds:.0f} % of the time: {parts}"
    )


def _dataset(cut: Segments, parts: Int[np.ndarray, " segment"], box: Ends) -> Dataset:
    """Arrays as models take them."""
    drives = {
        name: len(np.unique(cut.drives[parts == k]))
        for k, name in enumerate(Dataset._fields[:4])
    }
    dealt = [
        Trajectory(
            *(
                jnp.asarray(part[parts == k], dtype=jnp.float32)
                for part in (cut.states, cut.controls, cut.envs)
            )
        )
        for k in range(4)
    ]
    low, high = environment_box(cut.envs, *box)
    return Dataset(*dealt, env_low=low, env_high=high, drives=drives)


def environment_box(
    envs: Float[Array, "*batch environment"] | Float[np.ndarray, "*batch environment"],
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
) -> tuple[Float[Array, " environment"], Float[Array, " environment"]]:
    """E: as asked, or as far as the environments of all segments reach; anything, if they stand for unknown ones."""
    values = np.asarray(envs)
    values = values.reshape(-1, values.shape[-1])
    ends = (low, high)
    if low is None or high is None:
        anything = np.full(values.shape[1], ANYTHING)
        ends = (
            (values.min(axis=0), values.max(axis=0))
            if values.any()
            else (-anything, anything)
        )
    return jnp.asarray(ends[0], dtype=jnp.float32), jnp.asarray(
        ends[1], dtype=jnp.float32
    )


def _covered(cut: Segments, columns: Columns) -> dict[str, dict[str, dict[str, float]]]:
    """What body states, controls and environments reach; where they were not measured, there is nothing to say."""
    groups = {
        "state": (columns.state[BODY], cut.states[..., BODY]),
        "control": (columns.control, cut.controls),
        "environment": (columns.environment if cut.envs.any() else (), cut.envs),
    }
    return {
        group: coverage(
            dict(zip(names, values.reshape(-1, values.shape[-1]).T, strict=False))
        )
        for group, (names, values) in groups.items()
    }
