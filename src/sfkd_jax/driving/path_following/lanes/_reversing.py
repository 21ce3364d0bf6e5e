"""Backing up before an obstacle that is too near to turn away from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from sfkd_jax.control import Stateful, all_finite
from sfkd_jax.driving.lanes import Lane, Obstacles, clearance, finite
from sfkd_jax.driving.path_following.lanes._in_lane import InLane, LaneState, Scene
from sfkd_jax.driving.paths import Lap, point_at
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.info import ControllerInfo, Reason
from sfkd_jax.ranges import Positive
from sfkd_jax.types import Control, Environment, Key, Params, Scalar, State

STILL = 0.3
"""Speed below which a car stands, as measured; of a car [m/s]."""
BACKWARDS = 1.0
"""Speed at which it backs up; of a car [m/s]."""
ROOM = 1.5
"""Way backwards that has to be free; of a car [m]. It stops in half of it."""
FARTHEST = 30.0
"""Longest way backwards; of a car [m]. It is twice what any lateral move needs."""
BEYOND = 1.0
"""Distance beyond a place at which the car backed up, from which on it may do so again;
of a car [m].
"""
RELAXES = 1.5
"""Length over which errors decay on the way back, in wheelbases."""


class ReversingState(NamedTuple):
    """What is carried from one control step to the next.

    Attributes:
        lane: state of the controller in the lane.
        first: its state before the first step, from which it starts anew at every step
            on the way back.
        waited: number of steps since the car stands before something.
        backing: whether it backs up.
        behind: how far the car is behind the place at which it began to back up, by its
            speed [m]; negative beyond that place, and before the first time.
        offset: from the centre line, kept on the way back [m].
    """

    lane: LaneState
    first: LaneState
    waited: Int[Array, ""]
    backing: Bool[Array, ""]
    behind: Scalar
    offset: Scalar


@dataclass(frozen=True, kw_only=True)
class Reversing(Stateful):
    """A controller in a lane that backs up where it cannot turn away.

    A car that has stood for some time before something drives backwards along its lane
    until there is a reference around it, or until something is behind the car.
    Backwards it is steered as a bicycle without slip,

        δ = atan(L κ) + L (2 ψ / ℓ − e / ℓ²),   ℓ = `RELAXES` L,

    under which the offset e and the heading ψ, both relative to the lane, decay like
    exp(−s / ℓ) with the way s. Nothing is certified about that, and no claim is made
    until the errors of the certified law have decayed as well.

    It is for vehicles that reverse where u_2 is below 0 at rest.

    Attributes:
        lane: the controller in the lane.
        wheelbase: L [m].
        low: lower limits of the controls.
        high: upper limits of the controls.
        speed_loop: whether u_2 is a speed command.
        patience: time that the car stands before it backs up [s].
    """

    lane: InLane
    wheelbase: Positive
    low: tuple[float, ...]
    high: tuple[float, ...]
    speed_loop: bool = False
    patience: Positive = 3.0

    def init(self, key: Key) -> ReversingState:
        """Return the state before the first control step."""
        first = self.lane.init(key)
        return ReversingState(
            lane=first,
            first=jax.tree.map(jnp.copy, first),
            waited=jnp.zeros((), jnp.int32),
            backing=jnp.asarray(False),
            behind=jnp.asarray(-FARTHEST * self.lane.manoeuvres.kind.scale.length),
            offset=jnp.zeros(()),
        )

    def act(
        self,
        params: Params,
        state: ReversingState,
        observation: State,
        env: Environment,
        scene: Scene,
    ) -> tuple[Control, ReversingState, ControllerInfo]:
        """Take one control step."""
        dt = self.lane.manoeuvres.dt
        length, unit = self.lane.manoeuvres.kind.scale
        # On the way back every step is the first one of the controller in the lane.
        anew = state.first._replace(
            planner=state.lane.planner, doubt=jnp.asarray(self.lane.trial)
        )
        before: LaneState = jax.tree.map(
            lambda new, old: jnp.where(state.backing, new, old), anew, state.lane
        )
        control, lane, info = self.lane.act(params, before, observation, env, scene)
        assert info.lane is not None
        known = all_finite(observation)
        speed = jnp.where(known, observation[3], 0.0)
        still = jnp.abs(speed) < STILL * unit
        waits = jnp.asarray(info.lane.waiting) & known
        stands = waits & still & ~state.backing
        waited = jnp.where(stands, state.waited + 1, 0)
        (road, obstacles), clean = finite(*scene)
        room = self._room(road, obstacles, lane.progress, observation) & clean
        behind = state.behind - speed * dt
        # Where it has backed up before, it waits: not to and fro for ever.
        further = behind < -BEYOND * length
        begins = (waited * dt >= self.patience) & room & further
        behind = jnp.where(begins, 0.0, behind)
        goes = waits & room & (behind < FARTHEST * length)
        # It stops before it goes forwards.
        backing = begins | (state.backing & known & (goes | ~still))
        offset = jnp.where(begins, info.lane.offset, state.offset)
        backwards = self._backwards(road, lane.progress, offset, observation, goes)
        info = info._replace(
            claim=info.claim.unless(backing, Reason.REVERSING),
            lane=info.lane._replace(reversing=backing),
        )
        after = ReversingState(
            lane=lane,
            first=state.first,
            waited=waited,
            backing=backing,
            behind=behind,
            offset=offset,
        )
        return jnp.where(backing, backwards, control), after, info

    def _room(
        self, road: Lane, obstacles: Obstacles, progress: Scalar, observation: State
    ) -> Bool[Array, ""]:
        """Return whether the way backwards is free, as far as `ROOM`."""
        kind = self.lane.manoeuvres.kind
        comfort = self.lane.manoeuvres.comfort
        way = ROOM * kind.scale.length
        direction = jnp.stack([jnp.cos(observation[2]), jnp.sin(observation[2])])
        steps = way / (BACKWARDS * kind.scale.speed) / self.lane.manoeuvres.dt

        def gap(share: float) -> Array:
            place = observation[:2] - share * way * direction
            return clearance(
                obstacles, place, share * steps, direction=direction, half=kind.half
            )

        # What is ahead of the car may be near.
        enough = jnp.minimum(gap(0.0), comfort)
        free = jnp.all(gap(0.5) >= enough) & jnp.all(gap(1.0) >= enough)
        # An open path has nothing before its start.
        open_path = not isinstance(road.path, Lap)
        return free & (progress > way + kind.half[0]) if open_path else free

    def _backwards(
        self,
        road: Lane,
        progress: Scalar,
        offset: Scalar,
        observation: State,
        goes: Bool[Array, ""],
    ) -> Control:
        """Return the control of a car on its way back, or of one that stops there.

        Args:
            road: the lane.
            progress: of the car along its path [m].
            offset: from the path, to keep [m].
            observation: finite.
            goes: whether the car goes on.
        """
        point = point_at(road.path, progress)
        heading = wrap_angle(observation[2] - point[2])
        x, y = observation[:2] - point[:2]
        aside = jnp.cos(point[2]) * y - jnp.sin(point[2]) * x - offset
        length = RELAXES * self.wheelbase
        correction = 2.0 * heading / length - aside / length**2
        steering = jnp.arctan(self.wheelbase * point[3]) + self.wheelbase * correction
        scale = self.lane.manoeuvres.kind.scale
        wanted = jnp.where(goes, -BACKWARDS * scale.speed, 0.0)
        drive = wanted
        if not self.speed_loop:
            # Within the time in which the vehicle drives its length at that speed.
            drive = (wanted - observation[3]) * scale.speed / scale.length
        low = jnp.asarray(self.low)
        return jnp.clip(jnp.stack([steering, drive]), low, jnp.asarray(self.high))
