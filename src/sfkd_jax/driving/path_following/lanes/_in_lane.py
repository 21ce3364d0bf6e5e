"""Driving in a lane: a reference is chosen, committed, and followed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from sfkd_jax.control import Stateful, all_finite, factory
from sfkd_jax.driving.lanes import Lane, Obstacles, finite
from sfkd_jax.driving.path_following.lanes._followers import counts_from
from sfkd_jax.driving.path_following.lanes._judging import Judged, Situation
from sfkd_jax.driving.path_following.lanes._manoeuvre import Manoeuvres
from sfkd_jax.driving.path_following.lanes._reference import (
    BEHIND,
    SPLICE,
    Committed,
    RoadAhead,
    road_ahead,
    sampling,
    speed_profile,
    window,
)
from sfkd_jax.driving.paths import SPACING, Lap, Path, point_at, project
from sfkd_jax.info import Candidates, ControllerInfo, LaneInfo, Reason
from sfkd_jax.ranges import (
    AtLeastOne,
    NonNegative,
    NonNegativeInt,
    Positive,
    check_intervals,
)
from sfkd_jax.types import (
    GRAVITY,
    Control,
    Controller,
    Environment,
    Key,
    Params,
    Reference,
    Scalar,
    State,
)

Scene: TypeAlias = tuple[Lane, Obstacles]
"""The lane and what is seen in it."""
LOST = 10.0
"""Distance from the expected place beyond which it is somewhere else; of a car [m]."""


class LaneState(NamedTuple):
    """What is carried from one control step to the next.

    Attributes:
        inner: state of the controller that follows the reference.
        planner: state of the search.
        committed: the reference.
        progress: of the car along the path of the lane [m].
        wait: number of steps until the next search.
        started: whether there is a reference.
        doubt: number of steps until a corridor may be claimed; an evasion sets it to
            `InLane.trial`.
    """

    inner: Any
    planner: Any
    committed: Committed
    progress: Scalar
    wait: Int[Array, ""]
    started: Bool[Array, ""]
    doubt: Int[Array, ""]


def moved_on(
    state: LaneState, path: Path, points: Int[Array, ""], spacing: float = SPACING
) -> LaneState:
    """Return the state along a window of a road that has moved on.

    Args:
        state: along the window before.
        path: of the window.
        points: of the path, by which it has moved on. Where several lie between two
            samples of the road, it is a multiple of their number.
        spacing: that of `InLane`.
    """
    moved = path.spacing * points
    distance, _ = sampling(path, spacing)
    index = state.committed.index - jnp.round(moved / distance).astype(int)
    return state._replace(
        progress=state.progress - moved,
        committed=state.committed._replace(index=index),
    )


@dataclass(frozen=True, kw_only=True)
class InLane(Stateful):
    """A controller that drives in a lane, round obstacles, or stops before them.

    The planner compares references with the committed one, and the cheapest admissible
    reference is committed. If none is admissible, the committed reference stays as long
    as it is free. Otherwise the car brakes on it, to stand in front of what is in the
    way. If it would not stand in time, it evades with all of the grip, outside the
    class and without a claim: the bound and `clearance` are then NaN. If a number of
    the scene is not finite, or the lane is too narrow for the car and its corridor, the
    car stops.

    Who follows in the track of the car is no obstacle. Others go on with their last
    predicted velocity.

    `act` takes a scene (lane and obstacles) in place of the reference. `info` gains
    `lane`, see `LaneInfo`.

    Attributes:
        inner: controller in the world; its `info` has the claim about the reference.
        planner: of `Manoeuvres.task`, with horizon 1.
        manoeuvres: the references to choose from.
        horizon: number of points of the reference that `inner` reads.
        view: length of the road that is planned [m].
        spacing: of its samples [m].
        period: number of steps from one search to the next.
        friction: entry of e that is the friction; None if none is.
        lowest: friction that is assumed where e is not known.
        lead: time by which the speed of the reference is ahead of its position [s],
            because a law follows a falling speed that much later.
        better: relative gain at which a reference replaces the committed one.
        trial: number of steps without a claim after an evasion.
        candidates: number of references that are drawn as the search draws them, to be
            shown in `info.lane.candidates` beside the ways round; 0 for none.
    """

    inner: Controller
    planner: Controller
    manoeuvres: Manoeuvres
    horizon: AtLeastOne
    view: Positive = 100.0
    spacing: Positive = SPACING
    period: AtLeastOne = 3
    friction: NonNegativeInt | None = 0
    lowest: Positive = 0.3
    lead: NonNegative = 0.0
    better: NonNegative = 0.01
    trial: AtLeastOne = 20
    candidates: NonNegativeInt = 0

    def __post_init__(self) -> None:
        check_intervals(self)

    @property
    def samples(self) -> int:
        """Number of samples of the road that are planned."""
        return max(round(self.view / self.spacing), 2 * SPLICE)

    def init(self, key: Key) -> LaneState:
        """Return the state before the first control step."""
        inner_key, planner_key = jax.random.split(key)
        return LaneState(
            inner=self.inner.init(inner_key),
            planner=self.planner.init(planner_key),
            # On the centre line, at rest.
            committed=Committed(
                index=jnp.zeros((), jnp.int32),
                move=jnp.zeros((3, self.samples)),
                square=jnp.zeros(self.samples),
            ),
            progress=jnp.zeros(()),
            wait=jnp.zeros((), jnp.int32),
            started=jnp.asarray(False),
            doubt=jnp.zeros((), jnp.int32),
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
        task = self.manoeuvres
        weights = state.planner.tuning.cost
        scene, clean = finite(*scene)
        progress, situation = self._situation(state, observation, env, scene, clean)
        kept = task.judge(weights, situation, situation.committed)
        free = ~jnp.any(kept.blocked)
        # The committed reference is judged at every step, so an obstacle that appears
        # is noticed at once.
        due = (state.wait <= 0) | ~free

        def search() -> tuple[Any, Committed, Bool[Array, ""]]:
            return self._search(state.planner, situation, kept, free)

        def keep() -> tuple[Any, Committed, Bool[Array, ""]]:
            return state.planner, situation.committed, jnp.asarray(False)

        planner, committed, taken = jax.lax.cond(due, search, keep)
        judged = task.judge(weights, situation, committed)
        # An admissible reference stays admissible. A last resort need not be, until the
        # car stands.
        resorted = (~free | (state.doubt == self.trial)) & ~taken
        evading = resorted & (judged.outside > 0.0)
        doubt = jnp.where(evading, self.trial, jnp.maximum(state.doubt - 1, 0))
        ahead = self._window(scene[0].path, situation, committed, judged)
        control, inner, info = self.inner.act(
            params, state.inner, observation, env, ahead
        )
        # Outside the class, and until its errors have decayed, nothing is certified.
        claim = info.claim.unless(doubt > 0, Reason.EVADING)
        # The gap is beyond the corridor of the certificate; this step has its own.
        excess = claim.bound - task.kind.corridor
        room = jnp.min(judged.gap) - excess
        info = info._replace(
            plan=info.plan._replace(healthy=info.plan.healthy & clean),
            claim=claim,
            lane=LaneInfo(
                reference=ahead,
                offset=committed.move[0, BEHIND],
                clearance=jnp.where(clean, room, jnp.nan),
                edge=jnp.where(clean, jnp.min(judged.edge), jnp.nan),
                admissible=judged.violation <= 0.0,
                stopping=~judged.curve.reached[-1],
                evading=evading,
                waiting=jnp.any(~judged.curve.reached & (situation.road.wanted > 0.0)),
                reversing=jnp.asarray(False),
                candidates=self._shown(situation, state.planner),
            ),
        )
        wait = jnp.where(due, self.period, state.wait) - 1
        started = state.started | all_finite(observation)
        after = LaneState(inner, planner, committed, progress, wait, started, doubt)
        return control, after, info

    def _shown(self, situation: Situation, planner: Any) -> Candidates | None:
        """Return candidates of a search, from its state before; None for none."""
        if not self.candidates:
            return None
        return self.manoeuvres.candidates(situation, planner, self.candidates)

    def _window(
        self, path: Path, situation: Situation, committed: Committed, judged: Judged
    ) -> Reference:
        """Return the window of the committed reference that `inner` follows."""
        times = self.manoeuvres.dt * jnp.arange(1, self.horizon + 1)
        spacing = situation.road.spacing
        place = situation.place
        at = partial(window, path, spacing, committed, judged.curve, place)
        return at(times).at[:, 3].set(at(times + self.lead)[:, 3])

    def _grip(self, env: Environment) -> Scalar:
        """Return the acceleration that the tyres allow [m/s²]."""
        friction = jnp.asarray(jnp.nan) if self.friction is None else env[self.friction]
        return GRAVITY * jnp.where(jnp.isfinite(friction), friction, self.lowest)

    def _new(
        self, road: RoadAhead, first: Int[Array, ""], lateral: Scalar, speed: Scalar
    ) -> Committed:
        """Return a reference that begins where the car is, at its speed.

        Args:
            road: ahead of the car.
            first: index of its first sample.
            lateral: how far left of the path the car is [m].
            speed: of the car [m/s].
        """
        limits = self.manoeuvres.kind
        square = speed_profile(
            road.wanted,
            jnp.maximum(speed, 0.0) ** 2,
            road.spacing,
            limits.acceleration,
            limits.deceleration,
        )
        move = jnp.zeros((3, self.samples)).at[0].set(lateral)
        return Committed(first, move, square)

    def _situation(
        self,
        state: LaneState,
        observation: State,
        env: Environment,
        scene: Scene,
        clean: Bool[Array, ""],
    ) -> tuple[Scalar, Situation]:
        """Return where the car is along the path [m], and its situation.

        The situation is what references are judged by.
        """
        lane, obstacles = scene
        limits = self.manoeuvres.kind
        path = lane.path
        position = observation[:2]
        index = state.committed.index
        square = state.committed.square
        distance, gaps = sampling(path, self.spacing)
        known = all_finite(observation)
        guess = state.progress + self.manoeuvres.dt * jnp.sqrt(square[BEHIND])
        away = jnp.linalg.norm(position - point_at(path, guess)[:2])
        # A road may cross itself. The nearest point of all counts only if the car is
        # not near the expected one.
        near = away < LOST * limits.scale.length
        fresh = known & ~(state.started & near)
        nearest = jnp.argmin(jnp.sum((path.points[:, :2] - position) ** 2, axis=1))
        start = jnp.where(fresh, nearest * path.spacing, guess)
        progress, lateral = project(path, position, start)
        progress = jnp.where(known, progress, start)
        if isinstance(path, Lap):
            # Where a lap starts again, so do the projection and the samples.
            behind = progress < start - 0.5 * path.length
            index = index - jnp.where(behind, gaps, 0)
        first = jnp.floor(progress / distance).astype(int) - BEHIND
        # A reference that stands behind a car that rolled back would stand for ever.
        fresh |= known & (first < index) & (square[BEHIND] <= 0.0)
        first = jnp.where(fresh, first, jnp.maximum(first, index))
        accelerations = (limits.acceleration, limits.deceleration)
        road = road_ahead(lane, first, self.samples, accelerations, self.spacing)
        new = self._new(road, first, lateral, observation[3])
        held = state.committed._replace(index=index).at(first, road.wanted)
        committed = jax.tree.map(partial(jnp.where, fresh), new, held)
        follows = counts_from(
            path,
            obstacles,
            progress,
            committed.move[0, BEHIND],
            limits,
            samples=self.samples,
            spacing=self.spacing,
        )
        return progress, Situation(
            road=road,
            committed=committed,
            obstacles=obstacles,
            counts_from=follows,
            place=progress / distance - first,
            grip=self._grip(env),
            clean=clean,
        )

    def _search(
        self, planner: Any, situation: Situation, kept: Judged, free: Bool[Array, ""]
    ) -> tuple[Any, Committed, Bool[Array, ""]]:
        """Search for a better reference.

        Returns:
            The state of the planner, the reference to commit, and whether it is one
            that the search found.
        """
        task = self.manoeuvres
        before = situation.committed
        # The planner observes a situation; it needs neither e nor a reference.
        act: Any = self.planner.act
        row, after, info = act(None, planner, situation, None, None)
        usable = info.plan.healthy & (info.plan.violation <= 0.0)
        # A plan that goes on with an old one is not the one that was evaluated.
        cost = jnp.where(usable, info.plan.mean_cost, jnp.inf)
        rows = jnp.concatenate([row[None], task.ways_round(situation)])

        def cost_of(row: Control) -> Scalar:
            plan = task.reference(situation, row)
            judged = task.judge(planner.tuning.cost, situation, plan)
            return jnp.where(judged.violation <= 0.0, judged.cost, jnp.inf)

        costs = jnp.append(cost, jax.vmap(cost_of)(rows[1:]))
        chosen = jnp.argmin(costs)
        cheapest = task.reference(situation, rows[chosen])
        # The next search begins at the cheapest reference.
        after = after._replace(plan=rows[chosen][None])
        better = costs[chosen] < (1.0 - self.better) * kept.cost
        taken = (better | (kept.violation > 0.0)) & jnp.isfinite(costs[chosen])

        def keep() -> Committed:
            return before

        def resort() -> Committed:
            return task.resort(planner.tuning.cost, situation, kept)

        otherwise = jax.lax.cond(taken | free, keep, resort)
        committed = jax.tree.map(partial(jnp.where, taken), cheapest, otherwise)
        return after, committed, taken


in_lane = factory(InLane, InLane.controller)
"""(settings of `InLane`) -> `Controller` of scenes."""
