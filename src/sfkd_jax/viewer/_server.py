"""The page of a live drive: it is served, and drawn anew while the car drives."""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from sfkd_jax.viewer._live_drive import LiveDrive, UserInput
from sfkd_jax.viewer._nodes import Nodes
from sfkd_jax.viewer._panel import Panel

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
"""The page is served to this machine alone."""
DRAWN = 3
"""How often the car is drawn in a control step."""


@contextmanager
def served(port: int) -> Iterator[viser.ViserServer]:
    """Serve an empty page, until the context ends.

    Args:
        port: 0 for any that is free.

    Raises:
        ValueError: the package viser is missing, or the port cannot be used.
    """
    try:
        import viser
    except ModuleNotFoundError as missing:
        raise ValueError(
            f'the viewer needs {missing.name}: pip install "sfkd-jax[viewer]"'
        ) from missing
    # viser would take the next port that is free, and nobody would know.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as reason:
            raise ValueError(
                f"demo.port={port} cannot be used: {reason.strerror}; choose another"
            ) from reason
    with _quiet():
        server = viser.ViserServer(HOST, port, label="sfkd_jax", verbose=False)
    try:
        yield server
    finally:
        with _quiet():
            server.stop()


def _quiet() -> redirect_stdout:
    """Keep what viser prints off stdout, whose last line is a JSON document."""
    return redirect_stdout(io.StringIO())


def address(server: viser.ViserServer) -> str:
    """Return the address of the page."""
    return f"http://{server.get_host()}:{server.get_port()}"


def show(
    server: viser.ViserServer,
    drive: LiveDrive,
    *,
    user_input: UserInput | None = None,
    steps: int | None = None,
    seed: int = 0,
    started: Callable[[str, Panel], None] | None = None,
) -> dict[str, Any]:
    """Drive and draw in real time, until Ctrl-C.

    Args:
        server: of the page.
        drive: that is shown.
        user_input: at the start; by default `LiveDrive.first_input`.
        steps: number of control steps after which it ends; None for no end.
        seed: of the noise of the sensors and of the planner.
        started: called with the address and the panel before the first step.

    Returns:
        Address of the page, number of control steps, and since the last restart the
        time [s] and the largest deviation [m].
    """
    user_input = user_input or drive.first_input
    first = user_input.obstacles
    nodes = Nodes(server, drive.lane, user_input)
    panel = Panel(server, drive, user_input)
    half = drive.policy.vehicle.size.half
    start = drive.start(jax.random.key(seed))
    state = start
    # The first step compiles; the car stays where it is.
    _, before = drive.step(state, user_input)
    if started is not None:
        started(address(server), panel)
    done = 0
    due = time.monotonic()
    try:
        while steps is None or done < steps:
            due = max(due + drive.dt, time.monotonic())
            if panel.restarted.is_set():
                panel.restarted.clear()
                nodes.place(first)
                state = start
                _, before = drive.step(state, user_input)
            user_input = panel.user_input(nodes.obstacles())
            after, moment = drive.step(state, user_input)
            with server.atomic():
                nodes.draw(moment, user_input)
                panel.read(after, moment)
            for share in np.arange(1, DRAWN + 1) / DRAWN:
                with server.atomic():
                    nodes.move(
                        between(before.pose, moment.pose, share),
                        between(before.centre, moment.centre, share),
                        half,
                    )
                _wait_until(due - drive.dt * (1.0 - share))
            before = moment
            # While the car waits, the page shows what it would do next.
            if not panel.paused.is_set():
                state = after
                done += 1
    except KeyboardInterrupt:
        pass
    return {
        "address": address(server),
        "steps": done,
        "driven_s": state.time,
        "max_deviation_m": state.largest,
    }


def between(
    pose: Float[np.ndarray, " 3"], other: Float[np.ndarray, " 3"], share: float
) -> Float[np.ndarray, " 3"]:
    """Return the pose at a share of the way to another one, both x, y, yaw."""
    way = other - pose
    turn = (way[2] + np.pi) % (2.0 * np.pi) - np.pi
    return pose + share * np.array([way[0], way[1], turn])


def _wait_until(time_s: float) -> None:
    """Sleep until a time of the monotonic clock [s]."""
    time.sleep(max(time_s - time.monotonic(), 0.0))
