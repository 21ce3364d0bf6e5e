"""Simulators that are not written in JAX: copies of one in worker processes.

This file is also the program of a worker process. It does not import jax, so that a
worker starts fast.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any, TypeAlias

import numpy as np

Make: TypeAlias = str | Callable[[], Any]
"""A function that makes a simulator, or its name as package.module:function. Every
worker calls it for a copy of its own.
"""

OPTIONAL_SETTINGS = (
    "dt",
    "control_low",
    "control_high",
    "wheelbase",
    "wind_force",
    "speed_loop",
    "speed",
)
"""Attributes of a simulator that describe its vehicle, besides `state_names`."""
PATIENCE = 120.0
"""Longest time to make a simulator, and to answer where it has no `timeout_s` [s]."""
WARNED: set[tuple[Make, str]] = set()
"""Simulators and types of faults for which a warning was given already."""


@cache
def pool_of(make: Make) -> Pool:
    """Return the workers of a simulator; all callers in this process share them."""
    return Pool(make)


class Pool:
    """Copies of a simulator, each in a process of its own, which step many vehicles.

    The new state is NaN where a step raises, hangs, ends its process, or gives no
    finite state of the right size. The first fault of each type is a warning.

    Attributes:
        settings: of the vehicle, as far as the simulator states them.
    """

    def __init__(self, make: Make) -> None:
        """Start one worker.

        Raises:
            ValueError: the simulator cannot be made; gives the reason.
        """
        first = _Worker(make)
        self.settings = first.start()
        self._size = _size(self.settings)
        # The other processes start when there is work for them.
        others = self.settings.pop("workers") - 1
        self._workers = [first, *(_Worker(make) for _ in range(others))]
        self._lock = Lock()

    def step(self, rows: np.ndarray, steps: int = 1) -> np.ndarray:
        """Return the state after each row (state, control, environment).

        Args:
            rows: one for each vehicle.
            steps: number of steps after the reset to the state of the row.
        """
        states = np.full((len(rows), self._size), np.nan)
        # A run that has ended stays NaN, and its rows are not simulated.
        alive = np.flatnonzero(np.isfinite(rows).all(axis=1))
        workers = self._workers[: len(alive)]
        parts = np.array_split(alive, max(len(workers), 1))
        # Threads with episodes of their own take turns. A step is short compared with
        # the plans that they make in between.
        with self._lock:
            for worker, part in zip(workers, parts, strict=False):
                worker.send((rows[part], steps))
            for worker, part in zip(workers, parts, strict=False):
                states[part] = worker.states(rows[part], steps)
        return states


class _Worker:
    """One process. It is started when it is needed, and again when it was lost."""

    def __init__(self, make: Make) -> None:
        self._make = make
        self._patience = PATIENCE
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> dict[str, Any]:
        """Start the process, and return the settings that the simulator states."""
        if self._process is not None:
            self._process.kill()
        self._channel, worker_end = Pipe()
        number = worker_end.fileno()
        # A program of its own: jax would hang in a fork, and a spawned process would
        # run the caller's main program again. What the worker prints goes to standard
        # error, because it is no output of a command.
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(number)],
            pass_fds=(number,),
            stdin=subprocess.DEVNULL,
            stdout=2,
        )
        weakref.finalize(self, self._process.kill)
        worker_end.close()
        self.send(([path or os.getcwd() for path in sys.path], self._make))
        settings, faults = self._answer(PATIENCE)
        if faults:
            raise ValueError(f"vehicle.env={self._make}: {faults[0]}")
        self._patience = settings.pop("timeout_s")
        self._size = _size(settings)
        return settings

    def send(self, request: Any) -> None:
        """Send a request to the process, which is started if there is none.

        If the process is gone, this is noticed when its answer is read.
        """
        if self._process is None:
            self.start()
        with suppress(OSError):
            self._channel.send(request)

    def states(self, rows: np.ndarray, steps: int) -> Any:
        """Return the states after the rows and the number of steps that were sent."""
        states, faults = self._answer(self._patience)
        if states is None:
            self.start()
            # Every row is sent again alone, so that only the row at fault is lost.
            if len(rows) > 1:
                alone = [self._states_of_row(row[None], steps) for row in rows]
                return np.concatenate(alone)
            states = np.full((1, self._size), np.nan)
        for fault in faults:
            # The type of the fault, without its numbers, which differ at every step.
            fault_type = (self._make, fault.partition(":")[0])
            if fault_type not in WARNED:
                WARNED.add(fault_type)
                warnings.warn(f"simulator {self._make}: {fault}", stacklevel=2)
        return states

    def _states_of_row(self, row: np.ndarray, steps: int) -> Any:
        self.send((row, steps))
        return self.states(row, steps)

    def _answer(self, seconds: float) -> tuple[Any, list[str]]:
        """Return answer and faults; the answer is None if the process hangs or died."""
        try:
            if self._channel.poll(seconds):
                return self._channel.recv()
            return None, [f"no answer in {seconds:g} s"]
        except (EOFError, OSError):
            return None, ["its process ended"]


class _Environment:
    """A gymnasium environment as a simulator; its observation is the state."""

    def __init__(self, env: Any) -> None:
        self._env = env
        limits = env.action_space
        self.control_low = limits.low
        self.control_high = limits.high

    def __getattr__(self, name: str) -> Any:
        """Attributes that describe the vehicle are below the wrappers of gymnasium."""
        return getattr(self._env.unwrapped, name)

    def reset(self, state: Any) -> None:
        self._state = state

    def step(self, control: Any, environment: Any) -> Any:
        self._env.reset(options={"state": self._state, "environment": environment})
        observation, _, terminated, *_ = self._env.step(control)
        if terminated:
            raise RuntimeError("the episode was terminated")
        self._state = np.asarray(observation)[: len(self._state)]
        return observation


def _settings_of(simulator: Any) -> dict[str, Any]:
    """Return the settings that a simulator states, as plain numbers and words."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    stated: dict[str, Any] = {"timeout_s": PATIENCE, "workers": cores}
    for name in (*OPTIONAL_SETTINGS, *stated):
        value = getattr(simulator, name, None)
        if value is None:
            continue
        number_type = {"workers": int, "speed_loop": bool}.get(name, float)
        plain = np.asarray(value, number_type).tolist()
        stated[name] = tuple(plain) if isinstance(plain, list) else plain
    stated["state_names"] = tuple(map(str, simulator.state_names))
    for name in ("hidden_names", "environment_names", "environment_roles"):
        stated[name] = tuple(map(str, getattr(simulator, name, ())))
    return stated


def _size(stated: dict[str, Any]) -> int:
    """Return the number of entries of a state, those that are hidden included."""
    return len(stated["state_names"]) + len(stated["hidden_names"])


def _serve(channel: Connection) -> None:
    """Make a simulator, then answer requests for steps until the channel is closed."""
    try:
        sys.path[:], make = channel.recv()
        if isinstance(make, str):
            module, _, name = make.partition(":")
            make = getattr(import_module(module), name)
        simulator = make()
        if hasattr(simulator, "action_space"):
            simulator = _Environment(simulator)
        settings = _settings_of(simulator)
    except Exception as reason:  # The code is the user's and may raise anything.
        channel.send((None, [_line(reason)]))
        return
    channel.send((settings, []))
    size = _size(settings)
    while True:
        rows, steps = channel.recv()
        faults = []
        states = np.full((len(rows), size), np.nan)
        for index, row in enumerate(rows):
            try:
                simulator.reset(row[:size])
                for _ in range(steps):
                    after = simulator.step(row[size : size + 2], row[size + 2 :])
                after = np.asarray(after, dtype=float).ravel()[:size]
                if len(after) < size or not np.isfinite(after).all():
                    raise ValueError(f"{after.tolist()} are not {size} finite numbers")
                states[index] = after
            except Exception as reason:
                faults.append(f"{_line(reason)} at {np.round(row, 4).tolist()}")
        channel.send((states, faults))


def _line(reason: Exception) -> str:
    """Return the type of an exception and the first line of its message."""
    first = (str(reason).splitlines() or [""])[0]
    return f"{type(reason).__name__}: {first}"


if __name__ == "__main__":
    with suppress(EOFError, KeyboardInterrupt):
        _serve(Connection(int(sys.argv[1])))
