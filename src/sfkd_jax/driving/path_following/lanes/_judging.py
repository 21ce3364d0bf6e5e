"""What makes a reference admissible in a lane, and what it costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.lanes import Obstacles, distance, place_at
from sfkd_jax.driving.path_following.lanes._reference import (
    BEHIND,
    SPLICE,
    Committed,
    Curve,
    RoadAhead,
    curve,
)
from sfkd_jax.driving.sizes import CAR, Scale
from sfkd_jax.ranges import Fraction, NonNegative, Positive, Span, check_intervals
from sfkd_jax.types import Scalar

ALMOST = 0.95
"""Share of the grip that a stop uses which cannot be gentler."""
TRACKED = 1.5
"""Largest v² κ that a law can still follow, relative to that of the class."""
SLOW = 0.5
"""Speed from which on a vehicle ahead drives; of a car [m/s]."""
HEADWAY = 1.0
"""Time after which the car has reacted to one ahead that brakes [s]."""
SOON = 4.0
"""Time after which the distance from a car ahead must be safe [s]: somebody who cuts in
leaves less, and is left to gain it.
"""
LATE = 0.03
"""Distance by which an obstacle may be nearer between two samples than at both; of a
car [m].
"""


@dataclass(frozen=True, kw_only=True)
class Class:
    """The references for which a corridor was certified, and the car that follows them.

    Attributes:
        curvature: largest [1/m].
        turning: largest change of the curvature per length [1/m²].
        lateral: largest v² κ [m/s²].
        jerk: largest v³ times the change of κ per length [m/s³].
        speed: lowest and highest [m/s].
        half: half of the length and half of the width of the car [m].
        corridor: bound of |e_y| [m].
        heading: bound of |e_ψ| [rad].
        change: largest |dv/dt| [m/s²], in an ellipse with the lateral acceleration.
        acceleration: largest acceleration that is planned [m/s²].
        deceleration: largest deceleration in a planned change of speed [m/s²].
        braking: largest deceleration of a stop that cannot be gentler [m/s²].
        share: of the grip that is planned with.
        scale: of the car.
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
    scale: Scale = CAR

    def __post_init__(self) -> None:
        check_intervals(self)

    @property
    def margin(self) -> float:
        """Largest distance of any point of the car from where it should be [m]."""
        return self.corridor + math.hypot(*self.half) * self.heading

    @property
    def tracked(self) -> float:
        """Largest v² κ that a law can still follow [m/s²]."""
        return TRACKED * self.lateral


class Situation(NamedTuple):
    """What references are judged by.

    Attributes:
        road: ahead of the car.
        committed: the reference that the car follows, from the same sample on.
        obstacles: all of them finite.
        counts_from: step from which on each obstacle counts, see
            `_followers.counts_from`.
        place: of the car, in samples from the first one.
        grip: acceleration that the tyres allow [m/s²].
        clean: whether all numbers of the scene are finite; if not, nothing is free.
    """

    road: RoadAhead
    committed: Committed
    obstacles: Obstacles
    counts_from: Float[Array, " obstacle"]
    place: Scalar
    grip: Scalar
    clean: Bool[Array, ""]


class Judged(NamedTuple):
    """How good a reference is.

    Attributes:
        cost: to be compared with the costs of other references.
        outside: relative excess over the limits of the class; not above 0 inside.
        gap: what obstacles leave beyond what is needed [m].
        edge: what the edges of the lane leave beyond what is needed [m].
        curve: the reference in the world.
        strain: used share of what tyres and law can do at most.
        headway: what cars ahead leave beyond a safe distance, after a time to reach it
            [m].
    """

    cost: Scalar
    outside: Scalar
    gap: Float[Array, " sample"]
    edge: Float[Array, " sample"]
    curve: Curve
    strain: Scalar
    headway: Scalar

    @property
    def blocked(self) -> Bool[Array, " sample"]:
        """Where the reference comes too near to something; True for NaN."""
        return ~(jnp.minimum(self.gap, self.edge) >= 0.0)

    @property
    def violation(self) -> Scalar:
        """How far the reference is from being admissible; 0 if it is."""
        room = jnp.min(jnp.minimum(self.gap, self.edge))
        room = jnp.minimum(room, self.headway)
        return jnp.maximum(jnp.maximum(self.outside, -room), 0.0)


@dataclass(frozen=True, kw_only=True)
class Judge:
    """The rules by which references are compared.

        J = ∫ w_d d² + w_κ κ² + w_κ' κ'² + w_v (v − v_wanted)² + w_n n² ds

    n is what the free distance lacks of `comfort`.

    Attributes:
        limits: of admissible references.
        dt: sampling period of the obstacles [s].
        comfort: distance from obstacles beyond what is needed [m].
    """

    limits: Class
    dt: float
    comfort: float

    def __call__(self, weights: Any, situation: Situation, plan: Committed) -> Judged:
        """Judge a reference, with w_d, w_κ, w_κ', w_v, w_n as weights."""
        road = situation.road
        limits = self.limits
        square = plan.square
        lateral = jnp.minimum(limits.lateral, limits.share * situation.grip)
        along = curve(road, plan)
        curvature = along.curvature
        turning = jnp.append(jnp.diff(curvature) / along.lengths, 0.0)
        change = jnp.append(0.5 * jnp.diff(square) / along.lengths, 0.0)
        shares = jnp.stack(
            [
                jnp.abs(curvature) / limits.curvature,
                jnp.abs(turning) / limits.turning,
                square**1.5 * jnp.abs(turning) / limits.jerk,
                jnp.hypot(square * curvature / lateral, change / limits.change),
                square / limits.speed[1] ** 2,
            ]
        )
        used = jnp.hypot(square * curvature, change) / (ALMOST * situation.grip)
        used = jnp.maximum(used, square * jnp.abs(curvature) / limits.tracked)
        # What lies before the splice cannot be changed any more.
        outside = jnp.max(jnp.where(along.reached, shares, 0.0)[:, SPLICE:]) - 1.0
        strain = jnp.max(jnp.where(along.reached, used, 0.0)[SPLICE:])
        gap, headway = self._gaps(situation, along, square)
        edge = self._edge(road, plan.move, along)
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
        return Judged(cost, outside, gap, edge, along, strain, headway)

    def _gaps(
        self, situation: Situation, along: Curve, square: Float[Array, " sample"]
    ) -> tuple[Float[Array, " sample"], Scalar]:
        """Return what obstacles leave beyond what is needed, and the headway [m]."""
        samples = jnp.arange(along.times.shape[0])
        now = jnp.interp(situation.place, samples, along.times)
        steps = jnp.maximum(along.times - now, 0.0) / self.dt

        # Obstacles come one after the other: all samples of all plans are then one long
        # loop, in which nothing is looked up.
        def nearer(nearest: Any, inputs: Any) -> tuple[Any, None]:
            obstacle, place, counts_from = inputs
            headway = jnp.inf
            if obstacle.position.shape[0] > 1:
                headway = self._headway(situation, along, square, obstacle, place)
                later = jnp.maximum(counts_from, SOON / self.dt)
                headway = jnp.where(steps >= later, headway, jnp.inf)
            gap = distance(
                obstacle, place, along.position, along.direction, self.limits.half
            )
            gap = jnp.where(steps >= counts_from, gap, jnp.inf)
            return jax.tree.map(jnp.minimum, nearest, (gap, headway)), None

        def places_of(obstacle: Obstacles) -> Any:
            return place_at(obstacle, steps)

        places = jax.vmap(places_of)(situation.obstacles)
        free = jnp.full(samples.shape, jnp.inf)
        obstacles = (situation.obstacles, places, situation.counts_from)
        (gap, headway), _ = jax.lax.scan(nearer, (free, free), obstacles)
        gap = gap - LATE * self.limits.scale.length - self.limits.margin
        gap = jnp.where(_counts(along), gap, jnp.inf)
        headway = jnp.min(jnp.where(_counts(along), headway, jnp.inf))
        return jnp.where(situation.clean, gap, -jnp.inf), headway

    def _headway(
        self,
        situation: Situation,
        along: Curve,
        square: Float[Array, " sample"],
        obstacle: Obstacles,
        place: tuple[Float[Array, " sample"], Float[Array, " sample"]],
    ) -> Float[Array, " sample"]:
        """Return what a car ahead leaves beyond a safe distance [m].

            d = v T + (v² − u²) / (2 b)

        is what the car needs if that one brakes as hard from u as it does itself from v
        (Shalev-Shwartz et al., arXiv:1708.06374). It is infinite for what does not
        drive ahead in the track of the car.

        Args:
            situation: of the car.
            along: the reference.
            square: v² along it [m²/s²].
            obstacle: a row of `Obstacles`, with more than one position.
            place: where it is when the car is at each sample [m].
        """
        cos, sin = along.direction
        x = place[0] - along.position[0]
        y = place[1] - along.position[1]
        length, width = obstacle.half
        turned_cos = jnp.abs(jnp.cos(obstacle.yaw) * cos + jnp.sin(obstacle.yaw) * sin)
        turned_sin = jnp.abs(jnp.sin(obstacle.yaw) * cos - jnp.cos(obstacle.yaw) * sin)
        long = turned_cos * length + turned_sin * width + obstacle.radius
        wide = turned_cos * width + turned_sin * length + obstacle.radius
        ahead = cos * x + sin * y
        aside = jnp.abs(cos * y - sin * x)
        velocity = (obstacle.position[-1] - obstacle.position[-2]) / self.dt
        speed = cos * velocity[0] + sin * velocity[1]
        # Who crosses the road is passed, and who stands is stopped for.
        slow = SLOW * self.limits.scale.speed
        drives = speed > jnp.maximum(0.7 * jnp.linalg.norm(velocity), slow)
        in_track = aside < wide + self.limits.half[1] + self.limits.margin
        hardest = jnp.minimum(ALMOST * situation.grip, self.limits.braking)
        closing = jnp.maximum(square - speed**2, 0.0) / (2.0 * hardest)
        needed = HEADWAY * jnp.sqrt(square) + closing
        follows = obstacle.present & drives & in_track & (ahead > 0.0)
        return jnp.where(follows, ahead - long - self.limits.half[0] - needed, jnp.inf)

    def _edge(
        self, road: RoadAhead, move: Float[Array, "3 sample"], along: Curve
    ) -> Float[Array, " sample"]:
        """Return what the edges of the lane leave beyond what is needed [m]."""
        length, width = self.limits.half
        edge = jnp.minimum(road.left - move[0], road.right + move[0])
        edge = edge - width - length * jnp.abs(move[1]) / along.stretch
        return jnp.where(_counts(along), edge - self.limits.margin, jnp.inf)


def _counts(along: Curve) -> Bool[Array, " sample"]:
    """Return which samples count: those that the car reaches.

    The car is between two samples, and both count, even where it stands.
    """
    samples = jnp.arange(along.times.shape[0])
    return (along.reached | (samples == BEHIND + 1)) & (samples >= BEHIND)
