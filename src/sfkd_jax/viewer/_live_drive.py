"""A drive on a closed road, one control step at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.driving.certificate import Conditions
from sfkd_jax.driving.lanes import Lane, Obstacles, circles, lane_along
from sfkd_jax.driving.paths import Path, path_through, point_at
from sfkd_jax.driving.plants import late_loop
from sfkd_jax.driving.scenarios import beside
from sfkd_jax.driving.simulation import (
    ClosedLoop,
    LoopState,
    StepOutcome,
    Surroundings,
)
from sfkd_jax.info import Reason
from sfkd_jax.policy import Policy
from sfkd_jax.report.frames import TRAIL
from sfkd_jax.report.lane_scene import LaneScene, scene_of
from sfkd_jax.types import Environment, Key, Scalar

WIDTH = 10.5
"""Width of the lane [m]."""
RADIUS = 0.8
"""Of an obstacle [m]."""
SPEED = 10.0
"""Wanted speed at the start [m/s]."""
ROAD_RADIUS = 110.0
"""Mean distance of the road from its middle [m]."""
BENDS = ((2, 0.12), (3, 0.05))
"""How often the distance of the road from its middle rises on the way around it, and by
which share of the mean.
"""
SMOOTHED = 0.01
"""Root mean square distance by which the road is smoothed [m]."""
ASIDE = (1.2, -1.4, 0.6, -0.8, 1.5, -0.4)
"""How far left of the middle of the road the obstacles stand at the start [m]."""
CANDIDATES = 24
"""References that are drawn to be shown."""


class UserInput(NamedTuple):
    """What the user sets in the browser.

    Attributes:
        obstacles: where the obstacles are [m], (obstacle, 2).
        env: that the car is in, and observes, (environment,).
        speed: wanted [m/s].
    """

    obstacles: Float[np.ndarray, "obstacle 2"]
    env: Float[np.ndarray, " environment"]
    speed: float


class LiveState(NamedTuple):
    """What is carried from one control step to the next.

    Attributes:
        loop: car and controller.
        key: of the noise of the sensors.
        followed: points of the reference that were followed last, x, y, yaw, v.
        time: since the start [s].
        largest: largest distance from the reference since the start [m].
        nearest: smallest distance from an obstacle since the start [m].
    """

    loop: LoopState
    key: Key
    followed: Float[np.ndarray, "past 4"]
    time: float = 0.0
    largest: float = 0.0
    nearest: float = np.inf


class Moment(NamedTuple):
    """What is shown after a control step.

    Attributes:
        scene: what is to be seen.
        pose: of the car: x, y, yaw.
        centre: of the road beside the car: x, y, yaw.
        speed: of the car [m/s].
        deviation: distance to the left of the reference [m].
        bound: claimed for it [m]; NaN where none is.
        reason: why there is a bound, or none.
        braking: whether the committed reference ends at rest.
        gap: true distance from the nearest obstacle [m].
        candidates: lines of references that the planner considers, (candidate, 2,
            point).
        admissible: which of them it could commit to, (candidate,).
    """

    scene: LaneScene
    pose: Float[np.ndarray, " 3"]
    centre: Float[np.ndarray, " 3"]
    speed: float
    deviation: float
    bound: float
    reason: Reason
    braking: bool
    gap: float
    candidates: Float[np.ndarray, "candidate 2 point"]
    admissible: Any


@dataclass(frozen=True)
class LiveDrive:
    """A car with a policy on a closed road; see `live_drive`.

    Attributes:
        policy: that drives.
        lane: the road.
        loop: car and controller.
        advance: (loop state, key, env, speed, obstacles) -> what follows from a step,
            compiled.
    """

    policy: Policy
    lane: Lane
    loop: ClosedLoop
    advance: Callable[..., tuple[LoopState, Key, StepOutcome, Array]]

    @property
    def dt(self) -> float:
        """Sampling period [s]."""
        return self.policy.vehicle.dt

    @property
    def env_box(self) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Names of the entries of e, and the lowest and the highest values."""
        stated = self.policy.interface["environment"]
        return stated["names"], np.asarray(stated["low"]), np.asarray(stated["high"])

    @property
    def speeds(self) -> tuple[float, float]:
        """The lowest and the highest speed of the references of the policy [m/s]."""
        return _conditions(self.policy).speed

    @property
    def first_input(self) -> UserInput:
        """Obstacles along the road, the middle of the box of e, and the usual speed."""
        count = len(ASIDE)
        # The first one is half of the distance of two ahead of the start.
        along = self.lane.path.length * (jnp.arange(count) + 0.5) / count
        _, low, high = self.env_box
        return UserInput(
            obstacles=np.asarray(beside(self.lane.path, along, jnp.asarray(ASIDE))),
            env=0.5 * (low + high),
            speed=SPEED,
        )

    def start(self, key: Key) -> LiveState:
        """Return a car in the middle of the road, at the usual speed."""
        planner_key, sensor_key = jax.random.split(key)
        size = len(self.policy.vehicle.state_names)
        first = self.lane.path.points[0]
        state = jnp.zeros(size).at[:3].set(first[:3]).at[3].set(SPEED)
        return LiveState(
            loop=self.loop.start(state, planner_key),
            key=sensor_key,
            followed=np.zeros((0, 4)),
        )

    def step(
        self, before: LiveState, user_input: UserInput
    ) -> tuple[LiveState, Moment]:
        """Take one control step with what the user has set."""
        obstacles = circles(jnp.asarray(user_input.obstacles), RADIUS)
        loop, key, outcome, centre = self.advance(
            before.loop,
            before.key,
            jnp.asarray(user_input.env, dtype=float),
            jnp.asarray(user_input.speed, dtype=float),
            obstacles,
        )
        outcome = jax.device_get(outcome)
        info = outcome.info
        line = np.concatenate([before.followed, info.lane.reference])
        state = np.asarray(outcome.state)
        half = self.policy.vehicle.size.half
        after = LiveState(
            loop=loop,
            key=key,
            followed=line[: len(before.followed) + 1][-TRAIL:],
            time=before.time + self.dt,
            largest=max(before.largest, abs(float(outcome.lateral))),
            nearest=min(before.nearest, float(info.gap)),
        )
        return after, Moment(
            scene=scene_of(state, line, float(info.claim.bound), obstacles, half=half),
            pose=state[:3],
            centre=np.asarray(centre)[:3],
            speed=float(state[3]),
            deviation=float(outcome.lateral),
            bound=float(info.claim.bound),
            reason=Reason(int(info.claim.reason)),
            braking=bool(info.lane.stopping),
            gap=float(info.gap),
            candidates=info.lane.candidates.position,
            admissible=info.lane.candidates.admissible,
        )


def live_drive(policy: Policy) -> LiveDrive:
    """Return a drive with a policy on a closed road with obstacles.

    Raises:
        ValueError: the policy has no certified corridor.
    """
    plant = policy.vehicle
    controller = policy.in_lane(candidates=CANDIDATES)
    states = len(plant.state_names)
    loop = ClosedLoop(
        plant=plant.step,
        controller=controller,
        late=late_loop(policy.latency, states=states, dt=plant.dt),
        spread=jnp.asarray(_conditions(policy).sensor_noise),
        size=plant.size,
    )
    lane = lane_along(_closed_road(), width=WIDTH, speed=SPEED)

    @jax.jit
    def advance(
        before: LoopState,
        key: Key,
        env: Environment,
        speed: Scalar,
        obstacles: Obstacles,
    ) -> tuple[LoopState, Key, StepOutcome, Array]:
        sensor_key, next_key = jax.random.split(key)
        road = lane._replace(speed=jnp.full_like(lane.speed, speed))
        around = Surroundings(env, env, lane.path, speed)
        after, outcome = loop.step(
            policy.params, before, around, lambda _: (road, obstacles), sensor_key
        )
        return after, next_key, outcome, point_at(lane.path, after.progress)

    return LiveDrive(policy, lane, loop, advance)


def _conditions(policy: Policy) -> Conditions:
    """Return the conditions of the corridor of a policy that drives in a lane."""
    assert policy.certificate is not None
    assert policy.certificate.corridor is not None
    return policy.certificate.corridor.conditions


def _closed_road() -> Path:
    """Return the middle of a road without an end, with bends to both sides."""
    angle = np.linspace(0.0, 2.0 * np.pi, 1500)
    radius = np.full_like(angle, ROAD_RADIUS)
    for count, share in BENDS:
        radius += ROAD_RADIUS * share * np.cos(count * angle)
    points = radius * np.stack([np.cos(angle), np.sin(angle)])
    # The positions are exact but for single precision, which would shake the curvature.
    return path_through(jnp.asarray(points.T), closed=True, tolerance=SMOOTHED)
