"""Choosing a reference: its parameters as a plan, and what makes it admissible."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.lanes._reference import (
    BEHIND,
    SPLICE,
    Committed,
    Curve,
    RoadAhead,
    curve,
    speed_profile,
)
from sfkd_jax.control.tasks._task import RolloutSetup, StepResult, Task, constrained
from sfkd_jax.lanes import Obstacles, beside, distance, place_at
from sfkd_jax.paths import quintic
from sfkd_jax.ranges import Fraction, NonNegative, Positive, Span, check_intervals
from sfkd_jax.types import Control, Params, Scalar

SHORTEST = 12.0
"""Of a lateral move [m]."""
ALMOST = 0.95
"""Share of the grip of a stop that cannot be gentler."""
BEND = 5.77
"""Largest second derivative of a quintic between rests, by its height and length²."""
EVASIVE = 0.85
"""Share of the grip that an evasion uses."""
TRACKED = 3.0
"""Largest v² κ that a law can still follow [m/s²]."""
ENDS = range(-5, 6)
"""Lateral positions at which evasions end, in fifths of the free lane."""
LENGTHS = (0.7, 0.85, 1.0, 1.25)
"""Lengths of evasions, relative to the length that takes all of the grip."""
BRAKING = (0.0, 0.4, 0.8)
"""Shares of the grip left over by the lateral move that evasions brake with."""
LATE = 0.03
"""Distances are those at samples; in between an obstacle may be nearer by less [m]."""


@dataclass(frozen=True, kw_only=True)
class Class:
    """The references of which a corridor was certified, and the car that follows them.

    Attributes:
        curvature: largest [1/m].
        turning: largest change of the curvature per length [1/m²].
        lateral: largest v² κ [m/s²].
        jerk: largest v³ times the change of κ per length [m/s³].
        speed: lowest and highest [m/s].
        half: half of the length and width of the car [m].
        corridor: bound of |e_y| [m].
        heading: bound of |e_ψ| [rad].
        change: largest |dv/dt| [m/s²], in an ellipse with the lateral acceleration.
        acceleration: largest that is planned [m/s²].
        deceleration: largest in a planned change of speed [m/s²].
        braking: largest of a stop that cannot be gentler [m/s²].
        share: of the grip that is planned with.
    """

    curvature: Positive
    turning: Positive
    lateral: Positive
    jerk: Positive
    speed: Span
    half: tuple[Positive, Positive]
    corridor: NonNegative
    heading: NonNegative
    change: Positive = 1e6
    acceleration: Positive = 1.0
    deceleration: Positive = 1.0
    braking: Positive = 6.0
    share: Fraction = 0.7

    def __post_init__(self) -> None:
        check_intervals(self)

    @property
    def margin(self) -> float:
        """What any point of the car is off at most [m]."""
        return self.corridor + math.hypot(*self.half) * self.heading


class Situation(NamedTuple):
    """What references are judged by."""

    road: RoadAhead  # ahead
    committed: Committed  # reference, from the same sample on
    obstacles: Obstacles  # all of them finite
    place: Scalar  # of the car, in samples from the first one
    grip: Scalar  # acceleration that the tyres allow [m/s²]
    # Whether all of the scene is finite; nothing is free in another one.
    clean: Bool[Array, ""]


class Judged(NamedTuple):
    """What a reference is worth."""

    cost: Scalar  # to be compared with those of others
    outside: Scalar  # how far it leaves the class, relative; not above 0 inside
    # What obstacles leave beyond what is needed [m], (sample,).
    gap: Float[Array, " sample"]
    edge: Float[Array, " sample"]  # what the edges leave [m], (sample,)
    curve: Curve  # in the world
    strain: Scalar  # how much it uses of what tyres and law can do at most

    @property
    def blocked(self) -> Bool[Array, " sample"]:
        """Where it comes too near to something; NaN does."""
        return ~(jnp.minimum(self.gap, self.edge) >= 0.0)

    @property
    def violation(self) -> Scalar:
        """How far it is from being admissible, 0 if it is."""
        room = jnp.min(jnp.minimum(self.gap, self.edge))
        return jnp.maximum(jnp.maximum(self.outside, -room), 0.0)


@dataclass(frozen=True, kw_only=True)
class Manoeuvres:
    """The task of choosing a reference: one row of parameters, evaluated at once.

        (d_1, ℓ_1, d_2, ℓ_2, v):   d(s) → d_1 over ℓ_1, then → d_2 over ℓ_2

    Both moves are quintics from what is committed at `SPLICE` on, continuous in
    position, yaw and curvature; the speed approaches v where the road allows it. ℓ and
    v are relative to their middle and to what is wanted.

        J = ∫ w_d d² + w_κ κ² + w_κ' κ'² + w_v (v − v_wanted)² + w_n n² ds

    n is what the free distance lacks of `comfort`. What leaves the class, the lane or
    comes too near to an obstacle violates the constraint.

    Attributes:
        kind: what is admissible.
        dt: sampling period of the obstacles [s].
        widest: largest offset from the centre line [m].
        comfort: distance from obstacles beyond what is needed [m].
        standoff: distance from what is in the way at which it stands [m].
        weights: w_d, w_κ, w_κ', w_v, w_n.
    """

    kind: Class
    dt: Positive
    widest: Positive = 5.0
    comfort: Positive = 0.5
    standoff: NonNegative = 1.0
    weights: tuple[NonNegative, ...] = (0.02, 1e4, 1e6, 1.0, 1.0)

    def task(self) -> Task:
        """Return the planning problem as functions."""
        edge = jnp.asarray([self.widest, 30.0, self.widest, 30.0, 30.0])
        given = -edge, edge, jnp.asarray(self.weights), self.prepare, self.step
        return constrained(
            Task(*given, lambda *_: None), lambda _, violation, *__: violation[None]
        )

    def prepare(self, params: Params, situation: Situation, *_: Any) -> RolloutSetup:
        """Return the situation; there is one step."""
        return RolloutSetup(situation, jnp.zeros(()), jnp.zeros(1))

    def step(
        self, weights: Any, situation: Situation, sample: Scalar, row: Control, *_: Any
    ) -> StepResult:
        """Return the cost of one row, and its violation in place of a state."""
        judged = self.judge(weights, situation, self.reference(situation, row))
        return StepResult(sample, row, row, judged.violation, judged.cost)

    def reference(self, situation: Situation, row: Control) -> Committed:
        """Return the reference of a row of parameters."""
        road = situation.road
        before = situation.committed
        spacing = road.spacing
        count = before.square.shape[0]
        longest, middle = _lengths(road)
        first, second = jnp.clip(row[1:4:2] + middle, SHORTEST, longest)
        ahead = spacing * jnp.arange(count - SPLICE)
        away = quintic(before.move[:, SPLICE], row[0], first, ahead)[:3]
        start = jnp.stack([row[0], jnp.zeros(()), jnp.zeros(())])
        back = quintic(start, row[2], second, jnp.maximum(ahead - first, 0.0))[:3]
        moved = jnp.where(ahead < first, away, back)
        move = jnp.concatenate([before.move[:, :SPLICE], moved], axis=1)
        # Not faster than is wanted, and not so slow that no corridor is known.
        slowest, fastest = self.kind.speed
        wanted = jnp.sqrt(jnp.max(road.wanted)) + jnp.minimum(row[4], 0.0)
        target = jnp.clip(wanted, slowest, fastest)
        most = jnp.minimum(road.wanted, target**2)
        accelerations = self.kind.acceleration, self.kind.deceleration
        square = speed_profile(most, before.square[BEHIND], spacing, *accelerations)
        square = jnp.concatenate([before.square[:BEHIND], square[BEHIND:]])
        return Committed(before.index, move, square)

    def ways_round(self, situation: Situation) -> Float[Array, "way 5"]:
        """Return rows that pass what is ahead on either side, at several speeds.

        Of the next two obstacles both, or the second alone. Few samples fall into the
        gap between two of them, and none from one side of it to the other.
        """
        road = situation.road
        spacing = situation.road.spacing
        longest, middle = _lengths(road)
        splice = spacing * SPLICE
        known, ahead = self._ahead(situation)
        # Instead of one that is not there: the middle of the road at the horizon.
        none = jnp.asarray([spacing * road.curvature.shape[0], 0.0, 0.0])[:, None]
        known = jnp.append(jnp.where(ahead, known, none), jnp.tile(none, 2), axis=1)
        (first, second), aside, room = known[:, jnp.argsort(known[0])[:2]]
        to_both = first - splice - middle, second - first - middle
        to_second = second - splice - middle, longest - middle

        def row(one: float, two: float, slower: Scalar, both: bool) -> Control:
            left = aside + jnp.asarray([one, two]) * room
            start, over = (left[0], to_both) if both else (left[1], to_second)
            return jnp.stack([start, over[0], left[1], over[1], slower])

        sides = (1.0, -1.0)
        speeds = jnp.asarray([0.0, -2.0, -4.0])
        ways = [row(one, two, v, True) for one, two, v in product(sides, sides, speeds)]
        ways += [row(0.0, two, v, False) for two, v in product(sides, speeds)]
        return jnp.stack(ways)

    def _ahead(
        self, situation: Situation
    ) -> tuple[Float[Array, "3 obstacle"], Bool[Array, " obstacle"]]:
        """Which obstacles are ahead; what they take of the road, when the car is there.

        From where on the car is beside each, its distance to the left of the road, and
        how far aside from that the middle of the car has to be [m].
        """
        road = situation.road
        kind = self.kind
        obstacles = situation.obstacles
        samples = jnp.arange(road.curvature.shape[0])
        away = road.spacing * jnp.maximum(samples - situation.place, 0.0)
        speed = jnp.sqrt(situation.committed.square[BEHIND])
        steps = away / jnp.maximum(speed, kind.speed[0]) / self.dt
        nearest, aside = beside(obstacles, road.position, road.direction, steps)
        size = obstacles.radius + jnp.linalg.norm(obstacles.half, axis=1)
        begin = road.spacing * nearest - size - kind.half[0]
        room = size + kind.half[1] + kind.margin + self.comfort
        ahead = begin > road.spacing * situation.place
        return jnp.stack([begin, aside, room]), ahead & obstacles.present

    def _turning(self, situation: Situation, block: Int[Array, ""]) -> Scalar:
        """How far before what blocks a sample a car stands that can still pass it [m].

        `standoff` if that fills the lane.
        """
        road = situation.road
        kind = self.kind
        signs = jnp.asarray([[1.0], [-1.0]])
        (begin, aside, room), ahead = self._ahead(situation)
        sides = aside + signs * room
        # What the sides lack of comfort does not keep it from passing.
        lacks = signs * sides + kind.half[1] + kind.margin - self.comfort
        lacks -= jnp.stack([road.left[block], road.right[block]])[:, None]
        shift = jnp.abs(sides - situation.committed.move[0, block])
        bends = BEND / kind.curvature * shift
        turns = 60.0 / kind.turning * shift
        length = jnp.maximum(jnp.sqrt(bends), jnp.cbrt(turns)) + road.spacing * SPLICE
        length = jnp.min(jnp.where(lacks <= 0.0, length, jnp.inf), axis=0)
        # All that stand there together, within 4 m, may block it, and any may leave.
        there = ahead & (jnp.abs(begin - road.spacing * block) < 4.0)
        length = jnp.where(there & jnp.isfinite(length), length, self.standoff)
        return jnp.max(length)

    def stop(self, situation: Situation, judged: Judged) -> Committed:
        """Return the committed reference with a stop before what blocks it."""
        before = situation.committed
        spacing = situation.road.spacing
        samples = jnp.arange(before.square.shape[0])
        start = before.square[BEHIND]
        # Beside the lateral acceleration of the bend.
        bend = start * jnp.abs(judged.curve.curvature[BEHIND])
        grip = jnp.sqrt(jnp.maximum((ALMOST * situation.grip) ** 2 - bend**2, 0.01))
        grip = jnp.minimum(grip, self.kind.braking)
        gentle = jnp.minimum(self.kind.deceleration, grip)
        block = jnp.argmax(judged.blocked)
        here = situation.place * spacing
        # Where there is time it stands so far away that it can still turn.
        far = jnp.maximum(self._turning(situation, block), self.standoff)
        until = jnp.minimum(
            here + 0.5 * start / gentle, block * spacing - self.standoff
        )
        until = jnp.maximum(until, block * spacing - far)
        left = jnp.maximum(until - here, 1e-3)
        needed = jnp.clip(0.5 * start / left, gentle, grip)
        most = 2.0 * needed * jnp.maximum(until - samples * spacing, 0.0)
        most = jnp.minimum(before.square, most)
        square = speed_profile(most, start, spacing, self.kind.acceleration, grip)
        square = jnp.where(samples < BEHIND, before.square, square)
        return before._replace(square=square)

    def resort(self, weights: Any, situation: Situation, kept: Judged) -> Committed:
        """Return the last resort, where nothing of the class is free.

        The stop, if that is free or nothing is clear of all in view. Else what stays
        farthest: stop, committed reference, or a lateral move, also braked.
        """
        rows = jnp.asarray([*product(ENDS, LENGTHS, BRAKING)])
        moves = jax.vmap(partial(self._evasion, situation))(*rows.T)
        plans = self.stop(situation, kept), situation.committed
        plans = jax.tree.map(lambda *one: jnp.stack(one), *plans)
        plans = jax.tree.map(lambda *some: jnp.concatenate(some), plans, moves)
        judged = jax.vmap(partial(self.judge, weights, situation))(plans)
        room = jnp.min(jnp.minimum(judged.gap, judged.edge), axis=1)
        beyond = 10.0 * jnp.maximum(judged.strain - 1.0, 0.0)
        worth = jnp.minimum(room, self.comfort) - beyond - 0.05 * judged.strain
        # What hits in any case brakes.
        clear = (room[0] < 0.0) & (jnp.max(worth) > -self.kind.margin)
        chosen = jnp.where(clear, jnp.argmax(worth), 0)
        return jax.tree.map(lambda leaf: leaf[chosen], plans)

    def _evasion(
        self, situation: Situation, end: Scalar, longer: Scalar, braking: Scalar
    ) -> Committed:
        """A lateral move with the grip, braking with what it leaves."""
        road = situation.road
        before = situation.committed
        kind = self.kind
        start = before.square[BEHIND]
        count = before.square.shape[0]
        grip = EVASIVE * situation.grip
        pull = jnp.minimum(grip, TRACKED)
        # At low speed it ends where the class does.
        most = jnp.minimum(pull / jnp.maximum(start, 0.01), kind.curvature)
        edge = jnp.where(end > 0.0, road.left[SPLICE], road.right[SPLICE])
        end = 0.2 * end * jnp.maximum(edge - kind.half[1] - kind.margin, 0.0)
        aside = jnp.abs(end - before.move[0, SPLICE])
        length = jnp.maximum(longer * jnp.sqrt(BEND * aside / most), 5.0)
        ahead = road.spacing * jnp.arange(count - SPLICE)
        moved = quintic(before.move[:, SPLICE], end, length, ahead)[:3]
        move = jnp.concatenate([before.move[:, :SPLICE], moved], axis=1)
        along = curve(road, Committed(before.index, move, before.square))
        left = jnp.maximum(grip**2 - (start * along.curvature) ** 2, 0.0)
        lost = 2.0 * road.spacing * braking * jnp.cumsum(jnp.sqrt(left)[BEHIND:])
        square = jnp.clip(start - lost, 0.0, road.wanted[BEHIND:])
        square = jnp.concatenate([before.square[: BEHIND + 1], square[:-1]])
        return Committed(before.index, move, square)

    def judge(self, weights: Any, situation: Situation, plan: Committed) -> Judged:
        """Return what a reference costs, how far it leaves the class, and its room."""
        road = situation.road
        kind = self.kind
        square = plan.square
        lateral = jnp.minimum(kind.lateral, kind.share * situation.grip)
        along = curve(road, plan)
        curvature = along.curvature
        turning = jnp.append(jnp.diff(curvature) / along.lengths, 0.0)
        change = jnp.append(0.5 * jnp.diff(square) / along.lengths, 0.0)
        shares = jnp.stack(
            [
                jnp.abs(curvature) / kind.curvature,
                jnp.abs(turning) / kind.turning,
                square**1.5 * jnp.abs(turning) / kind.jerk,
                jnp.hypot(square * curvature / lateral, change / kind.change),
                square / kind.speed[1] ** 2,
            ]
        )
        pull = jnp.hypot(square * curvature, change) / (ALMOST * situation.grip)
        pull = jnp.maximum(pull, square * jnp.abs(curvature) / TRACKED)
        # What is before the splice cannot be changed any more.
        outside = jnp.max(jnp.where(along.reached, shares, 0.0)[:, SPLICE:]) - 1.0
        strain = jnp.max(jnp.where(along.reached, pull, 0.0)[SPLICE:])
        gap, edge = self._room(situation, plan.move, along)
        costs = jnp.stack(
            [
                plan.move[0] ** 2,
                (curvature - road.curvature) ** 2,
                turning**2,
                (jnp.sqrt(road.wanted) - jnp.sqrt(square)) ** 2,
                jnp.clip(self.comfort - gap, 0.0, self.comfort) ** 2,
            ]
        )
        cost = road.spacing * jnp.sum(weights @ costs[:, BEHIND:])
        return Judged(cost, outside, gap, edge, along, strain)

    def _room(
        self, situation: Situation, move: Float[Array, "3 sample"], along: Curve
    ) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
        """What obstacles and edges leave beyond what is needed [m]."""
        road = situation.road
        half = self.kind.half
        samples = jnp.arange(along.times.shape[0])
        now = jnp.interp(situation.place, samples, along.times)
        steps = jnp.maximum(along.times - now, 0.0) / self.dt
        pose = along.position, along.direction, half

        # One after the other: all samples of all plans are then one long loop, in
        # which nothing is looked up.
        def nearer(before: Array, one: Any) -> tuple[Array, None]:
            return jnp.minimum(before, distance(one[0], one[1], *pose)), None

        places = jax.vmap(lambda one: place_at(one, steps))(situation.obstacles)
        gap = jnp.full(samples.shape, jnp.inf)
        gap, _ = jax.lax.scan(nearer, gap, (situation.obstacles, places))
        edge = jnp.minimum(road.left - move[0], road.right + move[0])
        edge = edge - half[1] - half[0] * jnp.abs(move[1]) / along.stretch
        # The car is between two samples, and both count, also where it stands.
        counts = (along.reached | (samples == BEHIND + 1)) & (samples >= BEHIND)
        gap = gap - LATE - self.kind.margin
        edge = edge - self.kind.margin
        gap = jnp.where(situation.clean, jnp.where(counts, gap, jnp.inf), -jnp.inf)
        return gap, jnp.where(counts, edge, jnp.inf)


def _lengths(road: RoadAhead) -> tuple[Scalar, Scalar]:
    """The longest lateral move, of which two fit into the road, and the middle [m]."""
    longest = 0.5 * road.spacing * (road.curvature.shape[0] - 1 - SPLICE)
    return longest, 0.5 * (SHORTEST + longest)
