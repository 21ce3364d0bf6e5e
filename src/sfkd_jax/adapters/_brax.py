"""The vehicles and scenarios as a brax environment."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax import envs
from brax.envs.base import Env, State

from sfkd_jax.adapters._task import MEASURES, DrivingTask, tracking_task
from sfkd_jax.types import Control, Environment, Reference
from sfkd_jax.types import State as VehicleState

NAME = "sfkd_vehicle"


def register_brax(name: str = NAME) -> None:
    """Register `BraxVehicle` under a name that `brax.envs.create` knows."""
    envs.register_environment(name, BraxVehicle)


class BraxVehicle(Env):
    """Path following as `brax.envs.Env`, with the settings of `tracking_task`.

    Observation, action and reward are those of `tracking_task`. Every `reset` draws a
    new road and puts it into `info["road"]`; the automatic reset of brax, which
    restores the first state of an episode, therefore repeats the road. `done` is 1 if
    the car left the lane or the road ended; `info["time_out"]` is 1 in the second case
    only, as PPO's `bootstrap_on_timeout` expects.

    Raises:
        ValueError: as `tracking_task`.
    """

    def __init__(self, **settings: Any) -> None:
        self._task = tracking_task(**settings)

    def reset(self, rng: jax.Array) -> State:
        """Start an episode on a new road; `rng` is a typed key or two integers."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        road, moment = self._task.reset(rng if typed else jax.random.wrap_key_data(rng))
        zero = jnp.zeros(())
        metrics = dict.fromkeys(MEASURES, zero)
        info = {"road": road, "time_out": zero}
        observation = self._task.observe(road, moment)
        return State(moment, observation, zero, zero, metrics, info)  # pyright: ignore

    def step(self, state: State, action: jax.Array) -> State:
        """Simulate one sampling period; keep other entries of `metrics` and `info`."""
        road = state.info["road"]
        moment, outcome = self._task.step(road, state.pipeline_state, action)  # pyright: ignore
        done, time_out = (
            (outcome.left | outcome.over).astype(float),
            outcome.over.astype(float),
        )
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=moment,
            obs=self._task.observe(road, moment),
            reward=outcome.reward,
            done=done,
            metrics={**state.metrics, **outcome.measures},
            info={**state.info, "time_out": time_out},
        )

    def situation(self, state: State) -> tuple[VehicleState, Environment, Reference]:
        """Return state, environment and reference, as `Controller.act` takes them."""
        return self._task.situation(state.info["road"], state.pipeline_state)  # pyright: ignore

    def action(self, control: Control) -> Control:
        """Return the action of a control in physical units."""
        return self._task.action(control)

    @property
    def task(self) -> DrivingTask:
        """The pure functions behind the environment."""
        return self._task

    @property
    def dt(self) -> float:
        """Sampling period [s]."""
        return self._task.plant.dt

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._task.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self._task.action_size

    @property
    def backend(self) -> str:
        """Name of the physics, which is not brax's."""
        return "sfkd_jax"
