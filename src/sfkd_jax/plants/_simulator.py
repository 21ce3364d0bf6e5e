"""Simulators that are not written in JAX: copies of one in worker processes.

This file is also the program of a worker. It imports no jax, so that one starts fast.
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
"""package.module:function or the function, which a worker calls for its copy."""

KNOWN = ("dt", "control_low", "control_high", "wheelbase", "wind_force", "speed_loop")
"""What a simulator may say about its vehicle, besides `state_names`."""
PATIENCE = 120.0
"""Longest time to make a simulator and, unless it has `timeout_s`, to answer [s]."""
SAID: set[tuple[Make, str]] = set()
"""Faults that were warned about."""


@cache
def pool_of(make: Make) -> Pool:
    """Return the workers of a simulator, which everybody in this process shares."""
    return Pool(make)


class Pool:
    """Copies of a simulator, each in a process of its own, which step many vehicles.

    A step that raises, hangs, ends its process, or gives no finite state of the right
    size, is NaN. Of each kind of fault the first is a warning.

    Attributes:
        about: settings of the vehicle that the simulator knows.
    """

    def __init__(self, make: Make) -> None:
        """Start one worker; a ValueError says why the simulator cannot be made."""
        first = _Worker(make)
        self.about = first.start()
        # The other processes start when there is work for them.
        more = self.about.pop("workers") - 1
        self._workers = [first, *(_Worker(make) for _ in range(more))]
        self._lock = Lock()

    def step(self, rows: np.ndarray) -> np.ndarray:
        """Return the state one step after each row (state, control, environment)."""
        states = np.full((len(rows), len(self.about["state_names"])), np.nan)
        # A run that has ended stays NaN and costs nothing.
        alive = np.flatnonzero(np.isfinite(rows).all(axis=1))
        taken = self._workers[: len(alive)]
        parts = np.array_split(alive, max(len(taken), 1))
        # Episodes of several threads take turns: a step is short beside their plans.
        with self._lock:
            for worker, part in zip(taken, parts, strict=False):
                worker.send(rows[part])
            for worker, part in zip(taken, parts, strict=False):
                states[part] = worker.states(rows[part])
        return states


class _Worker:
    """One process; it is started when it is needed, and again when it is lost."""

    def __init__(self, make: Make) -> None:
        self._make = make
        self._patience = PATIENCE
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> dict[str, Any]:
        """Start the process, and return what the simulator says about itself."""
        if self._process is not None:
            self._process.kill()
        self._channel, theirs = Pipe()
        number = theirs.fileno()
        # A program, not a fork, in which jax would hang, and not a spawned copy of the
        # caller's main program either. What it prints is no output of a command.
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(number)],
            pass_fds=(number,),
            stdin=subprocess.DEVNULL,
            stdout=2,
        )
        weakref.finalize(self, self._process.kill)
        theirs.close()
        self.send(([path or os.getcwd() for path in sys.path], self._make))
        about, faults = self._answer(PATIENCE)
        if faults:
            raise ValueError(f"vehicle.env={self._make}: {faults[0]}")
        self._patience = about.pop("timeout_s")
        self._size = len(about["state_names"])
        return about

    def send(self, what: Any) -> None:
        """Ask for something; that the process is gone is noticed by its answer."""
        if self._process is None:
            self.start()
        with suppress(OSError):
            self._channel.send(what)

    def states(self, rows: np.ndarray) -> Any:
        """Return the states one step after the rows that were sent."""
        states, faults = self._answer(self._patience)
        if states is None:
            self.start()
            # One by one, so that only the row at fault is lost.
            if len(rows) > 1:
                return np.concatenate([self._alone(row[None]) for row in rows])
            states = np.full((1, self._size), np.nan)
        for fault in faults:
            # Its kind, not its numbers, which differ at every step.
            kind = self._make, fault.partition(":")[0]
            if kind not in SAID:
                SAID.add(kind)
                warnings.warn(f"simulator {self._make}: {fault}", stacklevel=2)
        return states

    def _alone(self, row: np.ndarray) -> Any:
        self.send(row)
        return self.states(row)

    def _answer(self, seconds: float) -> tuple[Any, list[str]]:
        """The answer and faults; None if the process hangs or has ended."""
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
        """What describes the vehicle is below the wrappers of gymnasium."""
        return getattr(self._env.unwrapped, name)

    def reset(self, state: Any) -> None:
        self._state = state

    def step(self, control: Any, environment: Any) -> Any:
        self._env.reset(options={"state": self._state, "environment": environment})
        observation, _, terminated, *_ = self._env.step(control)
        if terminated:
            raise RuntimeError("the episode was terminated")
        return observation


def _about(simulator: Any) -> dict[str, Any]:
    """What a simulator says about itself, as plain numbers and words."""
    about: dict[str, Any] = {"timeout_s": PATIENCE, "workers": os.cpu_count() or 1}
    if hasattr(os, "sched_getaffinity"):
        about["workers"] = len(os.sched_getaffinity(0))
    for name in (*KNOWN, *about):
        if (value := getattr(simulator, name, None)) is not None:
            kind = {"workers": int, "speed_loop": bool}.get(name, float)
            plain = np.asarray(value, kind).tolist()
            about[name] = tuple(plain) if isinstance(plain, list) else plain
    names = {"environment_names": getattr(simulator, "environment_names", ())}
    names |= {"state_names": simulator.state_names}
    return about | {name: tuple(map(str, each)) for name, each in names.items()}


def _serve(channel: Connection) -> None:
    """Make a simulator, then step what is asked for until nobody asks any more."""
    try:
        sys.path[:], make = channel.recv()
        if isinstance(make, str):
            module, _, name = make.partition(":")
            make = getattr(import_module(module), name)
        simulator = make()
        if hasattr(simulator, "action_space"):
            simulator = _Environment(simulator)
        about = _about(simulator)
    except Exception as reason:  # code of the user raises anything
        channel.send((None, [_line(reason)]))
        return
    channel.send((about, []))
    size = len(about["state_names"])
    while True:
        rows = channel.recv()
        faults = []
        states = np.full((len(rows), size), np.nan)
        for index, row in enumerate(rows):
            try:
                simulator.reset(row[:size])
                after = simulator.step(row[size : size + 2], row[size + 2 :])
                after = np.asarray(after, dtype=float).ravel()[:size]
                if len(after) < size or not np.isfinite(after).all():
                    raise ValueError(f"{after.tolist()} are not {size} finite numbers")
                states[index] = after
            except Exception as reason:
                faults.append(f"{_line(reason)} at {np.round(row, 4).tolist()}")
        channel.send((states, faults))


def _line(reason: Exception) -> str:
    first = (str(reason).splitlines() or [""])[0]
    return f"{type(reason).__name__}: {first}"


if __name__ == "__main__":
    with suppress(EOFError, KeyboardInterrupt):
        _serve(Connection(int(sys.argv[1])))
