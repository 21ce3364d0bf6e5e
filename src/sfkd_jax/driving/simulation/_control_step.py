"""One step of a closed loop: sensors, controller, actuators and plant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.lanes import Obstacles
from sfkd_jax.driving.path_coordinates import LATERAL, curvature_ahead, path_coordinates
from sfkd_jax.driving.paths import Path, project
from sfkd_jax.driving.plants import Late, LateState
from sfkd_jax.driving.scenarios import car_clearance
from sfkd_jax.info import ControllerInfo, reported
from sfkd_jax.types import (
    Control,
    Controller,
    Environment,
    Key,
    Params,
    Reference,
    Scalar,
    State,
    Step,
)


class LoopState(NamedTuple):
    """What is carried from one step of a closed loop to the next.

    Attributes:
        state: of the plant.
        progress: arc length of the path that the car has reached [m].
        memory: state of the controller.
        pending: observations and commands on their way.
    """

    state: State
    progress: Scalar
    memory: Any
    pending: LateState


class Surroundings(NamedTuple):
    """What is around the car in a step.

    Attributes:
        env: that the plant is in.
        observed_env: that the controller observes.
        path: along which progress is measured.
        speed: at which the car is expected to move along the path [m/s].
    """

    env: Environment
    observed_env: Environment
    path: Path
    speed: Scalar


class StepOutcome(NamedTuple):
    """What happened in a step.

    Attributes:
        state: after the step, of the observed entries.
        control: that was commanded.
        lateral: distance to the left of the path [m], or in a lane of the reference.
        progress: after the step [m].
        info: of the controller; in a lane with the true gap to the obstacles.
    """

    state: State
    control: Control
    lateral: Scalar
    progress: Scalar
    info: ControllerInfo


class ClosedLoop(NamedTuple):
    """A plant and its controller.

    Attributes:
        plant: the true step.
        controller: of the car.
        late: sensors and actuators.
        spread: standard deviation of the noise of every observed state.
        size: length and width of the car [m]; None where there are no obstacles.
    """

    plant: Step
    controller: Controller
    late: Late
    spread: Float[Array, " state"]
    size: tuple[float, float] | None = None

    def start(self, state: State, key: Key, *, hidden: int = 0) -> LoopState:
        """Return what the first step begins with.

        Args:
            state: observed entries of the first state, at the start of the path.
            key: of the controller, consumed.
            hidden: number of further entries of the plant's state, which begin at 0.
        """
        pending = self.late.init(jnp.append(state, 0.0))
        whole = jnp.pad(state, (0, hidden))
        return LoopState(whole, jnp.zeros(()), self.controller.init(key), pending)

    def step(
        self,
        params: Params,
        before: LoopState,
        around: Surroundings,
        ahead_of: Callable[[Scalar], Any],
        key: Key,
    ) -> tuple[LoopState, StepOutcome]:
        """Take one step.

        Args:
            params: of the controller's model.
            before: what the step begins with.
            around: environment and path.
            ahead_of: progress at which the car is observed [m] -> what the controller
                is shown: a reference, or lane and obstacles.
            key: of the noise of the sensors, consumed.
        """
        observed = self.spread.shape[0]
        shown = before.state[:observed]
        arrived, pending = self.late.observe(
            before.pending, jnp.append(shown, before.progress)
        )
        # Noise reaches the controller alone, and neither plant nor scores.
        noise = jax.random.normal(key, shown.shape)
        observation = arrived[:-1] + self.spread * noise
        ahead = ahead_of(arrived[-1])
        control, memory, info = self.controller.act(
            params, before.memory, observation, around.observed_env, ahead
        )
        info = reported(info)
        acting, pending = self.late.actuate(pending, control)
        state = self.plant(before.state, acting, around.env)
        # The guess moves on at the reference speed. Where the path crosses itself, the
        # foot point therefore stays on the right branch.
        guess = before.progress + around.speed * self.late.dt
        progress, lateral = project(around.path, state[:2], guess)
        if self.size is not None:
            _, obstacles = ahead
            info, lateral = self._in_lane(info, obstacles, state, lateral, self.size)
        after = LoopState(state, progress, memory, pending)
        return after, StepOutcome(state[:observed], control, lateral, progress, info)

    def _in_lane(
        self,
        info: ControllerInfo,
        obstacles: Obstacles,
        state: State,
        lateral: Scalar,
        size: tuple[float, float],
    ) -> tuple[ControllerInfo, Scalar]:
        """Return the info with the true gap, and e_y beside the reference [m].

        Args:
            info: of the controller.
            obstacles: that the controller was shown.
            state: after the step.
            lateral: e_y of a controller that has no reference of its own [m].
            size: length and width of the car [m].
        """
        info = info._replace(gap=car_clearance(obstacles, state, size=size))
        if info.lane is None:
            return info, lateral
        # The first point is where the car should be now, if nothing is late.
        return info, _beside(info.lane.reference[self.late.observed_ago :], state)


def _beside(reference: Reference, state: State) -> Scalar:
    """Return e_y of a state beside the first point of a reference [m]."""
    curvature = curvature_ahead(reference)[0]
    return path_coordinates(state, reference[0], curvature)[LATERAL]
