"""Runs that a policy drove: written while it drives, and read to calibrate it again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sfkd_jax.driving.logs._findings import more
from sfkd_jax.driving.logs._log_files import fingerprint, log_files
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._reading import read_logs
from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.ranges import in_words
from sfkd_jax.types import BODY, Control, Environment, Trajectory

ERRORS = ("e_y", "e_psi")
"""Columns of the first entries of ξ, which a recorded run has beside those of a log."""
INPUTS = ("nu_1", "nu_2", "curvature", "v_ref")
"""Columns of w, which it has too."""
LATE = 0.2
"""Part of a period by which a row may be early or late."""
LARGEST_DIFFERENCE = 0.01
"""Largest difference of a control from that of the law, as a share of the largest ν."""
LARGEST_SHARE = 0.01
"""Largest share of the steps of a run at which the difference may be larger."""


def run_columns(trained: Any) -> Columns:
    """Return the columns of the runs of a policy."""
    names: Sequence[str] = ()
    if trained.settings["model"].get("environment", True):
        configured = trained.settings["environment"].get("names")
        names = configured or Columns().environment
    return Columns(
        state=(*trained.vehicle.state_names, *ERRORS),
        # Without their units: the values that the policy reads must not be converted.
        environment=(*(name.partition(" [")[0] for name in names), *INPUTS),
    )


@contextmanager
def recorder(trained: Any, path: str | Path) -> Iterator[Callable[..., None]]:
    """Write a run while it is driven, for `collect`: one row at every call.

        with recorder(policy, "recorded/1.csv") as record:
            control, state, info = policy.controller.act(...)
            record(observation, env, control, info)

    Args:
        trained: the policy, with a shield. What it exports has the same `info`, so that
            its runs can be recorded too.
        path: of the csv file, which must not exist yet.
    """
    columns = run_columns(trained)
    dt = trained.vehicle.dt
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    row_numbers = count()
    env_size = len(columns.environment) - len(INPUTS)
    box = in_words(*trained.interface["environment"].values())
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    # Every line is written at once, so that a crash loses no row before it.
    with Path(path).open("x", encoding="utf-8", buffering=1) as file:
        file.write(",".join(names) + "\n")

        def record(
            observation: Any, env: Any, control: Any, info: Any, time: Any = None
        ) -> None:
            shield = getattr(info, "shield", None)
            if shield is None:
                raise ValueError("only a policy with a shield has runs to collect")
            if not info.env_inside:
                warnings.warn(f"e left {box}: no corridor. The unit?", stacklevel=2)
            row = [
                dt * next(row_numbers) if time is None else time,
                *observation,
                *info.path.xi[:2],
                *control,
                *env[:env_size],
                *shield.perturbation,
                *info.path.inputs,
            ]
            file.write(",".join(f"{float(value):.12g}" for value in row) + "\n")

        yield record


def recorded_runs(path: str, trained: Any) -> tuple[Trajectory, str]:
    """Return the runs of a policy that `recorder` wrote, and the hash of their files.

    The runs are in path coordinates, and are cut to the length of the shortest one.

    Args:
        path: a file, a folder or a glob.
        trained: the policy.

    Raises:
        ValueError: two runs are the same, a number is missing, rows are not one period
            apart, or another law has driven.
    """
    columns = run_columns(trained)
    dt = trained.vehicle.dt
    files = log_files(path)
    if len({digest for digest, _ in files}) < len(files):
        raise ValueError(f"{path}: two runs are the same, and count once; remove one")
    logs, errors, _ = read_logs(
        [file for _, file in files], columns, dt=dt, needs_environment=True
    )
    if errors:
        raise ValueError(errors[0])
    for log in logs:
        _check_rows(log, columns, dt)
    steps = min(len(log.time) for log in logs)
    states = np.stack([np.asarray(log.states[:steps]) for log in logs])
    # What is done in the last row has no outcome.
    controls = np.stack([np.asarray(log.controls[:steps]) for log in logs])[:, :-1]
    others = np.stack([np.asarray(log.envs[:steps]) for log in logs])[:, :-1]
    envs, inputs = np.split(others, [-len(INPUTS)], axis=-1)
    # A policy that reads no e gets zeros.
    if not envs.shape[-1]:
        env_size = len(trained.settings["space"]["env_mean"])
        envs = np.zeros((*envs.shape[:2], env_size))
    runs = Trajectory(
        states=jnp.asarray(_path_states(states), dtype=jnp.float32),
        controls=jnp.asarray(inputs, dtype=jnp.float32),
        envs=jnp.asarray(envs, dtype=jnp.float32),
    )
    sources = [log.source for log in logs]
    runs = _with_acting_perturbation(runs, controls, trained, sources)
    return runs, fingerprint(path)


def _path_states(
    states: Float[np.ndarray, "run time recorded"],
) -> Float[np.ndarray, "run time state"]:
    """Return path states from recorded ones, which end with e_y and e_ψ."""
    pose = np.zeros((*states.shape[:2], BODY.start))
    errors = states[..., -2:]
    body = states[..., BODY.start : -2]
    return np.concatenate([pose, errors, body], axis=-1)


def _with_acting_perturbation(
    runs: Trajectory, controls: np.ndarray, trained: Any, sources: list[str]
) -> Trajectory:
    """Return the runs with the ν that acted on the car.

    At most steps it is the recorded one. At few steps the control may differ from that
    of the law plus the recorded ν; there ν is what the control adds to the law.

    Args:
        runs: in path coordinates, with the recorded ν.
        controls: of the car, (run, time, control).
        trained: the policy.
        sources: of the runs, for messages.

    Raises:
        ValueError: the control differs at many steps: another law has driven.
    """
    plant = trained.vehicle
    box = trained.settings["environment"]
    low = jnp.asarray(box["low"])
    high = jnp.asarray(box["high"])

    def law_control(xi: PathState, inputs: Control, env: Environment) -> jax.Array:
        return trained.law(xi, inputs[2], inputs[3], jnp.clip(env, low, high))

    states, inputs, envs = runs
    law_controls = jax.jit(jax.vmap(jax.vmap(law_control)))(
        states[:, :-1, BODY], inputs, envs
    )
    expected = np.clip(
        law_controls + inputs[..., :2], plant.control_low, plant.control_high
    )
    largest = LARGEST_DIFFERENCE * np.asarray(trained.law.perturbation)
    differs = np.any(np.abs(controls - expected) > largest, axis=-1)
    worst = int(np.argmax(differs.mean(axis=1)))
    share = differs[worst].mean()
    if share > LARGEST_SHARE:
        raise ValueError(
            f"{sources[worst]}: in {share:.0%} of the steps the control is not that of "
            "the law of this policy plus nu: another law has driven"
        )
    nu = jnp.where(differs[..., None], controls - law_controls, inputs[..., :2])
    return runs._replace(controls=inputs.at[..., :2].set(nu))


def _check_rows(log: Log, columns: Columns, dt: float) -> None:
    """Refuse numbers that are missing, and rows that are not one period apart."""
    for name, values in log.channels(columns).items():
        bad = ~np.isfinite(values)
        if bad.any():
            first = int(bad.argmax())
            raise ValueError(f"{log.at(first)}: {name} is {values[first]}{more(bad)}")
    if len(log.time) < 2:
        raise ValueError(f"{log.source}: a run needs two rows")
    off = np.abs(log.waits - dt) > LATE * dt
    if off.any():
        first = int(off.argmax())
        raise ValueError(
            f"{log.at(first + 1)}: {log.waits[first]:.3g} s after the row before; "
            f"the period of the policy is {dt:g} s"
        )
