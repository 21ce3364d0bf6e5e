"""Driving in a lane: a reference is chosen, committed, and followed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from sfkd_jax.control._factory import factory
from sfkd_jax.control.lanes._manoeuvre import Judged, Manoeuvres, Situation
from sfkd_jax.control.lanes._reference import (
    BEHIND,
    Committed,
    RoadAhead,
    road_ahead,
    speed_profile,
    window,
)
from sfkd_jax.control.planners._planner import all_finite
from sfkd_jax.lanes import Lane, Obstacles
from sfkd_jax.paths import Lap, point_at, project
from sfkd_jax.ranges import (
    AtLeastOne,
    Fraction,
    NonNegative,
    NonNegativeInt,
    Positive,
    check_intervals,
)
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Params,
    Scalar,
    State,
)

Scene: TypeAlias = tuple[Lane, Obstacles]
"""The lane and what is seen in it."""
GRAVITY = 9.81
LOST = 10.0
"""Distance from where the car should be, at which it is somewhere else [m]."""


class LaneState(NamedTuple):
    """What is carried from one control step to the next.

    Attributes:
        inner: state of the controller that follows the reference.
        planner: state of the search.
        committed: the reference.
        progress: of the car along the path of the lane [m].
        wait: number of steps until the next search.
        started: whether there is a reference.
    """

    inner: Any
    planner: Any
    committed: Committed
    progress: Scalar
    wait: Int[Array, ""]
    started: Bool[Array, ""]


@dataclass(frozen=True, kw_only=True)
class InLane:
    """A controller that drives in a lane, round obstacles, or stops before them.

    The planner compares references with the one that is committed; the cheapest that is
    admissible is committed. If none is, the committed one stays as long as it is free,
    else the car brakes on it, to stand in front of what is in the way. A scene with
    numbers that are not finite also makes it stop.

    `act` takes a scene, lane and obstacles, in place of the reference. `info` gains
    `reference` (the window that `inner` follows), `offset` of the reference from the
    centre line [m], `clearance` (along the whole committed reference the car stays as
    far from all obstacles [m]; NaN where no corridor holds), `admissible` (the
    committed reference is inside the class, the lane, and free) and `stopping`.

    Attributes:
        inner: in the world; its `info` has the `corridor` of the reference.
        planner: of `Manoeuvres.task`, with horizon 1.
        manoeuvres: what is planned.
        dt: sampling period [s].
        horizon: number of points of the reference that `inner` reads.
        samples: of the road that are planned, at the spacing of the path.
        period: number of steps from one search to the next.
        friction: entry of e that is the friction; None if none is.
        lowest: friction where e is not known.
        share: of the grip that a plan may use.
        better: relative gain of a reference that replaces the committed one.
    """

    inner: Controller
    planner: Controller
    manoeuvres: Manoeuvres
    dt: Positive
    horizon: AtLeastOne
    samples: AtLeastOne = 200
    period: AtLeastOne = 3
    friction: NonNegativeInt | None = 0
    lowest: Positive = 0.3
    share: Fraction = 0.7
    better: NonNegative = 0.01

    def __post_init__(self) -> None:
        check_intervals(self)

    def controller(self) -> Controller:
        """Return the controller of scenes."""
        return Controller(self.init, self.act)

    def init(self, key: Key) -> LaneState:
        """Return the state before the first control step."""
        inner, planner = jax.random.split(key)
        committed = Committed(
            index=jnp.zeros((), jnp.int32),
            move=jnp.zeros((3, self.samples)),
            square=jnp.zeros(self.samples),
        )
        return LaneState(
            inner=self.inner.init(inner),
            planner=self.planner.init(planner),
            committed=committed,
            progress=jnp.zeros(()),
            wait=jnp.zeros((), jnp.int32),
            started=jnp.asarray(False),
        )

    def act(
        self,
        params: Params,
        state: LaneState,
        observation: State,
        env: Environment,
        scene: Scene,
    ) -> tuple[Control, LaneState, ControllerInfo]:
        """Take one control step."""
        task, weights = self.manoeuvres, state.planner.tuning.cost
        (lane, obstacles), clean = _finite(*scene)
        state, road = self._located(state, observation, lane)
        situation = self._situation(state, road, obstacles, env)
        kept = task.judge(weights, situation, state.committed)
        free = ~jnp.any(kept.blocked) & clean
        # What was committed is judged at every step: what appears is seen at once.
        due = (state.wait <= 0) | ~free
        planner, committed = jax.lax.cond(
            due,
            lambda: self._search(state.planner, situation, kept, clean),
            lambda: (state.planner, state.committed),
        )
        judged = task.judge(weights, situation, committed)
        place = state.progress / lane.path.spacing - committed.index
        ahead = window(
            lane.path,
            committed,
            judged.curve,
            place,
            dt=self.dt,
            horizon=self.horizon,
        )
        control, inner, info = self.inner.act(
            params, state.inner, observation, env, ahead
        )
        # What was needed is the corridor of the certificate; here is that of the step.
        room = jnp.min(judged.gap) + task.kind.corridor
        room = room - info.get("corridor", jnp.nan)
        report: Any = {
            **info,
            "healthy": info["healthy"] & clean,
            "reference": ahead,
            "offset": jnp.interp(place, jnp.arange(self.samples), committed.move[0]),
            "clearance": jnp.where(clean, room, jnp.nan),
            "admissible": (judged.violation <= 0.0) & clean,
            "stopping": ~judged.curve.reached[-1],
        }
        wait = jnp.where(due, self.period, state.wait) - 1
        after = state._replace(
            inner=inner, planner=planner, committed=committed, wait=wait
        )
        return control, after, report

    def _located(
        self, state: LaneState, observation: State, lane: Lane
    ) -> tuple[LaneState, RoadAhead]:
        """Where the car is, and the road and the committed reference from there on."""
        path, position = lane.path, observation[:2]
        known = all_finite(observation[:4])
        guess = state.progress + self.dt * jnp.sqrt(state.committed.square[BEHIND])
        away = jnp.linalg.norm(position - point_at(path, guess)[:2])
        # A road may cross itself: the nearest point counts if the car is nowhere else.
        fresh = known & ~(state.started & (away < LOST))
        nearest = jnp.argmin(jnp.sum((path.points[:, :2] - position) ** 2, axis=1))
        start = jnp.where(fresh, nearest * path.spacing, guess)
        progress, lateral = project(path, position, start)
        index, count = state.committed.index, path.points.shape[0] - 1
        if isinstance(path, Lap):
            # Over the start of the lap all goes on; after it, one lap less is counted.
            progress = (
                progress + jnp.round((start - progress) / path.length) * path.length
            )
            laps = jnp.floor(progress / path.length)
            progress = progress - laps * path.length
            index = index - laps.astype(int) * count
        progress = jnp.where(known, progress, start)
        first = jnp.floor(progress / path.spacing).astype(int) - BEHIND
        first = jnp.where(fresh, first, jnp.maximum(first, index))
        kind = self.manoeuvres.kind
        most = kind.acceleration, kind.deceleration
        road = road_ahead(lane, first, self.samples, most)
        # It begins where the car is, at its speed.
        move = jnp.zeros_like(state.committed.move).at[0].set(lateral)
        square = speed_profile(
            road.wanted, jnp.maximum(observation[3], 0.0) ** 2, path.spacing, *most
        )
        begun = Committed(first, move, square)
        held = state.committed._replace(index=index).at(first, road.wanted)
        committed = jax.tree.map(partial(jnp.where, fresh), begun, held)
        return state._replace(
            committed=committed, progress=progress, started=state.started | known
        ), road

    def _situation(
        self,
        state: LaneState,
        road: RoadAhead,
        obstacles: Obstacles,
        env: Environment,
    ) -> Situation:
        """What references are judged by in this step."""
        friction = jnp.asarray(jnp.nan) if self.friction is None else env[self.friction]
        grip = (
            self.share
            * GRAVITY
            * jnp.where(jnp.isfinite(friction), friction, self.lowest)
        )
        place = state.progress / road.spacing - state.committed.index
        return Situation(road, state.committed, obstacles, place, grip)

    def _search(
        self,
        planner: Any,
        situation: Situation,
        kept: Judged,
        clean: Bool[Array, ""],
    ) -> tuple[Any, Committed]:
        """Return the state of the planner and the reference to commit."""
        task, before = self.manoeuvres, situation.committed
        # Its observation is a situation; it needs neither e nor a reference.
        act: Any = self.planner.act
        row, after, info = act(None, planner, situation, None, None)
        found = task.reference(situation, row)
        better = info["mean_cost"] < (1.0 - self.better) * kept.cost
        better |= kept.violation > 0.0
        # A plan that continues an old one is not the one that was evaluated.
        taken = better & info["healthy"] & info["constraints_kept"] & clean
        stop = task.stop(situation, kept, clean)
        stays = ~jnp.any(kept.blocked) & clean
        otherwise = jax.tree.map(partial(jnp.where, stays), before, stop)
        return after, jax.tree.map(partial(jnp.where, taken), found, otherwise)


def _finite(lane: Lane, obstacles: Obstacles) -> tuple[Scene, Bool[Array, ""]]:
    """Return a scene without NaN and infinity, and whether there was none.

    Padding may hold anything.
    """
    points, (count, *_) = lane.path.points.shape[0], obstacles.position.shape
    sizes = [one.shape for one in (lane.left, lane.right, lane.speed)]
    if sizes != [(points,)] * 3:
        raise ValueError(
            f"left, right and speed of a lane must have shape ({points},), that of its "
            f"path; got {sizes}"
        )
    sizes = [leaf.shape[:1] for leaf in obstacles]
    if sizes != [(count,)] * len(obstacles) or obstacles.position.ndim != 3:
        raise ValueError(
            "obstacles must have position (obstacle, step, 2), yaw, half (obstacle, "
            f"2), radius and present; got {[leaf.shape for leaf in obstacles]}"
        )

    def shown(leaf: Array) -> Array:
        present = obstacles.present.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(present, leaf, 0)

    obstacles = Obstacles(*map(shown, obstacles))
    clean = all_finite((lane, obstacles))
    lane, obstacles = jax.tree.map(
        lambda leaf: jnp.nan_to_num(leaf, posinf=0.0, neginf=0.0), (lane, obstacles)
    )
    return (lane, obstacles), clean


in_lane = factory(InLane, InLane.controller)
"""(settings of `InLane`) -> `Controller` of scenes."""
