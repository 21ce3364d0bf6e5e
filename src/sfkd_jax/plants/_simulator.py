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
from queue import Empty, LifoQueue
from typing import Any, TypeAlias

import numpy as np

Make: TypeAlias = str | Callable[[], Any]
"""package.module:function or the function, which a worker calls for its copy."""

KNOWN = ("control_low", "control_high", "wheelbase", "speed_loop", "wind_force")
"""What a simulator may know of its vehicle, besides dt and the names of states."""
KINDS = {"workers": int, "speed_loop": bool}
"""Of what is no number or pair of numbers."""
START = 120.0
"""Longest time until a worker has made its copy [s]."""
STEP = 20.0
"""Longest time for one step, unless the simulator has `timeout_s` [s]."""
MOST_LOST = 5
"""Processes that a worker may lose; after that it simulates nothing any more."""


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
        self.about = dict(first.about)
        cores = os.cpu_count() or 1
        if hasattr(os, "sched_getaffinity"):
            cores = len(os.sched_getaffinity(0))
        count = self.about.pop("workers", cores)
        # The other processes start when there is work for them.
        self._idle: LifoQueue[_Worker] = LifoQueue()
        for worker in [*(_Worker(make, first) for _ in range(count - 1)), first]:
            self._idle.put(worker)

    def step(self, rows: np.ndarray) -> np.ndarray:
        """Return the state one step after each row (state, control, environment)."""
        states = np.full((len(rows), len(self.about["state_names"])), math.nan)
        # A run that has ended stays NaN and costs nothing.
        alive = np.flatnonzero(np.isfinite(rows).all(axis=1))
        if not len(alive):
            return states
        # Waits for one; the others may be at work for another thread.
        taken = [self._idle.get()]
        while len(taken) < len(alive):
            try:
                taken.append(self._idle.get_nowait())
            except Empty:
                break
        parts = np.array_split(alive, len(taken))
        try:
            for worker, part in zip(taken, parts, strict=True):
                worker.send(rows[part])
            for worker, part in zip(taken, parts, strict=True):
                states[part] = worker.receive()
        finally:
            for worker in taken:
                self._idle.put(worker)
        return states


class _Worker:
    """One process; it is started when it is needed, and again when it is lost."""

    def __init__(self, make: Make, like: _Worker | None = None) -> None:
        """Start it, or know of another one what the simulator is."""
        self._make, self._lost, self._process = make, 0, None
        self._told: set[str] = set() if like is None else like._told
        self._rows = np.zeros((0, 0))
        self.about: dict[str, Any] = like.about if like else self._start()

    def _start(self) -> dict[str, Any]:
        """Start the process, and return what the simulator says about itself."""
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
        paths = [path or os.getcwd() for path in sys.path]
        try:
            self._channel.send((paths, self._make))
            about = self._answer(START)
        except (EOFError, OSError) as reason:
            about = str(reason) or "its process ended"
        if isinstance(about, str):
            raise ValueError(f"vehicle.env={self._make}: {about}")
        return about

    def _answer(self, seconds: float) -> Any:
        if not self._channel.poll(seconds):
            raise TimeoutError(f"no answer in {seconds:g} s")
        return self._channel.recv()

    def send(self, rows: np.ndarray) -> None:
        """Begin to step rows."""
        self._rows = rows
        if self._process is None:
            self._start()
        self._ask(rows, singly=False)

    def _ask(self, rows: np.ndarray, *, singly: bool) -> None:
        # A process that is gone is noticed when its answer is missing.
        with suppress(OSError):
            self._channel.send((rows, singly))

    def receive(self) -> np.ndarray:
        """Return the states of the rows that were sent."""
        rows, singly, done = self._rows, len(self._rows) == 1, 0
        states = np.full((len(rows), len(self.about["state_names"])), math.nan)
        while done < len(rows) and self._lost < MOST_LOST:
            try:
                after, faults = self._answer(self.about["timeout_s"])
            except (EOFError, OSError) as reason:
                if singly:
                    self._warn(str(reason) or "its process ended", rows[done])
                    done += 1
                # One by one from here on, so that only the row at fault is lost.
                singly = True
                self._restart()
                self._ask(rows[done:], singly=True)
                continue
            for index, fault in faults:
                self._warn(fault, rows[done + index])
            states[done : done + len(after)] = after
            done += len(after)
        return states

    def _restart(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._lost += 1
        if self._lost == MOST_LOST:
            self._warn(f"lost {MOST_LOST} processes, nothing more is simulated")
        else:
            self._start()

    def _warn(self, fault: str, *rows: np.ndarray) -> None:
        if fault not in self._told:
            self._told.add(fault)
            where = [f" at {np.round(row, 4).tolist()}" for row in rows]
            text = f"simulator {self._make}: {fault}{''.join(where)}"
            warnings.warn(text, stacklevel=2)


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
    known = {name: getattr(simulator, name, None) for name in (*KNOWN, "workers")}
    known |= {"timeout_s": getattr(simulator, "timeout_s", STEP), "dt": simulator.dt}
    about: dict[str, Any] = {"state_names": tuple(map(str, simulator.state_names))}
    for name, value in known.items():
        if value is not None:
            plain = np.asarray(value, KINDS.get(name, float)).tolist()
            about[name] = tuple(plain) if isinstance(plain, list) else plain
    return about


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
        for index, row in enumerate(rows):
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
            due = singly or time.monotonic() - began > often
            if due or index + 1 == len(rows):
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
