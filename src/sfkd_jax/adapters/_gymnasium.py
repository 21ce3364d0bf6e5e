"""The vehicles and scenarios as a gymnasium environment, drawn with matplotlib."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import UInt8

from sfkd_jax.adapters._task import DrivingTask, LaneTask, Moment
from sfkd_jax.driving.scenarios import Scenario

PROCESS = os.getpid()
"""The process that imported this file and started jax; a forked one inherits this."""
VIEW = 30.0
"""Half width of the view around the car [m]."""
CORNERS = np.asarray([[1, 1], [1, -1], [-1, -1], [-1, 1]])
"""Corners of a car, ahead and to the left of its centre, in shares of half its size."""


def register_gymnasium() -> None:
    """Tell `gymnasium.make` of "sfkd_jax/Vehicle-v0" and "sfkd_jax/Lane-v0"."""
    entry_points = {
        "sfkd_jax/Vehicle-v0": "sfkd_jax.adapters:GymnasiumVehicle",
        "sfkd_jax/Lane-v0": "sfkd_jax.adapters:GymnasiumLane",
    }
    for name, entry_point in entry_points.items():
        # A second registration would warn.
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point)


class GymnasiumVehicle(gymnasium.Env):
    """Path following as `gymnasium.Env`, with the settings of `DrivingTask`.

    Observation, action and reward are those of `DrivingTask`. An episode is terminated
    if the car leaves the lane and truncated at the end of the road. The same seed gives
    the same road, friction and wind; `reset` without a seed gives the next of the
    stream that the last seed began.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    task: type[DrivingTask] = DrivingTask

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array, got {render_mode!r}")
        task = self.task(**settings)
        self._task = task
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / task.plant.dt)}
        space = jax.tree.map(gymnasium.spaces.Box, *task.observation_bounds)
        if isinstance(space, dict):
            space = gymnasium.spaces.Dict(space)
        self.observation_space = space
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (task.action_size,), np.float32
        )
        self._now: tuple[Scenario, Moment] | None = None
        self._driven: list[np.ndarray] = []
        self._start = jax.jit(task.reset)
        self._advance = jax.jit(task.step)
        self._observe = jax.jit(task.observe)

    def situation(self) -> tuple[Any, Any, Any]:
        """Return what `Controller.act` takes: state, e, and what is ahead."""
        return self._task.situation(*self._reached())

    def control(self, action: Any) -> np.ndarray:
        """Return an action in [-1, 1] as a control of the vehicle."""
        return np.asarray(self._task.control(jax.numpy.asarray(action, np.float32)))

    def action(self, control: Any) -> np.ndarray:
        """Return a control of the vehicle as an action in [-1, 1]."""
        return np.asarray(self._task.action(jax.numpy.asarray(control, np.float32)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
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
        road, moment = self._start(jax.random.key(seed))
        self._now = (road, moment)
        self._driven = []
        return self._seen(road, moment), {}

    def step(
        self, action: np.ndarray | None
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Simulate one sampling period; with None neither steering nor drive."""
        road, moment = self._reached()
        if action is None:
            action = self.action(np.zeros(self._task.action_size))
        action = np.asarray(action, dtype=np.float32)
        moment, outcome = self._advance(road, moment, action)
        self._now = (road, moment)
        return (
            self._seen(road, moment),
            float(outcome.reward),
            bool(outcome.left),
            bool(outcome.over),
            {name: float(value) for name, value in outcome.measures.items()},
        )

    def _seen(self, road: Scenario, moment: Moment) -> Any:
        """Extend the driven line, and return the observation."""
        self._driven.append(np.asarray(moment.state)[:2])
        seen = jax.tree.map(np.array, self._observe(road, moment))
        # Rounding may take an angle beyond its bound.
        return jax.tree.map(np.clip, seen, *self._task.observation_bounds)

    def render(self) -> np.ndarray | None:  # pyright: ignore
        """Return the image of the last step, uint8, if the mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return _image(self._task, *self._reached(), self._driven)

    def _reached(self) -> tuple[Scenario, Moment]:
        """Return the road, and where the car is on it."""
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        return self._now


class GymnasiumLane(GymnasiumVehicle):
    """Driving round obstacles as `gymnasium.Env`, with the settings of `LaneTask`.

    `policy.in_lane()` drives it: its `act` takes `situation()`, `action` its control.
    """

    task = LaneTask


def _image(
    task: DrivingTask, road: Scenario, moment: Moment, driven: list[Any]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw path, lane and driven line around the car."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    # Not of pyplot, which would keep every figure that is made.
    figure = Figure(figsize=(6.4, 4.8), dpi=100)
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    points = np.asarray(road.path.points)
    state = np.asarray(moment.state)
    left = task.lane
    right = task.lane
    if road.course is not None:
        lane, obstacles = jax.tree.map(np.asarray, road.course[:2])
        left = lane.left
        right = lane.right
        for position, _, half, radius, present in zip(*obstacles, strict=True):
            # An obstacle that is not present is a circle of radius 0.
            size = present * (radius + np.hypot(*half))
            axes.add_patch(Circle(position[0], size))
    normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])])
    for side, dashes in ((-right, "--"), (0.0, "-"), (left, "--")):
        line = points[:, :2].T + side * normal
        axes.plot(*line, dashes, color="0.6", linewidth=1)
    axes.plot(*np.stack(driven).T, color="C0", linewidth=1.5)
    cos = np.cos(state[2])
    sin = np.sin(state[2])
    turn = np.asarray([[cos, sin], [-sin, cos]])
    corners = state[:2] + (CORNERS * task.plant.size.half) @ turn
    axes.fill(*corners.T, "C0", alpha=0.6)
    axes.set_xlim(state[0] - VIEW, state[0] + VIEW)
    axes.set_ylim(state[1] - 0.75 * VIEW, state[1] + 0.75 * VIEW)
    axes.set_title(
        f"{int(moment.count) * task.plant.dt:.1f} s, {state[3]:.1f} m/s, "
        f"deviation {float(moment.lateral):+.2f} m"
    )
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
