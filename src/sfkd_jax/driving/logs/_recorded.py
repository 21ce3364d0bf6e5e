"""Runs that a policy drove: written while it drives, and read to calibrate it again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.driving.logs._findings import more
from sfkd_jax.driving.logs._log_files import fingerprint, log_files
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._reading import read_logs
from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.driving.path_following import Prediction, periods_ahead
from sfkd_jax.latency import NO_LATENCY, CommandDelay, Latency
from sfkd_jax.ranges import in_words
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import BODY, Control, Environment, Trajectory

ERRORS = ("e_y", "e_psi")
"""Columns of the first entries of ξ, which a recorded run has beside those of a log."""
INPUTS = ("nu_1", "nu_2", "curvature", "v_ref")
"""Columns of w, which it has too."""
LATE = 0.2
"""Part of a period by which a row may be early or late."""
LARGEST_DIFFERENCE = 0.01
"""Largest difference of a control from that of the law, as a share of the largest ν."""
LARGEST_OF_LATENCY = 0.1
"""The same for every period of latency. The law has read the road there in a preview; a
row has it where the vehicle then was.
"""
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

    With latency a row has the observation that arrived and the control that was sent.

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


def recorded_runs(
    path: str, trained: Any, latency: Latency = NO_LATENCY
) -> tuple[Trajectory, str]:
    """Return the runs of a policy that `recorder` wrote, and the hash of their files.

    The runs are in path coordinates, and are cut to the length of the shortest one. A
    row of them is about the time at which the first control of a call begins to act:

        ξ = ξ_{k+d},   w = (ν_k, (κ, v_ref)_{k+d}),   e = e_k

    d are the periods from the observation to that time, and ξ is interpolated between
    two observations. w and e are what drove the nominal model of the shield, so that
    the distance of the car from this model is measured. Errors of the predicted state
    are disturbances, as in simulated runs. That of the first row is not measured.

    Args:
        path: a file, a folder or a glob.
        trained: the policy.
        latency: that the policy compensated on these runs.

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
    timing = Timing.of(latency, trained)
    for log in logs:
        _check_rows(log, columns, dt, timing)
    length = min(len(log.time) for log in logs)
    states = np.stack([np.asarray(log.states[:length]) for log in logs])
    controls = np.stack([np.asarray(log.controls[:length]) for log in logs])
    others = np.stack([np.asarray(log.envs[:length]) for log in logs])
    envs, nu, roads = np.split(others, [-len(INPUTS), -2], axis=-1)
    # A policy that reads no e gets zeros.
    if not envs.shape[-1]:
        env_size = len(trained.settings["space"]["env_mean"])
        envs = np.zeros((*envs.shape[:2], env_size))
    calls = Calls(timing.path_states(states), controls, nu, roads, envs)
    sources = [log.source for log in logs]
    nu = _acting_perturbation(calls, timing, trained, sources)
    steps = timing.steps(length)
    first = timing.delay.first
    inputs = np.concatenate([nu, timing.rows(roads, steps, first)], axis=-1)
    xi = timing.rows(calls.xi, steps + 1, first)
    # The pose of a path state is 0.
    pose = np.zeros((*xi.shape[:2], BODY.start))
    runs = Trajectory(
        states=jnp.asarray(np.concatenate([pose, xi], axis=-1), dtype=jnp.float32),
        controls=jnp.asarray(inputs, dtype=jnp.float32),
        envs=jnp.asarray(timing.rows(envs, steps), dtype=jnp.float32),
    )
    return runs, fingerprint(path)


class Calls(NamedTuple):
    """What was recorded at the calls of a controller.

    Attributes:
        xi: ξ at the time of the oldest entry of the observation.
        controls: u, as sent.
        nu: ν of the shield.
        roads: κ [1/m] and v_ref [m/s] where the vehicle was observed.
        envs: e.
    """

    xi: Float[np.ndarray, "run call coordinate"]
    controls: Float[np.ndarray, "run call control"]
    nu: Float[np.ndarray, "run call control"]
    roads: Float[np.ndarray, "run call 2"]
    envs: Float[np.ndarray, "run call environment"]


class Timing(NamedTuple):
    """When the rows of recorded calls were true, in sampling periods.

    Attributes:
        delay: of the commands after the oldest entry of an observation.
        hold_back: by how much each entry of an observation is younger than the oldest.
    """

    delay: CommandDelay
    hold_back: tuple[float, ...]

    @classmethod
    def of(cls, latency: Latency, trained: Any) -> Timing:
        """Return the timing of the calls of a policy."""
        plant = trained.vehicle
        sized = latency.sized(len(plant.states), len(plant.controls))
        return cls(sized.loop(plant.dt), sized.hold_back(plant.dt))

    @property
    def start(self) -> int:
        """The first call of which all earlier commands that still act are known."""
        return self.delay.steps

    def steps(self, calls: int) -> int:
        """Return how many steps of a run follow from so many calls."""
        # What is done in the last row has no outcome.
        return calls - self.start - ceil(self.delay.first) - 1

    def rows(
        self, values: Float[np.ndarray, "run call n"], count: int, later: float = 0.0
    ) -> Float[np.ndarray, "run row n"]:
        """Return the values from `start` on, some periods later, interpolated."""
        first = self.start + floor(later)
        share = later - floor(later)
        before = values[:, first : first + count]
        if not share:
            return before
        return before + share * (values[:, first + 1 : first + count + 1] - before)

    def path_states(
        self, states: Float[np.ndarray, "run call recorded"]
    ) -> Float[np.ndarray, "run call coordinate"]:
        """Return ξ of recorded states, which end with e_y and e_ψ.

        Other entries are as old as they are in the observation. The younger ones are
        held back, as the controller does; NaN where they are not known yet.
        """
        xi = np.concatenate([states[..., -2:], states[..., BODY.start : -2]], axis=-1)
        calls = np.arange(states.shape[1])
        for column, late in enumerate(self.hold_back[BODY.start :], start=2):
            for values in xi[..., column] if late else ():
                values[:] = np.interp(calls - late, calls, values, left=np.nan)
        return xi


def _acting_perturbation(
    calls: Calls, timing: Timing, trained: Any, sources: list[str]
) -> Float[np.ndarray, "run row control"]:
    """Return the ν that acted on the car.

    At most steps it is the recorded one. At few steps the control may differ from that
    of the law plus the recorded ν; there ν is what the control adds to the law. The law
    is that of the state that the controller predicts for the time at which its first
    control acts.

    Args:
        calls: of all runs.
        timing: of the calls.
        trained: the policy.
        sources: of the runs, for messages.

    Raises:
        ValueError: the control differs at many steps: another law has driven.
    """
    plant = trained.vehicle
    steps = timing.steps(calls.xi.shape[1])
    rows = timing.start + np.arange(steps)[:, None]
    law_control = _law_control(timing.delay, trained)
    law_controls = jax.jit(jax.vmap(jax.vmap(law_control)))(
        timing.rows(calls.xi, steps),
        timing.rows(calls.envs, steps),
        timing.rows(calls.roads, steps, timing.delay.first),
        calls.roads[:, rows + np.arange(ceil(timing.delay.first))],
        calls.controls[:, rows + np.arange(-timing.start, 0)],
    )
    controls = timing.rows(calls.controls, steps)
    nu = timing.rows(calls.nu, steps)
    expected = np.clip(law_controls + nu, plant.control_low, plant.control_high)
    largest = LARGEST_DIFFERENCE + LARGEST_OF_LATENCY * timing.delay.first
    largest = largest * np.asarray(trained.law.perturbation)
    differs = np.any(np.abs(controls - expected) > largest, axis=-1)
    worst = int(np.argmax(differs.mean(axis=1)))
    share = differs[worst].mean()
    if share > LARGEST_SHARE:
        raise ValueError(
            f"{sources[worst]}: in {share:.0%} of the steps the control is not that of "
            "the law of this policy plus nu: another law has driven"
        )
    return np.where(differs[..., None], controls - law_controls, nu)


def _law_control(delay: CommandDelay, trained: Any) -> Callable[..., Control]:
    """Return the function from what is known at a call to the control of the law."""
    box = trained.settings["environment"]
    low = jnp.asarray(box["low"])
    high = jnp.asarray(box["high"])
    model = trained.model.predicting
    params = fold(model, trained.params, on_host)
    prediction = Prediction(model=model, law=trained.law, dt=trained.vehicle.dt)

    def law_control(
        xi: PathState,
        env: Environment,
        road: Float[Array, " 2"],
        ahead: Float[Array, "period 2"],
        sent: Float[Array, "step control"],
    ) -> Control:
        known = jnp.clip(env, low, high)
        if delay.first:
            fiber = model.fiber(params, known)
            periods = periods_ahead(delay, ahead, sent)
            xi, _ = prediction.ahead(fiber, known, xi, periods)
        return trained.law(xi, road[0], road[1], known)

    return law_control


def _check_rows(log: Log, columns: Columns, dt: float, timing: Timing) -> None:
    """Refuse numbers that are missing, and rows that are not one period apart."""
    for name, values in log.channels(columns).items():
        bad = ~np.isfinite(values)
        # A controller that holds readings back does not know these at its first calls.
        if name in ERRORS:
            bad[: ceil(max(timing.hold_back))] = False
        if bad.any():
            first = int(bad.argmax())
            raise ValueError(f"{log.at(first)}: {name} is {values[first]}{more(bad)}")
    if timing.steps(len(log.time)) < 1:
        needed = len(log.time) + 1 - timing.steps(len(log.time))
        raise ValueError(f"{log.source}: a run needs {needed} rows")
    off = np.abs(log.waits - dt) > LATE * dt
    if off.any():
        first = int(off.argmax())
        raise ValueError(
            f"{log.at(first + 1)}: {log.waits[first]:.3g} s after the row before; "
            f"the period of the policy is {dt:g} s"
        )
