"""Simulators that are not written in JAX: copies of one in worker processes.

This file is also the program of a worker. It imports no jax, so that one starts fast.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import LifoQueue
from typing import Any, TypeAlias

import numpy as np

Make: TypeAlias = str | Callable[[], Any]
"""package.module:function or the function, which a worker calls for its copy."""

KNOWN = ("dt", "control_low", "control_high", "wheelbase", "wind_force", "speed_loop")
"""What a simulator may say about its vehicle, besides `state_names`."""
START, STEP = 120.0, 20.0
"""Longest times to make a simulator and, unless it has `timeout_s`, for a step [s]."""


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
        cores = os.cpu_count() or 1
        if hasattr(os, "sched_getaffinity"):
            cores = len(os.sched_getaffinity(0))
        # The other processes start when there is work for them.
        more = self.about.pop("workers", cores) - 1
        self._idle: LifoQueue[_Worker] = LifoQueue()
        for worker in [*(_Worker(make) for _ in range(more)), first]:
            self._idle.put(worker)

    def step(self, rows: np.ndarray) -> np.ndarray:
        """Return the state one step after each row (state, control, environment)."""
        states = np.full((len(rows), len(self.about["state_names"])), math.nan)
        # A run that has ended stays NaN and costs nothing.
        alive = np.flatnonzero(np.isfinite(rows).all(axis=1))
        taken: list[_Worker] = []
        # Waits for one; the others may be at work for another thread.
        while len(taken) < len(alive) and not (taken and self._idle.empty()):
            taken.append(self._idle.get())
        parts = np.array_split(alive, max(len(taken), 1))
        try:
            for worker, part in zip(taken, parts, strict=False):
                worker.send(rows[part])
            for worker, part in zip(taken, parts, strict=False):
                states[part] = worker.receive(states[part])
        finally:
            for worker in taken:
                self._idle.put(worker)
        return states


class _Worker:
    """One process; it is started when it is needed, and again when it is lost."""

    def __init__(self, make: Make) -> None:
        self._make, self._process, self._patience = make, None, STEP
        self._rows = np.zeros((0, 0))

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
        try:
            self._channel.send(([path or os.getcwd() for path in sys.path], self._make))
            about = self._answer(START)
        except (EOFError, OSError) as reason:
            about = str(reason) or "its process ended"
        if isinstance(about, str):
            raise ValueError(f"vehicle.env={self._make}: {about}")
        self._patience = about.pop("timeout_s")
        return about

    def send(self, rows: np.ndarray, *, singly: bool = False) -> None:
        """Begin to step rows; `singly`: with an answer after each of them."""
        if self._process is None:
            self.start()
        self._rows = rows
        # A process that is gone is noticed when its answer is missing.
        with suppress(OSError):
            self._channel.send((rows, singly))

    def receive(self, states: np.ndarray) -> np.ndarray:
        """Return the states of the rows that were sent, in the array that is given."""
        rows, done, singly = self._rows, 0, len(states) == 1
        while done < len(rows):
            try:
                after, faults = self._answer(self._patience)
            except (EOFError, OSError) as reason:
                if singly:
                    self._warn(str(reason) or "its process ended", rows[done])
                    done += 1
                # One by one from here on, so that only the row at fault is lost.
                singly = True
                self.start()
                self.send(rows[done:], singly=True)
                continue
            for index, fault in faults:
                self._warn(fault, rows[done + index])
            states[done : done + len(after)] = after
            done += len(after)
        return states

    def _answer(self, seconds: float) -> Any:
        if not self._channel.poll(seconds):
            raise TimeoutError(f"no answer in {seconds:g} s")
        return self._channel.recv()

    def _warn(self, fault: str, row: np.ndarray) -> None:
        if (self._make, fault) not in _SAID:
            _SAID.add((self._make, fault))
            text = f"simulator {self._make}: {fault} at {np.round(row, 4).tolist()}"
            warnings.warn(text, stacklevel=2)


_SAID: set[tuple[Make, str]] = set()
"""Faults that were warned about; they have no place in the text of a second one."""


class _Environment:
    """A gymnasium environment as a simulator; its observation is the state."""

    def __init__(self, env: Any) -> None:
        self._env, self._state = env, None
        self.control_low, self.control_high = (
            env.action_space.low,
            env.action_space.high,
        )

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
    about: dict[str, Any] = {"timeout_s": STEP, "dt": simulator.dt}
    for name in (*KNOWN, "workers", "timeout_s"):
        if (value := getattr(simulator, name, None)) is not None:
            kind = {"workers": int, "speed_loop": bool}.get(name, float)
            plain = np.asarray(value, kind).tolist()
            about[name] = tuple(plain) if isinstance(plain, list) else plain
    return about | {"state_names": tuple(map(str, simulator.state_names))}


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
        channel.send(_line(reason))
        return
    channel.send(about)
    size, often = len(about["state_names"]), 0.25 * about["timeout_s"]
    while True:
        rows, singly = channel.recv()
        states, faults, began = [], [], time.monotonic()
        for left, row in zip(range(len(rows) - 1, -1, -1), rows, strict=True):
            try:
                simulator.reset(row[:size])
                after = simulator.step(row[size : size + 2], row[size + 2 :])
                after = np.asarray(after, dtype=float).ravel()[:size]
                if len(after) < size or not np.isfinite(after).all():
                    raise ValueError(f"{after.tolist()} are not {size} finite numbers")
            except Exception as reason:
                after = np.full(size, math.nan)
                faults.append((len(states), _line(reason)))
            states.append(after)
            # Early too: who waits must tell slow steps from one that hangs.
            if not left or singly or time.monotonic() - began > often:
                channel.send((np.asarray(states), faults))
                states, faults, began = [], [], time.monotonic()


def _line(reason: Exception) -> str:
    first = (str(reason).splitlines() or [""])[0]
    return f"{type(reason).__name__}: {first}"


if __name__ == "__main__":
    try:
        _serve(Connection(int(sys.argv[1])))
    except (EOFError, KeyboardInterrupt):
        sys.exit()
