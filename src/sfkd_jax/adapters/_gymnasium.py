"""The vehicles and scenarios as a gymnasium environment, drawn with matplotlib."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float, UInt8

from sfkd_jax.adapters._task import DrivingTask, Moment
from sfkd_jax.scenarios import Scenario, point_at

NAME = "sfkd_jax/Vehicle-v0"
PROCESS = os.getpid()
"""That imported this file, and started jax; a forked one inherits the number."""
MODES = ("human", "rgb_array")
SIZE, DPI = (6.4, 4.8), 100
"""Of the image [inch], pixels an inch."""
VIEW = 30.0
"""Half width of the view around the car [m]."""
CAR = np.asarray([[2.25, 0.9], [2.25, -0.9], [-2.25, -0.9], [-2.25, 0.9]])
"""Corners of the drawn car ahead and to the left of its centre [m]."""


def register_gymnasium() -> None:
    """Make `gymnasium.make("sfkd_jax/Vehicle-v0", …)` build a `GymnasiumVehicle`."""
    # A second registration would warn.
    if NAME not in gymnasium.registry:
        gymnasium.register(id=NAME, entry_point="sfkd_jax.adapters:GymnasiumVehicle")


class GymnasiumVehicle(gymnasium.Env):
    """Path following as `gymnasium.Env`, with the settings of `DrivingTask`.

    Observation, action and reward are those of `DrivingTask`. An episode is terminated
    if the car leaves the lane and truncated at the end of the road. The same seed gives
    the same road, friction and wind; `reset` without a seed gives the next of the
    stream that the last seed began.
    """

    metadata = {"render_modes": list(MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode not in (None, *MODES):
            raise ValueError(
                f"render_mode must be one of {', '.join(MODES)}, got {render_mode!r}"
            )
        task = self._task = DrivingTask(**settings)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / task.plant.dt)}
        low, high = (np.asarray(end, np.float32) for end in task.observation_bounds)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (task.action_size,), np.float32
        )
        self._now: tuple[Scenario, Moment] | None = None
        self._view: _RoadView | None = None
        self._start, self._advance = jax.jit(task.reset), jax.jit(task.step)
        self._observe = jax.jit(task.observe)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode on a new road; there are no options."""
        # Not in __init__: gymnasium passes on what a worker raises from here on.
        if os.getpid() != PROCESS:
            raise RuntimeError(
                "jax hangs in a forked process: pass "
                'vector_kwargs={"context": "spawn"} to gymnasium.make_vec'
            )
        super().reset(seed=seed, options=options)
        # gymnasium's generator decides, as its contract on seeds asks for.
        seed = int(self.np_random.integers(2**31))
        road, moment = self._now = self._start(jax.random.key(seed))
        if self.render_mode is not None:
            if self._view is None:
                self._view = _RoadView(self._task, human=self.render_mode == "human")
            self._view.start(road)
        return self._seen(road, moment), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulate one sampling period."""
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        road, moment = self._now
        action = np.asarray(action, dtype=np.float32)
        moment, outcome = self._advance(road, moment, action)
        self._now = road, moment
        return (
            self._seen(road, moment),
            float(outcome.reward),
            bool(outcome.left),
            bool(outcome.over),
            {name: float(value) for name, value in outcome.measures.items()},
        )

    def _seen(self, road: Scenario, moment: Moment) -> np.ndarray:
        """Extend the drawn line, and return the observation."""
        if self._view is not None:
            self._view.follow(moment)
            # A window is drawn at once, an image on demand, as gymnasium asks for.
            if self.render_mode == "human":
                self._view.draw(road, moment)
        space: Any = self.observation_space
        # Rounding may take an angle beyond its bound.
        return np.clip(np.array(self._observe(road, moment)), space.low, space.high)

    def render(self) -> np.ndarray | None:  # pyright: ignore
        """Return the image of the last step, uint8, if the mode is "rgb_array"."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render is called without a render_mode; pass render_mode to make"
            )
            return None
        if self._view is None or self._now is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        if self.render_mode == "human":
            return None
        self._view.draw(*self._now)
        return self._view.image()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None


class _RoadView:
    """A view of path, lane, car and deviation that follows the car."""

    def __init__(self, task: DrivingTask, *, human: bool) -> None:
        from matplotlib import pyplot
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._pyplot, self._human = pyplot, human
        self._dt, self._lane = task.plant.dt, task.lane
        # Images not by pyplot, which would keep every figure that is made.
        make = pyplot.figure if human else Figure
        self._figure = make(figsize=SIZE, dpi=DPI)
        if not human:
            FigureCanvasAgg(self._figure)
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

    def start(self, road: Scenario) -> None:
        """Begin an episode on a road."""
        points = np.asarray(road.path.points)
        normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
        self._path.set_data(*points[:, :2].T)
        for edge, side in zip(self._edges, (-1.0, 1.0), strict=True):
            edge.set_data(*(points[:, :2] + side * self._lane * normal).T)
        self._trail: list[Float[np.ndarray, " 2"]] = []

    def follow(self, moment: Moment) -> None:
        """Extend the driven line."""
        self._trail.append(np.asarray(moment.state)[:2])

    def draw(self, road: Scenario, moment: Moment) -> None:
        """Draw one frame."""
        state = np.asarray(moment.state)
        foot = np.asarray(point_at(road.path, moment.progress))[:2]
        self._driven.set_data(*np.stack(self._trail).T)
        # From the path to the car, so that its length is the deviation.
        self._deviation.set_data(*np.stack([foot, state[:2]]).T)
        c, s = np.cos(state[2]), np.sin(state[2])
        self._car.set_xy(state[:2] + CAR @ np.asarray([[c, s], [-s, c]]))
        self._axes.set_xlim(state[0] - VIEW, state[0] + VIEW)
        self._axes.set_ylim(state[1] - 0.75 * VIEW, state[1] + 0.75 * VIEW)
        self._axes.set_title(
            f"{int(moment.count) * self._dt:.1f} s, {state[3]:.1f} m/s, "
            f"deviation {float(moment.lateral):+.2f} m"
        )
        if self._human:
            # Shows the window, and lets a person watch in real time.
            self._pyplot.pause(self._dt)
        else:
            self._figure.canvas.draw()

    def image(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the last frame."""
        canvas: Any = self._figure.canvas
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._human:
            self._pyplot.close(self._figure)
