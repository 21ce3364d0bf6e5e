"""Steady turns and the Riccati gains around them, of any step along a path.

One derivation serves both laws, `ModelLaw` and `PathLaw`: Newton's method finds the
steady turn, the Riccati recursion the gain around it. Only the derivative differs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control."""

Derivative: TypeAlias = Callable[[Callable[[Array], Array], Array], tuple[Array, Array]]
"""(function, point) -> (value, Jacobian)."""


class Linearised(NamedTuple):
    """A step around (ξ, u), its matrices (A, B), and whether ξ stays what it is."""

    both: Float[Array, "*turn both"]
    slopes: Float[Array, "*turn coordinate both"]
    steady: Bool[Array, "*turn"]


def by_differentiation(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """Return value and Jacobian in forward mode, with one copy of the function."""

    def twice(point: Array) -> tuple[Array, Array]:
        # The value beside the Jacobian: calling
        # `function` twice would compile it twice.
        value = function(point)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(at)
    return value, jacobian


def by_differences(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """Return value and central differences, one column per entry, in a single batch.

    The function need not be differentiable: a simulator on the host will do.
    """
    # 3e-3 balances the rounding of float32 against the curvature of the step.
    offsets = DIFFERENCE_STEP * jnp.eye(at.shape[0])
    values = jax.vmap(function)(
        at + jnp.concatenate([jnp.zeros((1, at.shape[0])), offsets, -offsets])
    )
    above, below = jnp.split(values[1:], 2)
    return values[0], (above - below).T / (2.0 * DIFFERENCE_STEP)


def steady_turn(
    moved: Callable[[Array], Array],
    start: Float[Array, " both"],
    derivative: Derivative,
    *,
    steps: int,
) -> Linearised:
    """Solve ξ* = F(ξ*, u*) by Newton's method, and linearise F there.

    The unknowns are the relative yaw, the body state without v, and u; e_y and v stay
    as in `start`.
    """
    size = start.shape[0] - 2
    # e_y and v are given: the car is on its path, at the reference speed.
    free = jnp.asarray([1, *range(3, size + 2)])

    def newton(_: Any, carry: tuple[Array, Linearised]) -> tuple[Array, Linearised]:
        unknown, _ = carry
        both = start.at[free].set(unknown)
        after, slopes = derivative(moved, both)
        gap = after - both[:size]
        # Square: two unknown controls take the places of the two fixed coordinates.
        matrix = (slopes - jnp.eye(size, size + 2))[:, free]
        better = unknown - solve(matrix, gap[:, None])[:, 0]
        # A NaN compares as False, so that a diverged turn is never steady.
        steady = jnp.max(jnp.abs(gap)) < RESIDUAL_TOLERANCE
        steady &= jnp.all(jnp.isfinite(both))
        return better, Linearised(both, slopes, steady)

    nothing = Linearised(start, jnp.zeros((size, size + 2)), jnp.asarray(False))
    # The loop holds the only copy of the step and its derivative, which take long to
    # compile; its last pass evaluates them where the others have led.
    return jax.lax.fori_loop(0, steps + 1, newton, (start[free], nothing))[1]


def riccati_gain(
    slopes: Float[Array, "coordinate both"],
    state_weights: tuple[float, ...],
    control_weights: Float[Array, " 2"],
) -> Float[Array, "2 coordinate"]:
    """Return K of the Riccati recursion; 0 where it is not finite."""
    A, B = jnp.split(slopes, [slopes.shape[0]], axis=1)
    diagonal = jnp.zeros(A.shape[0]).at[: len(state_weights)]
    Q, R = jnp.diag(diagonal.set(jnp.asarray(state_weights))), jnp.diag(control_weights)

    def best(value: Array) -> Array:
        # R > 0 keeps the matrix invertible, also where a control has no effect.
        return solve(R + B.T @ value @ B, B.T @ value @ A)

    def before(_: Any, value: Array) -> Array:
        return Q + A.T @ value @ (A - B @ best(value))

    gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, Q))
    # Without a gain the law is its feed-forward alone, which is finite.
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Return matrix⁻¹ right by Gaussian elimination with pivoting; for few unknowns.

    `jnp.linalg.solve` calls LAPACK, and XLA takes tens of seconds to compile a program
    with several such calls inside maps.
    """
    size = matrix.shape[0]
    indices = jnp.arange(size)

    def eliminate(column: Array, rows: Array) -> Array:
        # Rows above the column are done; −1 keeps them from being chosen as pivots.
        candidates = jnp.where(indices < column, -1.0, jnp.abs(rows[:, column]))
        pivot = jnp.argmax(candidates)
        order = indices.at[column].set(pivot).at[pivot].set(column)
        rows = rows[order]
        lead = rows[column] / rows[column, column]
        return (rows - rows[:, column, None] * lead).at[column].set(lead)

    # A loop that is not unrolled: half of the instructions of a law are in here.
    rows = jax.lax.fori_loop(
        0, size, eliminate, jnp.concatenate([matrix, right], axis=1)
    )
    return rows[:, size:]
