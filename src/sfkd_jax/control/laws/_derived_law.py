"""Where a path law comes from: Newton's method and Riccati's equation on a vehicle's own step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._model_law import RICCATI_STEPS, SOUND, solve
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.core.path_frame import LATERAL, PATH_SPEED, path_step
from sfkd_jax.types import Control, Scalar, Step

NEWTON = 6
"""Steps to a steady turn from that of the next smaller curvature."""
NUDGE = 3e-3
"""Of every coordinate and control, for differences: a step need not be differentiable."""
STEEPER = (0.5, 5.0)
"""Limits of what more curvature costs in steering, against straight driving: near the
tyres' limit it has none.
"""

Along: TypeAlias = Callable[[Array, Control, Scalar, Array], Array]


def derive_path_law(
    step: Step,
    *,
    coordinates: int,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    lateral_acceleration: float = 2.2,
    speed: tuple[float, float] = (8.0, 10.5),
    points: tuple[int, ...] = (13, 3, 7),
    perturbation: tuple[float, float] = (0.03, 1.0),
    lateral: float = 10.0,
    heading: float = 60.0,
    velocity: float = 5.0,
    curvature: float = 300.0,
    drive: float = 0.5,
) -> PathLaw:
    """Steady turns and gains on a grid of (v_ref² κ, v_ref, e), from a step alone.

        ξ* = F(ξ*, u*; κ, e),  e_y* = 0,  v* = v_ref;   K from Riccati's equation of F linearised there

    F is the vehicle's step in path coordinates, see `path_frame.path_step`, and is
    differentiated by differences, so it may be any function, a simulator on the host as
    well. Newton's method starts every turn from that of the next smaller |κ|; where it
    finds none (a circle too fast for the friction), the turn and gain of that smaller
    curvature stand.

    Args:
        step: (x, u, e) -> x.
        coordinates: size of ξ.
        env_low, env_high: ends of the axes of e.
        lateral_acceleration: end of the axis of v_ref² κ, to both sides [m/s²].
        speed: ends of the v_ref axis [m/s].
        points: on the axes of v_ref² κ (odd), of v_ref, and of every entry of e.
        perturbation: largest |ν|, kept with the law.
        lateral: [1/m²], heading: [1/rad²], velocity: [s²/m²], curvature: [m²], drive:
            per control unit²: weights of Riccati's equation; those of other coordinates
            are zero. Steering is charged by the curvature that it makes on the steady
            turns: where tyres give less, the wheel turns more, and the loop stays as
            fast.

    Raises:
        ValueError: axes that cannot be meant.
    """
    low, high = (
        (-lateral_acceleration, speed[0], *env_low),
        (lateral_acceleration, speed[1], *env_high),
    )
    counts = (*points[:2], *points[2:] * len(env_low))
    if (
        len(points) != 3
        or points[0] % 2 == 0
        or min(counts) < 2
        or not all(a < b for a, b in zip(low, high, strict=True))
    ):
        raise ValueError(
            f"a law needs rising axes and an odd number of accelerations, got {low}, {high}, {counts}"
        )
    along = path_step(step)
    axes = [jnp.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    grid = jnp.stack(jnp.meshgrid(*axes[1:], indexing="ij"), axis=-1).reshape(
        -1, len(axes) - 1
    )
    weights = jnp.diag(
        jnp.zeros(coordinates).at[:3].set(jnp.asarray([lateral, heading, velocity]))
    )

    def row(place: Array) -> tuple[Array, Array, Array]:
        """Turns and gains over all curvatures, for one speed and environment."""
        middle, curvatures = points[0] // 2, axes[0] / place[0] ** 2

        def outward(side: Scalar) -> Array:
            """Turns to one side, from straight driving on."""
            follow = partial(_next_turn, along, place)
            return jax.lax.scan(
                follow, jnp.zeros(coordinates + 2), side * curvatures[middle:]
            )[1]

        left, right = jax.vmap(outward)(jnp.asarray([-1.0, 1.0]))
        turns = jnp.concatenate([left[:0:-1], right])
        steering = jnp.asarray(
            jnp.gradient(turns[:, -2], curvatures[1] - curvatures[0])
        )
        steering = jnp.clip(steering, *(limit * steering[middle] for limit in STEEPER))
        charges = jax.vmap(jnp.diag)(
            jnp.stack([curvature / steering**2, jnp.full(points[0], drive)], axis=1)
        )
        gains = jax.vmap(
            lambda kappa, turn, charge: _gain(
                along, turn, kappa, place, weights, charge
            )
        )
        return turns[:, :-2], turns[:, -2:], gains(curvatures, turns, charges)

    tables = jax.lax.map(row, grid, batch_size=64)
    shaped = [
        jnp.moveaxis(table, 0, 1).reshape(*counts, *table.shape[2:]) for table in tables
    ]
    return PathLaw(
        jnp.asarray(low), jnp.asarray(high), jnp.asarray(perturbation), *shaped
    )


def _next_turn(
    along: Along, place: Array, known: Array, kappa: Scalar
) -> tuple[Array, Array]:
    """(ξ*, u*) at κ by Newton's method from a known turn; the known one where there is none.

    Args:
        along: the step.
        place: v_ref and e.
        known: (ξ, u) of a smaller curvature.
        kappa: [1/m].
    """
    size = known.shape[0] - 2
    free = jnp.asarray(
        [index for index in range(size + 2) if index not in (LATERAL, PATH_SPEED)]
    )
    start = known.at[jnp.asarray([LATERAL, PATH_SPEED])].set(
        jnp.stack([jnp.zeros(()), place[0]])
    )

    def residual(unknown: Array) -> Array:
        turn = start.at[free].set(unknown)
        return along(turn[:-2], turn[-2:], kappa, place[1:]) - turn[:-2]

    def newton(_: Any, carry: tuple[Array, Scalar]) -> tuple[Array, Scalar]:
        unknown = carry[0]
        left, slope = _value_and_jacobian(residual, unknown)
        return unknown - solve(slope, left[:, None])[:, 0], jnp.max(jnp.abs(left))

    found, left = jax.lax.fori_loop(0, NEWTON, newton, (start[free], jnp.zeros(())))
    sound = jnp.all(jnp.isfinite(found)) & (left < SOUND)
    turn = jnp.where(sound, start.at[free].set(found), known)
    return turn, turn


def _gain(
    along: Along,
    turn: Array,
    kappa: Scalar,
    place: Array,
    weights: Array,
    charges: Array,
) -> Float[Array, "2 coordinate"]:
    """K at a steady turn, by the Riccati recursion."""
    size = turn.shape[0] - 2
    _, slopes = _value_and_jacobian(
        lambda both: along(both[:size], both[size:], kappa, place[1:]), turn
    )
    A, B = slopes[:, :size], slopes[:, size:]

    def best(value: Array) -> Array:
        return solve(charges + B.T @ value @ B, B.T @ value @ A)

    def before(_: Any, value: Array) -> Array:
        return weights + A.T @ value @ (A - B @ best(value))

    gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, weights))
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def _value_and_jacobian(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """f and its central differences, one column an entry; all of it one call, which compiles once."""
    nudges = NUDGE * jnp.eye(at.shape[0])
    values = jax.vmap(function)(
        at + jnp.concatenate([jnp.zeros((1, at.shape[0])), nudges, -nudges])
    )
    above, below = jnp.split(values[1:], 2)
    return values[0], (above - below).T / (2.0 * NUDGE)
