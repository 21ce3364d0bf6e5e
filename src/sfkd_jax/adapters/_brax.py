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
    """Make `brax.envs.get_environment(name, …)` and `brax.envs.create(name, …)` build a `BraxVehicle`."""
    envs.register_environment(name, BraxVehicle)


class BraxVehicle(Env):
    """Following a path, as `brax.envs.Env`; settings, observation, action and reward are those of `tracking_task`.

    A new road comes with every `reset`. It lies in `info["road"]`, so that the
    automatic reset of brax, which goes back to the state an episode began with, drives
    the same road once more. `done` is 1 where the car left the lane or the road ended;
    `info["time_out"]` is 1 for the latter only, as PPO's `bootstrap_on_timeout`
    expects.

    Raises:
        ValueError: as `tracking_task`.
    """

    def __init__(self, **settings: Any) -> None:
        self._task = tracking_task(**settings)

    def reset(self, rng: jax.Array) -> State:
        """The start of an episode on a new road; `rng` may be a typed key or, as brax has it, two integers."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        road, moment = self._task.reset(rng if typed else jax.random.wrap_key_data(rng))
        zero = jnp.zeros(())
        metrics = dict.fromkeys(MEASURES, zero)
        info = {"road": road, "time_out": zero}
        return State(
            moment, self._task.observe(road, moment), zero, zero, metrics, info
        )  # pyright: ignore

    def step(self, state: State, action: jax.Array) -> State:
        """One sampling period; entries that wrappers put into `metrics` and `info` are kept."""
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
        """State, environment and reference in the world's frame: what `Controller.act` takes."""
        return self._task.situation(state.info["road"], state.pipeline_state)  # pyright: ignore

    def action(self, control: Control) -> Control:
        """The action that a control in physical units is."""
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
        """Whose physics: not brax's."""
        return "sfkd_jax"
