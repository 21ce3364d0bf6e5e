"""Derive a `PathLaw` from a vehicle's step by Newton's method and Riccati recursion."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._model_law import RESIDUAL_TOLERANCE, RICCATI_STEPS, solve
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.geometry import LATERAL, PATH_SPEED, path_step
from sfkd_jax.ranges import AtLeastTwo, Positive, Span
from sfkd_jax.types import Control, Scalar, Step

NEWTON = 6
"""Newton steps to a steady turn from that of the next smaller curvature."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control; a step function need not be
differentiable.
"""
STEERING_SLOPES = (0.5, 5.0)
"""Limits of d steering / d curvature relative to straight driving. It diverges near the
limit of the tyres.
"""

PathStep: TypeAlias = Callable[[Array, Control, Scalar, Array], Array]
"""(ξ, u, κ, e) -> ξ one step later."""


def derive_path_law(
    step: Step,
    *,
    coordinates: int,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    lateral_acceleration: Positive = 2.2,
    speed: Span = (8.0, 10.5),
    points: tuple[AtLeastTwo, AtLeastTwo, AtLeastTwo] = (13, 3, 7),
    perturbation: tuple[Positive, Positive] = (0.03, 1.0),
    lateral: float = 10.0,
    heading: float = 60.0,
    velocity: float = 5.0,
    curvature: Positive = 300.0,
    drive: Positive = 0.5,
) -> PathLaw:
    """Tabulate steady turns and gains over (v_ref² κ, v_ref, e), from a step alone.

        ξ* = F(ξ*, u*; κ, e),   e_y* = 0,   v* = v_ref

    F is the vehicle's step in path coordinates, see `path_frame.path_step`; K solves
    the Riccati equation of F linearised at ξ*. Derivatives are finite differences, so
    the step may be any function, such as a simulator on the host. Newton's method
    starts every turn from that of the next smaller |κ|. If it does not converge (the
    circle is too fast for the friction), the turn and gain of the smaller curvature are
    used.

    Args:
        step: (x, u, e) -> x one sampling period later.
        coordinates: size of ξ.
        env_low: lower ends of the axes of e.
        env_high: upper ends of the axes of e.
        lateral_acceleration: end of the axis of v_ref² κ, to both sides [m/s²].
        speed: ends of the axis of v_ref [m/s].
        points: on the axes of v_ref² κ (odd), of v_ref, and of every entry of e.
        perturbation: largest |ν|, stored with the law.
        lateral: weight in the Riccati equation [1/m²].
        heading: weight [1/rad²].
        velocity: weight [s²/m²]; the weights of further coordinates are zero.
        curvature: weight of the steering [m²], on the curvature that it produces on the
            steady turns. Where the tyres give less, the law steers more, and the loop
            stays as fast.
        drive: weight, per control unit².

    Raises:
        ValueError: an axis is not ascending or has too few points.
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
            "a law needs rising axes and an odd number of accelerations, "
            f"got {low}, {high}, {counts}"
        )
    axes = [jnp.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    grid = jnp.stack(jnp.meshgrid(*axes[1:], indexing="ij"), axis=-1).reshape(
        -1, len(axes) - 1
    )
    state_weights = jnp.diag(
        jnp.zeros(coordinates).at[:3].set(jnp.asarray([lateral, heading, velocity]))
    )
    row = partial(
        _row,
        path_step(step),
        accelerations=axes[0],
        state_weights=state_weights,
        curvature=curvature,
        drive=drive,
    )
    tables = jax.lax.map(row, grid, batch_size=64)
    state, control, gain = (
        jnp.moveaxis(table, 0, 1).reshape(*counts, *table.shape[2:]) for table in tables
    )
    ends = jnp.asarray(low), jnp.asarray(high)
    return PathLaw(*ends, jnp.asarray(perturbation), state, control, gain)


def _row(
    step: PathStep,
    condition: Array,
    *,
    accelerations: Array,
    state_weights: Array,
    curvature: float,
    drive: float,
) -> tuple[Array, Array, Array]:
    """Steady states, controls and gains over all accelerations.

    Args:
        step: in path coordinates.
        condition: v_ref and e.
        accelerations: v_ref² κ, symmetric about 0.
        state_weights: of the Riccati equation.
        curvature: weight of the steering.
        drive: weight of the second control.
    """
    points, coordinates = accelerations.shape[0], state_weights.shape[0]
    middle, curvatures = points // 2, accelerations / condition[0] ** 2

    def outward(side: Scalar) -> Array:
        """Turns to one side, from straight driving on."""
        follow = partial(_next_turn, step, condition)
        return jax.lax.scan(
            follow, jnp.zeros(coordinates + 2), side * curvatures[middle:]
        )[1]

    left, right = jax.vmap(outward)(jnp.asarray([-1.0, 1.0]))
    turns = jnp.concatenate([left[:0:-1], right])
    slopes = jnp.asarray(jnp.gradient(turns[:, -2], curvatures[1] - curvatures[0]))
    slopes = jnp.clip(slopes, *(limit * slopes[middle] for limit in STEERING_SLOPES))
    control_weights = jax.vmap(jnp.diag)(
        jnp.stack([curvature / slopes**2, jnp.full(points, drive)], axis=1)
    )
    gains = jax.vmap(
        lambda kappa, turn, weights: _gain(
            step, turn, kappa, condition, state_weights, weights
        )
    )
    return turns[:, :-2], turns[:, -2:], gains(curvatures, turns, control_weights)


def _next_turn(
    step: PathStep, condition: Array, known: Array, kappa: Scalar
) -> tuple[Array, Array]:
    """(ξ*, u*) at κ by Newton's method from a known turn; that turn without a solution.

    Args:
        step: in path coordinates.
        condition: v_ref and e.
        known: (ξ, u) of a smaller curvature.
        kappa: [1/m].
    """
    size = known.shape[0] - 2
    free = jnp.asarray(
        [index for index in range(size + 2) if index not in (LATERAL, PATH_SPEED)]
    )
    start = known.at[jnp.asarray([LATERAL, PATH_SPEED])].set(
        jnp.stack([jnp.zeros(()), condition[0]])
    )

    def residual(unknown: Array) -> Array:
        turn = start.at[free].set(unknown)
        return step(turn[:-2], turn[-2:], kappa, condition[1:]) - turn[:-2]

    def newton(_: Any, carry: tuple[Array, Scalar]) -> tuple[Array, Scalar]:
        unknown = carry[0]
        value, slope = _value_and_jacobian(residual, unknown)
        change = solve(slope, value[:, None])[:, 0]
        return unknown - change, jnp.max(jnp.abs(value))

    solution, error = jax.lax.fori_loop(0, NEWTON, newton, (start[free], jnp.zeros(())))
    valid = jnp.all(jnp.isfinite(solution)) & (error < RESIDUAL_TOLERANCE)
    turn = jnp.where(valid, start.at[free].set(solution), known)
    return turn, turn


def _gain(
    step: PathStep,
    turn: Array,
    kappa: Scalar,
    condition: Array,
    state_weights: Array,
    control_weights: Array,
) -> Float[Array, "2 coordinate"]:
    """K at a steady turn by the Riccati recursion."""
    size = turn.shape[0] - 2
    _, slopes = _value_and_jacobian(
        lambda both: step(both[:size], both[size:], kappa, condition[1:]), turn
    )
    A, B = slopes[:, :size], slopes[:, size:]

    def best(value: Array) -> Array:
        return solve(control_weights + B.T @ value @ B, B.T @ value @ A)

    def before(_: Any, value: Array) -> Array:
        return state_weights + A.T @ value @ (A - B @ best(value))

    gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, state_weights))
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def _value_and_jacobian(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """f and its central differences, one column per entry, in a single batched call."""
    offsets = DIFFERENCE_STEP * jnp.eye(at.shape[0])
    values = jax.vmap(function)(
        at + jnp.concatenate([jnp.zeros((1, at.shape[0])), offsets, -offsets])
    )
    above, below = jnp.split(values[1:], 2)
    return values[0], (above - below).T / (2.0 * DIFFERENCE_STEP)
