"""Runs that a policy drove: written while it drives, and read to calibrate it again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sfkd_jax.data._checks import more
from sfkd_jax.data._from_logs import fingerprint, log_files
from sfkd_jax.data._logs import Columns, Log, read_logs
from sfkd_jax.types import BODY, Trajectory

ERRORS = ("e_y", "e_psi")
INPUTS = ("nu_1", "nu_2", "curvature", "v_ref")
"""Columns of a recorded run beside those of a log: the first of ξ, and w."""
LATE = 0.2
"""Part of a period by which a row may be early or late."""


class RecordedRuns(NamedTuple):
    """Runs in path coordinates, cut to the shortest of them.

    Attributes:
        runs: states (run, time + 1, 3 + coordinate), w (run, time, 4), e.
        controls: of the vehicle, (run, time, 2).
        contents: hash of the files.
        sources: file of each run.
    """

    runs: Trajectory
    controls: Float[np.ndarray, "run time 2"]
    contents: str
    sources: list[str]


def run_columns(trained: Any) -> Columns:
    """Return the columns of the runs of a policy."""
    env = trained.settings["environment"].get("names") or Columns().environment
    reads = trained.settings["model"].get("environment", True)
    # A unit behind a name would be converted, and the policy reads what it was given.
    env = [name.partition(" [")[0] for name in env] if reads else []
    state = *trained.vehicle.state_names, *ERRORS
    return Columns(state=state, environment=(*env, *INPUTS))


@contextmanager
def recorder(trained: Any, path: str | Path) -> Iterator[Callable[..., None]]:
    """Write a run as it is driven, for `sfkd collect`: a row at every call.

        with recorder(policy, "recorded/1.csv") as record:
            control, state, info = policy.controller.act(...)
            record(observation, env, control, info)

    Args:
        trained: the policy, with a shield; also what it exports has its `info`.
        path: of the csv file, which must not exist yet.
    """
    columns, dt = run_columns(trained), trained.vehicle.dt
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    rows, size = count(), len(columns.environment) - len(INPUTS)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    # A line at a time: what was driven before a crash is kept.
    with Path(path).open("x", encoding="utf-8", buffering=1) as file:
        file.write(",".join(names) + "\n")

        def record(
            observation: Any,
            env: Any,
            control: Any,
            info: Any,
            time: float | None = None,
        ) -> None:
            time = dt * next(rows) if time is None else time
            row = [time, *observation, *info["path_state"][:2], *control, *env[:size]]
            row += [*info["perturbation"], *info["road"]]
            file.write(",".join(f"{float(value):.12g}" for value in row) + "\n")

        yield record


def recorded_runs(path: str, trained: Any) -> RecordedRuns:
    """Read the runs of a policy that `recorder` wrote, or refuse them with a reason.

    Args:
        path: a file, a folder or a glob.
        trained: the policy.
    """
    columns, dt = run_columns(trained), trained.vehicle.dt
    files = log_files(path)
    if len({digest for digest, _ in files}) < len(files):
        raise ValueError(f"{path}: two runs are the same, and count once; remove one")
    names = [file for _, file in files]
    logs, errors, _ = read_logs(names, columns, dt=dt, needs_environment=True)
    if errors:
        raise ValueError(errors[0])
    for log in logs:
        _check(log, columns, dt)
    steps = min(len(log.time) for log in logs) - 1
    size, env = len(columns.state) - len(ERRORS), len(columns.environment) - len(INPUTS)
    states, controls, given = (
        np.stack([np.asarray(getattr(log, name)[: steps + 1]) for log in logs])
        for name in ("states", "controls", "envs")
    )
    still = np.zeros((*states.shape[:2], BODY.start))
    parts = still, states[..., size:], states[..., BODY.start : size]
    xi = np.concatenate(parts, axis=-1)
    given = given[:, :-1]
    arrays = xi, given[..., env:], given[..., :env]
    runs = Trajectory(*(jnp.asarray(each, dtype=jnp.float32) for each in arrays))
    sources = [log.source for log in logs]
    return RecordedRuns(runs, controls[:, :-1], fingerprint(path), sources)


def _check(log: Log, columns: Columns, dt: float) -> None:
    """Refuse numbers that are missing, and rows that are not one period apart."""
    for name, values in log.channels(columns).items():
        if (bad := ~np.isfinite(values)).any():
            first = int(bad.argmax())
            raise ValueError(f"{log.at(first)}: {name} is {values[first]}{more(bad)}")
    if len(log.time) < 2:
        raise ValueError(f"{log.source}: a run needs two rows")
    if (off := np.abs(log.waits - dt) > LATE * dt).any():
        first = int(off.argmax())
        raise ValueError(
            f"{log.at(first + 1)}: {log.waits[first]:.3g} s after the row before; "
            f"the period of the policy is {dt:g} s"
        )
