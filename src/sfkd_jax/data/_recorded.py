"""Runs that a policy drove: written while it drives, and read to calibrate it again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.data._checks import more
from sfkd_jax.data._from_logs import fingerprint, log_files
from sfkd_jax.data._logs import Columns, Log, read_logs
from sfkd_jax.geometry import PathState
from sfkd_jax.ranges import in_words
from sfkd_jax.types import BODY, Control, Environment, Trajectory

ERRORS = ("e_y", "e_psi")
INPUTS = ("nu_1", "nu_2", "curvature", "v_ref")
"""Columns of a recorded run beside those of a log: the first of ξ, and w."""
LATE = 0.2
"""Part of a period by which a row may be early or late."""
FITS, UNFIT = 0.01, 0.01
"""Largest difference from a law in the largest ν, and share of steps beyond it."""


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
    """Write a run as it is driven, for `collect`: a row at every call.

        with recorder(policy, "recorded/1.csv") as record:
            control, state, info = policy.controller.act(...)
            record(observation, env, control, info)

    Args:
        trained: the policy, with a shield; also what it exports has its `info`.
        path: of the csv file, which must not exist yet.
    """
    columns = run_columns(trained)
    dt = trained.vehicle.dt
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    rows = count()
    size = len(columns.environment) - len(INPUTS)
    box = in_words(*trained.interface["environment"].values())
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    # A line at a time: what was driven before a crash is kept.
    with Path(path).open("x", encoding="utf-8", buffering=1) as file:
        file.write(",".join(names) + "\n")

        def record(
            observation: Any, env: Any, control: Any, info: Any, time: Any = None
        ) -> None:
            if "perturbation" not in info:
                raise ValueError("only a policy with a shield has runs to collect")
            if not info["env_inside"]:
                warnings.warn(f"e left {box}: no corridor. The unit?", stacklevel=2)
            time = dt * next(rows) if time is None else time
            row = [time, *observation, *info["path_state"][:2], *control, *env[:size]]
            row += [*info["perturbation"], *info["road"]]
            file.write(",".join(f"{float(value):.12g}" for value in row) + "\n")

        yield record


def recorded_runs(path: str, trained: Any) -> tuple[Trajectory, str]:
    """Return the runs of a policy that `recorder` wrote, and the hash of their files.

    They are in path coordinates, and cut to the shortest. Runs that another law drove,
    or that lack a number, are refused with the reason.

    Args:
        path: a file, a folder or a glob.
        trained: the policy.
    """
    columns = run_columns(trained)
    dt = trained.vehicle.dt
    files = log_files(path)
    if len({digest for digest, _ in files}) < len(files):
        raise ValueError(f"{path}: two runs are the same, and count once; remove one")
    names = [file for _, file in files]
    logs, wrong, _ = read_logs(names, columns, dt=dt, needs_environment=True)
    if wrong:
        raise ValueError(wrong[0])
    for log in logs:
        _check(log, columns, dt)
    steps = min(len(log.time) for log in logs)
    states, controls, given = (
        np.stack([np.asarray(getattr(log, name)[:steps]) for log in logs])
        for name in ("states", "controls", "envs")
    )
    still = np.zeros((*states.shape[:2], BODY.start))
    errors = states[..., -2:]
    xi = np.concatenate([still, errors, states[..., BODY.start : -2]], axis=-1)
    # What is done in the last row has no outcome.
    env, inputs = np.split(given[:, :-1], [-len(INPUTS)], axis=-1)
    if not env.shape[-1]:  # a policy that reads no e is given zeros
        env = np.zeros((*env.shape[:2], len(trained.settings["space"]["env_mean"])))
    arrays = (jnp.asarray(part, dtype=jnp.float32) for part in (xi, inputs, env))
    runs = Trajectory(*arrays)
    sources = [log.source for log in logs]
    return _under_law(runs, controls[:, :-1], trained, sources), fingerprint(path)


def _under_law(
    runs: Trajectory, controls: np.ndarray, trained: Any, sources: list[str]
) -> Trajectory:
    """Return the runs with the ν that acted, if the law of the policy drove them."""
    plant = trained.vehicle
    box = trained.settings["environment"]
    low = jnp.asarray(box["low"])
    high = jnp.asarray(box["high"])

    def control(xi: PathState, inputs: Control, env: Environment) -> jax.Array:
        return trained.law(xi, inputs[2], inputs[3], jnp.clip(env, low, high))

    states, inputs, envs = runs
    alone = jax.jit(jax.vmap(jax.vmap(control)))(states[:, :-1, BODY], inputs, envs)
    expected = np.clip(alone + inputs[..., :2], plant.control_low, plant.control_high)
    off = np.abs(controls - expected) > FITS * np.asarray(trained.law.perturbation)
    off = np.any(off, axis=-1)
    worst = int(np.argmax(off.mean(axis=1)))
    if (share := off[worst].mean()) > UNFIT:
        raise ValueError(
            f"{sources[worst]}: in {share:.0%} of the steps the control is not that of "
            "the law of this policy plus nu: another law has driven"
        )
    nu = jnp.where(off[..., None], controls - alone, inputs[..., :2])
    return runs._replace(controls=inputs.at[..., :2].set(nu))


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
