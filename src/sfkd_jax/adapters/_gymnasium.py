"""The vehicles and scenarios as a gymnasium environment: numpy outside, compiled inside."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.adapters._task import Moment, Outcome, tracking_task
from sfkd_jax.scenarios import Scenario
from sfkd_jax.types import Control, Key

NAME = "sfkd_jax/Vehicle-v0"


def register_gymnasium() -> None:
    """Make `gymnasium.make("sfkd_jax/Vehicle-v0", …)` build a `GymnasiumVehicle`; a second call changes nothing."""
    if NAME not in gymnasium.registry:
        gymnasium.register(id=NAME, entry_point="sfkd_jax.adapters:GymnasiumVehicle")


class GymnasiumVehicle(gymnasium.Env):
    """Following a path, as `gymnasium.Env`; settings, observation, action and reward are those of `tracking_task`.

    Terminated where the car left the lane, truncated where the road ended. The same
    seed gives the same road, friction and wind; `reset` without a seed gives the next
    of the stream that the last seed began.

    Raises:
        ValueError: as `tracking_task`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, **settings: Any) -> None:
        task = tracking_task(**settings)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (task.observation_size,), np.float32
        )
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (task.action_size,), np.float32
        )
        self._now: tuple[Scenario, Moment] | None = None

        def start(key: Key) -> tuple[Scenario, Moment, Float[Array, " observation"]]:
            road, moment = task.reset(key)
            return road, moment, task.observe(road, moment)

        def advance(
            road: Scenario, moment: Moment, action: Control
        ) -> tuple[Moment, Outcome, Float[Array, " observation"]]:
            moment, outcome = task.step(road, moment, action)
            return moment, outcome, task.observe(road, moment)

        self._start, self._advance = jax.jit(start), jax.jit(advance)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The start of an episode on a new road; there are no options."""
        super().reset(seed=seed, options=options)
        road, moment, observation = self._start(
            jax.random.key(int(self.np_random.integers(2**31)))
        )
        self._now = road, moment
        return np.array(observation), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One sampling period.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        road, moment = self._now
        moment, outcome, observation = self._advance(
            road, moment, np.asarray(action, dtype=np.float32)
        )
        self._now = road, moment
        info = {name: float(value) for name, value in outcome.measures.items()}
        return (
            np.array(observation),
            float(outcome.reward),
            bool(outcome.left),
            bool(outcome.over),
            info,
        )
