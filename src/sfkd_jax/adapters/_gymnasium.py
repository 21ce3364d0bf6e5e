"""The vehicles and scenarios as a gymnasium environment, drawn with matplotlib."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import UInt8

from sfkd_jax.adapters._task import DrivingTask, Moment
from sfkd_jax.scenarios import Scenario

NAME = "sfkd_jax/Vehicle-v0"
PROCESS = os.getpid()
"""That imported this file, and started jax; a forked one inherits the number."""
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

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array, got {render_mode!r}")
        task = self._task = DrivingTask(**settings)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / task.plant.dt)}
        low, high = (np.asarray(end, np.float32) for end in task.observation_bounds)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (task.action_size,), np.float32
        )
        self._now: tuple[Scenario, Moment] | None = None
        self._driven: list[np.ndarray] = []
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
        self._driven = []
        return self._seen(road, moment), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulate one sampling period."""
        road, moment = self._reached()
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
        """Extend the driven line, and return the observation."""
        self._driven.append(np.asarray(moment.state)[:2])
        space: Any = self.observation_space
        # Rounding may take an angle beyond its bound.
        return np.clip(np.array(self._observe(road, moment)), space.low, space.high)

    def render(self) -> np.ndarray | None:  # pyright: ignore
        """Return the image of the last step, uint8, if the mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return _image(self._task, *self._reached(), self._driven)

    def _reached(self) -> tuple[Scenario, Moment]:
        """The road, and where the car is on it."""
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        return self._now


def _image(
    task: DrivingTask, road: Scenario, moment: Moment, driven: list[Any]
) -> UInt8[np.ndarray, "height width 3"]:
    """Path, lane and driven line around the car."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Not of pyplot, which would keep every figure that is made.
    figure = Figure(figsize=(6.4, 4.8), dpi=100)
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    points, state = np.asarray(road.path.points), np.asarray(moment.state)
    normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
    for side, dashes in ((-task.lane, "--"), (0.0, "-"), (task.lane, "--")):
        axes.plot(*(points[:, :2] + side * normal).T, dashes, color="0.6", linewidth=1)
    axes.plot(*np.stack(driven).T, color="C0", linewidth=1.5)
    c, s = np.cos(state[2]), np.sin(state[2])
    axes.fill(*(state[:2] + CAR @ np.asarray([[c, s], [-s, c]])).T, "C0", alpha=0.6)
    axes.set_xlim(state[0] - VIEW, state[0] + VIEW)
    axes.set_ylim(state[1] - 0.75 * VIEW, state[1] + 0.75 * VIEW)
    axes.set_title(
        f"{int(moment.count) * task.plant.dt:.1f} s, {state[3]:.1f} m/s, "
        f"deviation {float(moment.lateral):+.2f} m"
    )
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
