"""Draw a car on its road with matplotlib, which is imported only when drawing."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

SIZE = (6.4, 4.8)
"""Of the image [inch], at 100 pixels an inch."""
VIEW = 30.0
"""Half width of the view around the car [m]."""
CAR = (4.5, 1.8)
"""Length and width of the drawn car [m]."""


class RoadView:
    """A view of path, lane, car and deviation that follows the car.

    Args:
        dt: duration of one frame on the screen [s].
        lane: half width [m].
        human: whether to show a window; otherwise frames are images only.
    """

    def __init__(self, *, dt: float, lane: float, human: bool) -> None:
        from matplotlib.figure import Figure

        self._dt, self._lane, self._interactive = dt, lane, False
        if human:
            from matplotlib import get_backend, pyplot
            from matplotlib.backends.registry import (
                BackendFilter,
                backend_registry,
            )

            self._figure = pyplot.figure(figsize=SIZE, dpi=100)
            # A figure without a screen must not wait for events.
            known = backend_registry.list_builtin(BackendFilter.INTERACTIVE)
            backend = get_backend().lower()
            self._interactive = backend in {name.lower() for name in known}
            if self._interactive:
                pyplot.show(block=False)
        else:
            from matplotlib.backends.backend_agg import FigureCanvasAgg

            self._figure = Figure(figsize=SIZE, dpi=100)
            # Not by pyplot, which would keep every figure that is made.
            FigureCanvasAgg(self._figure)
        self._human = human
        self._make_artists()

    def _make_artists(self) -> None:
        """Lines and shapes that every frame moves."""
        # Made once and moved: drawing axes anew for every frame is slow.
        axes = self._axes = self._figure.add_subplot()
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        (self._path,) = axes.plot([], [], color="0.4", linewidth=1.0, label="path")
        self._edges = [
            axes.plot([], [], color="0.7", linewidth=1.0, linestyle="--")[0]
            for _ in range(2)
        ]
        (self._driven,) = axes.plot([], [], color="C0", linewidth=1.5, label="driven")
        (self._deviation,) = axes.plot([], [], color="C3", linewidth=2.0)
        (self._car,) = axes.fill([0.0], [0.0], color="C0", alpha=0.6)
        axes.legend(loc="lower right")

    def start(self, points: Float[np.ndarray, "point 4"]) -> None:
        """Begin an episode on a path of x [m], y [m], yaw [rad] and curvature."""
        normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
        self._path.set_data(*points[:, :2].T)
        for edge, side in zip(self._edges, (-1.0, 1.0), strict=True):
            edge.set_data(*(points[:, :2] + side * self._lane * normal).T)
        self._trail: list[Any] = []

    def follow(self, state: Float[np.ndarray, " state"]) -> None:
        """Extend the driven line to a state."""
        self._trail.append(state[:2])

    def draw(
        self,
        state: Float[np.ndarray, " state"],
        foot: Float[np.ndarray, " 2"],
        title: str,
    ) -> None:
        """Draw one frame.

        Args:
            state: x [m], y [m], yaw [rad], ….
            foot: closest point of the path [m].
            title: of the frame.
        """
        self._driven.set_data(*np.stack(self._trail).T)
        # From the path to the car, so that its length is the deviation.
        self._deviation.set_data(*np.stack([foot, state[:2]]).T)
        self._car.set_xy(_corners(state))
        self._axes.set_xlim(state[0] - VIEW, state[0] + VIEW)
        self._axes.set_ylim(state[1] - 0.75 * VIEW, state[1] + 0.75 * VIEW)
        self._axes.set_title(title)
        self._figure.canvas.draw()
        if self._interactive:
            self._figure.canvas.start_event_loop(self._dt)

    def image(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the last frame."""
        canvas: Any = self._figure.canvas
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._human:
            from matplotlib import pyplot

            pyplot.close(self._figure)


def _corners(state: Float[np.ndarray, " state"]) -> Float[np.ndarray, "4 2"]:
    """Corners of the car [m]."""
    length, width = CAR
    x = 0.5 * length * np.asarray([1.0, 1.0, -1.0, -1.0])
    y = 0.5 * width * np.asarray([1.0, -1.0, -1.0, 1.0])
    c, s = np.cos(state[2]), np.sin(state[2])
    return np.stack([state[0] + c * x - s * y, state[1] + s * x + c * y], axis=1)
