"""Choosing a reference in a lane: its parameters as a plan, stops and evasions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control import RolloutSetup, StepResult, Task, constrained
from sfkd_jax.driving.lanes import beside
from sfkd_jax.driving.path_following.lanes._judging import (
    ALMOST,
    Class,
    Judge,
    Judged,
    Situation,
)
from sfkd_jax.driving.path_following.lanes._reference import (
    BEHIND,
    SPLICE,
    Committed,
    RoadAhead,
    curve,
    speed_profile,
)
from sfkd_jax.driving.paths import quintic
from sfkd_jax.info import Candidates
from sfkd_jax.ranges import NonNegative, Positive
from sfkd_jax.types import Control, Params, Scalar

SHORTEST = 12.0
"""Shortest lateral move; of a car [m]."""
BEND = 5.77
"""Largest second derivative of a quintic between rests, by its height and length²."""
EVASIVE = 0.85
"""Share of the grip that an evasion uses."""
ENDS = range(-5, 6)
"""Lateral positions at which evasions end, in fifths of the free lane."""
LENGTHS = (0.7, 0.85, 1.0, 1.25)
"""Lengths of evasions, relative to the length that takes all of the grip."""
GAINED = 0.02
"""Room that the last resort must leave beyond that of a stop; of a car [m]."""
SHORTEST_EVASION = 5.0
"""Shortest lateral move of an evasion; of a car [m]."""
TOGETHER = 4.0
"""Distance within which obstacles stand at the same place of the road; of a car [m]."""
FAR = 30.0
"""Largest change of a length [m], and of a speed [m/s], that is searched; of a car."""
SLOWER = (0.0, -2.0, -4.0)
"""Changes of the speed at which obstacles are passed; of a car [m/s]."""
SHOWN_STREAM = 1
"""Number that is folded into the key of a search for the candidates that are shown."""
BRAKING = (0.0, 0.4, 0.8)
"""Shares of the grip left over by the lateral move that evasions brake with."""


@dataclass(frozen=True, kw_only=True)
class Manoeuvres:
    """The task of choosing a reference: one row of parameters, evaluated at once.

        (d_1, ℓ_1, d_2, ℓ_2, v):   d(s) → d_1 over ℓ_1, then → d_2 over ℓ_2

    Both moves are quintics from what is committed at `SPLICE` on, continuous in
    position, yaw and curvature. The speed approaches v where the road allows it. ℓ is
    relative to the middle of its range, and v to the wanted speed.

    The costs are those of `Judge`. A reference violates the constraint if it leaves the
    class or the lane, or comes too near to an obstacle.

    Attributes:
        kind: class of the admissible references.
        dt: sampling period of the obstacles [s].
        widest: largest offset from the centre line [m].
        comfort: distance from obstacles beyond what is needed [m].
        standoff: distance from an obstacle in the way at which the car stands [m].
        weights: w_d, w_κ, w_κ', w_v, w_n.
    """

    kind: Class
    dt: Positive
    widest: Positive = 5.0
    comfort: Positive = 0.5
    standoff: NonNegative = 1.0
    weights: tuple[NonNegative, ...] = (0.02, 1e4, 1e6, 1.0, 1.0)

    @classmethod
    def scaled(cls, kind: Class, dt: float) -> Manoeuvres:
        """Return the task of a vehicle, with the defaults of a car in its scale."""
        of_car = cls(kind=kind, dt=dt)
        length, speed = kind.scale
        # Each weight is that of a square.
        units = (length**-2, length**2, length**4, speed**-2, length**-2)
        weights = zip(of_car.weights, units, strict=True)
        return replace(
            of_car,
            widest=length * of_car.widest,
            comfort=length * of_car.comfort,
            standoff=length * of_car.standoff,
            weights=tuple(weight * unit for weight, unit in weights),
        )

    @property
    def judge(self) -> Judge:
        """The rules by which references are compared."""
        return Judge(limits=self.kind, dt=self.dt, comfort=self.comfort)

    def task(self) -> Task:
        """Return the planning problem as functions."""
        far = FAR * self.kind.scale.length
        change = FAR * self.kind.scale.speed
        largest = jnp.asarray([self.widest, far, self.widest, far, change])

        def no_check(*_: Any) -> None:
            return None

        def violation_of(data: Any, violation: Scalar, *_: Any) -> Float[Array, " 1"]:
            return violation[None]

        task = Task(
            low=-largest,
            high=largest,
            weights=jnp.asarray(self.weights),
            prepare=self.prepare,
            step=self.step,
            check=no_check,
        )
        return constrained(task, violation_of)

    def prepare(self, params: Params, situation: Situation, *_: Any) -> RolloutSetup:
        """Return the situation; there is one step."""
        return RolloutSetup(situation, jnp.zeros(()), jnp.zeros(1))

    def step(
        self, weights: Any, situation: Situation, sample: Scalar, row: Control, *_: Any
    ) -> StepResult:
        """Return the cost of one row, and its violation in place of a state."""
        judged = self.judge(weights, situation, self.reference(situation, row))
        return StepResult(
            sample=sample,
            control=row,
            perturbation=row,
            state=judged.violation,
            cost=judged.cost,
        )

    def reference(self, situation: Situation, row: Control) -> Committed:
        """Return the reference of a row of parameters."""
        road = situation.road
        before = situation.committed
        spacing = road.spacing
        count = before.square.shape[0]
        shortest = SHORTEST * self.kind.scale.length
        longest, middle = _lengths(road, shortest)
        first, second = jnp.clip(row[1:4:2] + middle, shortest, longest)
        ahead = spacing * jnp.arange(count - SPLICE)
        away = quintic(before.move[:, SPLICE], row[0], first, ahead)[:3]
        start = jnp.stack([row[0], jnp.zeros(()), jnp.zeros(())])
        back = quintic(start, row[2], second, jnp.maximum(ahead - first, 0.0))[:3]
        moved = jnp.where(ahead < first, away, back)
        move = jnp.concatenate([before.move[:, :SPLICE], moved], axis=1)
        # The speed is not above the wanted one, nor so low that no corridor is known.
        slowest, fastest = self.kind.speed
        wanted = jnp.sqrt(jnp.max(road.wanted)) + jnp.minimum(row[4], 0.0)
        target = jnp.clip(wanted, slowest, fastest)
        square = speed_profile(
            jnp.minimum(road.wanted, target**2),
            before.square[BEHIND],
            spacing,
            self.kind.acceleration,
            self.kind.deceleration,
        )
        square = jnp.concatenate([before.square[:BEHIND], square[BEHIND:]])
        return Committed(before.index, move, square)

    def ways_round(self, situation: Situation) -> Float[Array, "way 5"]:
        """Return rows that pass what is ahead on either side, at several speeds.

        They pass both of the next two obstacles, or the second one alone. Few samples
        of a search fall into the gap between two obstacles, and none from one side of
        the gap to the other.
        """
        road = situation.road
        spacing = road.spacing
        scale = self.kind.scale
        longest, middle = _lengths(road, SHORTEST * scale.length)
        splice = spacing * SPLICE
        places, ahead = self._ahead(situation)
        # In place of an obstacle that is not there: the middle of the road at the
        # horizon.
        none = jnp.asarray([spacing * road.curvature.shape[0], 0.0, 0.0])[:, None]
        places = jnp.where(ahead, places, none)
        places = jnp.append(places, jnp.tile(none, 2), axis=1)
        (first, second), aside, room = places[:, jnp.argsort(places[0])[:2]]

        def pass_both(first_side: float, second_side: float, slower: Scalar) -> Control:
            left = aside + jnp.asarray([first_side, second_side]) * room
            to_first = first - splice - middle
            to_second = second - first - middle
            return jnp.stack([left[0], to_first, left[1], to_second, slower])

        def pass_second(side: float, slower: Scalar) -> Control:
            left = aside + jnp.asarray([0.0, side]) * room
            to_second = second - splice - middle
            return jnp.stack([left[1], to_second, left[1], longest - middle, slower])

        sides = (1.0, -1.0)
        speeds = scale.speed * jnp.asarray(SLOWER)
        ways = [pass_both(*way) for way in product(sides, sides, speeds)]
        ways += [pass_second(*way) for way in product(sides, speeds)]
        return jnp.stack(ways)

    def candidates(self, situation: Situation, planner: Any, count: int) -> Candidates:
        """Return references like those that a search from a state compares.

        They are the ways round, and rows drawn from the distribution of the samples.

        Args:
            situation: of the car.
            planner: state of the search before it.
            count: number of rows that are drawn.
        """
        # A stream of its own: the search draws with the key itself.
        key = jax.random.fold_in(jax.random.wrap_key_data(planner.key), SHOWN_STREAM)
        noise = jax.random.normal(key, (count, planner.plan.shape[1]))
        drawn = planner.plan + planner.tuning.noise_std * noise
        rows = jnp.concatenate([drawn, self.ways_round(situation)])

        def candidate(row: Control) -> Candidates:
            reference = self.reference(situation, row)
            judged = self.judge(planner.tuning.cost, situation, reference)
            return Candidates(judged.curve.position, judged.violation <= 0.0)

        return jax.vmap(candidate)(rows)

    def _ahead(
        self, situation: Situation
    ) -> tuple[Float[Array, "3 obstacle"], Bool[Array, " obstacle"]]:
        """Return what the obstacles take of the road when the car is there.

        Returns:
            For each obstacle, from where on the car is beside it [m], its distance to
            the left of the road [m], and how far aside from that the middle of the car
            has to be [m]; and which obstacles are ahead.
        """
        road = situation.road
        limits = self.kind
        obstacles = situation.obstacles
        samples = jnp.arange(road.curvature.shape[0])
        away = road.spacing * jnp.maximum(samples - situation.place, 0.0)
        speed = jnp.sqrt(situation.committed.square[BEHIND])
        steps = away / jnp.maximum(speed, limits.speed[0]) / self.dt
        nearest, aside = beside(obstacles, road.position, road.direction, steps)
        size = obstacles.radius + jnp.linalg.norm(obstacles.half, axis=1)
        begin = road.spacing * nearest - size - limits.half[0]
        room = size + limits.half[1] + limits.margin + self.comfort
        ahead = begin > road.spacing * situation.place
        return jnp.stack([begin, aside, room]), ahead & obstacles.present

    def _turning(self, situation: Situation, block: Int[Array, ""]) -> Scalar:
        """Return how far before a blocked sample a car stands that can still pass [m].

        It is `standoff` if the obstacle fills the lane.
        """
        road = situation.road
        limits = self.kind
        signs = jnp.asarray([[1.0], [-1.0]])
        (begin, aside, room), ahead = self._ahead(situation)
        sides = aside + signs * room
        # A side that lacks comfort alone does not keep the car from passing.
        lacks = signs * sides + limits.half[1] + limits.margin - self.comfort
        lacks -= jnp.stack([road.left[block], road.right[block]])[:, None]
        shift = jnp.abs(sides - situation.committed.move[0, block])
        # The length that keeps the curvature, and the length that keeps its change.
        by_curvature = jnp.sqrt(BEND / limits.curvature * shift)
        by_turning = jnp.cbrt(60.0 / limits.turning * shift)
        length = jnp.maximum(by_curvature, by_turning) + road.spacing * SPLICE
        length = jnp.min(jnp.where(lacks <= 0.0, length, jnp.inf), axis=0)
        # All obstacles that stand there together may block the sample, and any of them
        # may leave.
        together = TOGETHER * limits.scale.length
        there = ahead & (jnp.abs(begin - road.spacing * block) < together)
        length = jnp.where(there & jnp.isfinite(length), length, self.standoff)
        return jnp.max(length)

    def stop(self, situation: Situation, judged: Judged) -> Committed:
        """Return the committed reference with a stop before what blocks it."""
        before = situation.committed
        spacing = situation.road.spacing
        samples = jnp.arange(before.square.shape[0])
        start = before.square[BEHIND]
        # The lateral acceleration of the bend takes its part of the grip.
        lateral = start * jnp.abs(judged.curve.curvature[BEHIND])
        grip = jnp.sqrt(jnp.maximum((ALMOST * situation.grip) ** 2 - lateral**2, 0.01))
        grip = jnp.minimum(grip, self.kind.braking)
        gentle = jnp.minimum(self.kind.deceleration, grip)
        block = jnp.argmax(judged.blocked)
        here = situation.place * spacing
        # Where there is time, the car stands so far away that it can still turn.
        far = jnp.maximum(self._turning(situation, block), self.standoff)
        until = jnp.minimum(
            here + 0.5 * start / gentle, block * spacing - self.standoff
        )
        until = jnp.maximum(until, block * spacing - far)
        left = jnp.maximum(until - here, 1e-3)
        needed = jnp.clip(0.5 * start / left, gentle, grip)
        largest = 2.0 * needed * jnp.maximum(until - samples * spacing, 0.0)
        largest = jnp.minimum(before.square, largest)
        square = speed_profile(largest, start, spacing, self.kind.acceleration, grip)
        square = jnp.where(samples < BEHIND, before.square, square)
        return before._replace(square=square)

    def resort(self, weights: Any, situation: Situation, kept: Judged) -> Committed:
        """Return the last resort, for a situation where nothing of the class is free.

        It is the stop, if the stop is free, if nothing leaves more room than it, as in
        a lane that is too narrow, or if nothing in view is clear of all obstacles.
        Otherwise it is what stays farthest away: the committed reference, or a lateral
        move, with or without braking.
        """
        evasions = jnp.asarray([*product(ENDS, LENGTHS, BRAKING)])
        moves = jax.vmap(partial(self._evasion, situation))(*evasions.T)

        def joined(stop: Array, committed: Array, moves: Array) -> Array:
            return jnp.concatenate([jnp.stack([stop, committed]), moves])

        stop = self.stop(situation, kept)
        plans = jax.tree.map(joined, stop, situation.committed, moves)
        judged = jax.vmap(partial(self.judge, weights, situation))(plans)
        room = jnp.min(jnp.minimum(judged.gap, judged.edge), axis=1)
        length = self.kind.scale.length
        beyond = length * 10.0 * jnp.maximum(judged.strain - 1.0, 0.0)
        worth = jnp.minimum(room, self.comfort) - beyond - length * 0.05 * judged.strain
        best = jnp.argmax(worth)
        # A car that cannot avoid a collision brakes.
        avoids = (room[0] < 0.0) & (worth[best] > -self.kind.margin)
        avoids &= room[best] > room[0] + GAINED * length
        chosen = jnp.where(avoids, best, 0)
        return jax.tree.map(lambda leaf: leaf[chosen], plans)

    def _evasion(
        self, situation: Situation, end: Scalar, longer: Scalar, braking: Scalar
    ) -> Committed:
        """Return a lateral move that uses the grip, and brakes with what it leaves.

        Args:
            situation: of the car.
            end: of `ENDS`.
            longer: of `LENGTHS`.
            braking: of `BRAKING`.
        """
        road = situation.road
        before = situation.committed
        limits = self.kind
        start = before.square[BEHIND]
        count = before.square.shape[0]
        grip = EVASIVE * situation.grip
        lateral = jnp.minimum(grip, limits.tracked)
        # At low speed the curvature is limited by the class.
        bend = jnp.minimum(lateral / jnp.maximum(start, 0.01), limits.curvature)
        edge = jnp.where(end > 0.0, road.left[SPLICE], road.right[SPLICE])
        end = 0.2 * end * jnp.maximum(edge - limits.half[1] - limits.margin, 0.0)
        aside = jnp.abs(end - before.move[0, SPLICE])
        shortest = SHORTEST_EVASION * limits.scale.length
        length = jnp.maximum(longer * jnp.sqrt(BEND * aside / bend), shortest)
        ahead = road.spacing * jnp.arange(count - SPLICE)
        moved = quintic(before.move[:, SPLICE], end, length, ahead)[:3]
        move = jnp.concatenate([before.move[:, :SPLICE], moved], axis=1)
        along = curve(road, Committed(before.index, move, before.square))
        left = jnp.maximum(grip**2 - (start * along.curvature) ** 2, 0.0)
        lost = 2.0 * road.spacing * braking * jnp.cumsum(jnp.sqrt(left)[BEHIND:])
        square = jnp.clip(start - lost, 0.0, road.wanted[BEHIND:])
        square = jnp.concatenate([before.square[: BEHIND + 1], square[:-1]])
        return Committed(before.index, move, square)


def _lengths(road: RoadAhead, shortest: float) -> tuple[Scalar, Scalar]:
    """Return the longest lateral move, and the middle of all lengths [m].

    Two of the longest moves fit into the road.

    Args:
        road: ahead of the car.
        shortest: lateral move [m].
    """
    longest = 0.5 * road.spacing * (road.curvature.shape[0] - 1 - SPLICE)
    return longest, 0.5 * (shortest + longest)
