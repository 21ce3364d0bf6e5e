"""The vehicles and scenarios as a gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np

from sfkd_jax.adapters._drawing import RoadView
from sfkd_jax.adapters._task import Moment, tracking_task
from sfkd_jax.scenarios import Scenario, point_at

NAME = "sfkd_jax/Vehicle-v0"
MODES = ("human", "rgb_array")


def register_gymnasium() -> None:
    """Make `gymnasium.make("sfkd_jax/Vehicle-v0", …)` build a `GymnasiumVehicle`."""
    # A second registration would warn.
    if NAME not in gymnasium.registry:
        gymnasium.register(id=NAME, entry_point="sfkd_jax.adapters:GymnasiumVehicle")


class GymnasiumVehicle(gymnasium.Env):
    """Path following as `gymnasium.Env`, with the settings of `tracking_task`.

    Observation, action and reward are those of `tracking_task`. An episode is
    terminated if the car leaves the lane and truncated at the end of the road. The same
    seed gives the same road, friction and wind; `reset` without a seed gives the next
    of the stream that the last seed began.

    Args:
        render_mode: "rgb_array" for images, "human" for a window, or None.
        settings: of `tracking_task`.

    Raises:
        ValueError: an unknown render mode, or as `tracking_task`.
    """

    metadata = {"render_modes": list(MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode not in (None, *MODES):
            raise ValueError(
                f"render_mode must be one of {', '.join(MODES)}, got {render_mode!r}"
            )
        task = self._task = tracking_task(**settings)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / task.plant.dt)}
        self.observation_space = gymnasium.spaces.Box(
            np.asarray(task.observation_low, dtype=np.float32),
            np.asarray(task.observation_high, dtype=np.float32),
            dtype=np.float32,
        )
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (task.action_size,), np.float32
        )
        self._now: tuple[Scenario, Moment] | None = None
        self._view: RoadView | None = None
        self._observe = jax.jit(task.observe)
        self._start = jax.jit(task.reset)
        self._advance = jax.jit(task.step)
        self._foot = jax.jit(
            lambda road, moment: point_at(road.path, moment.progress)[:2]
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode on a new road; there are no options."""
        super().reset(seed=seed, options=options)
        # gymnasium's generator decides, as its contract on seeds asks for.
        seed = int(self.np_random.integers(2**31))
        road, _ = self._now = self._start(jax.random.key(seed))
        if self.render_mode is not None:
            if self._view is None:
                human = self.render_mode == "human"
                task = self._task
                self._view = RoadView(dt=task.plant.dt, lane=task.lane, human=human)
            self._view.start(np.asarray(road.path.points))
            self._follow()
        return self._observation(), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulate one sampling period.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        road, moment = self._now
        action = np.asarray(action, dtype=np.float32)
        moment, outcome = self._advance(road, moment, action)
        self._now = road, moment
        if self.render_mode is not None:
            self._follow()
        info = {name: float(value) for name, value in outcome.measures.items()}
        return (
            self._observation(),
            float(outcome.reward),
            bool(outcome.left),
            bool(outcome.over),
            info,
        )

    def render(self) -> np.ndarray | None:  # pyright: ignore
        """Return the image of the last step, uint8, if the mode is "rgb_array".

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render is called without a render_mode; pass render_mode to make"
            )
            return None
        if self._view is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        # A window is drawn in `step`, as gymnasium asks for.
        if self.render_mode == "human":
            return None
        self._draw(self._view)
        return self._view.image()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def _observation(self) -> np.ndarray:
        """The observation within its bounds, from which rounding may take it."""
        assert self._now is not None
        space: Any = self.observation_space
        return np.clip(np.array(self._observe(*self._now)), space.low, space.high)

    def _follow(self) -> None:
        """Extend the driven line; a window is drawn at once, an image on demand."""
        assert self._now is not None
        assert self._view is not None
        self._view.follow(np.asarray(self._now[1].state))
        if self.render_mode == "human":
            self._draw(self._view)

    def _draw(self, view: RoadView) -> None:
        """Draw the car at its position."""
        assert self._now is not None
        road, moment = self._now
        state = np.asarray(moment.state)
        seconds = int(moment.count) * self._task.plant.dt
        title = (
            f"{seconds:.1f} s, {state[3]:.1f} m/s, "
            f"deviation {float(moment.lateral):+.2f} m"
        )
        view.draw(state, np.asarray(self._foot(road, moment)), title)
