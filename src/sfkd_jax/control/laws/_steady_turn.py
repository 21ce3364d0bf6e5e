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

from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, PathState, wrap_angle
from sfkd_jax.types import Control

RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control."""
NEAR = ((0.45, 0.12, 3.0), (0.5, 0.25, 0.8))
"""Boxes of |e_y| [m], |e_ψ| [rad] and |v − v_ref| [m/s] in which a law is linear: more
than any model sees. Who turns hard must not accelerate hard as well.
"""
# The approach, chosen by a random search on both benchmark cars: how soon how many of
# 420 starts and of 2500 random ones are back. All lengths and times scale with the law.
ARC, CORNERING, SHARED = 0.56, 0.95, 0.55
"""Shares of the grip that arc, steering and the turn's part of the circle may use."""
STEEPEST, TURN = 1.5, 1.2
"""Largest angle of approach and largest heading error that is fed back [rad]."""
DAMPING = 2.2
"""Of the rates of the body, relative to the linear law."""
CIRCLE = 2.8
"""Radius of the tightest turn, relative to d steering / d curvature."""
SLOWER, DISTANT = (0.2, 1.0), (1.9, 14.0)
"""Heading error [rad] and |e_y| [m] from which on the vehicle slows down, and over
which it reaches its lowest speed.
"""
FASTER, BRAKING = 0.5, 1.2
"""Largest differences of speed [m/s] that are fed back."""

Derivative: TypeAlias = Callable[[Callable[[Array], Array], Array], tuple[Array, Array]]
"""(function, point) -> (value, Jacobian)."""


class SteadyTurn(NamedTuple):
    """Steady driving along a circle, and the feedback gain around it.

    Attributes:
        state: path coordinates ξ* = (distance left of the path, yaw relative to it,
            body state).
        control: u*.
        gain: K.
        grip: d steering / d curvature [rad m] and the lateral acceleration [m/s²] that
            steering and braking may use far from the path; None: linear everywhere.
    """

    state: Float[Array, "*step coordinate"]
    control: Float[Array, "*step control"]
    gain: Float[Array, "*step control coordinate"]
    grip: Float[Array, "*step 2"] | None = None

    def feedback(self, coordinates: PathState) -> Control:
        """Return the control of the whole plane, without the limits of the actuators.

            u = u* − K (ξ − ξ*)   in one of the boxes `NEAR`

        At twice that distance and beyond it is `approach`, in between a mixture.
        """
        # Relative to ξ*, not to 0: in side wind a car on its path has a heading error.
        linear = self.control - self.gain @ (coordinates - self.state)
        if self.grip is None:
            return linear
        errors = jnp.abs(coordinates[: PATH_SPEED + 1] - self.state[: PATH_SPEED + 1])
        away = jnp.min(jnp.max(errors / jnp.asarray(NEAR), axis=1))
        share = jnp.clip(away - 1.0, 0.0, 1.0)
        far = approach(self, self.grip, coordinates)
        # A choice, not a mixture with weight 0: near the path the law is bit for bit
        # the linear one, around which models are learned and certified.
        return jnp.where(share > 0.0, linear + share * (far - linear), linear)


def approach(
    turn: SteadyTurn, grip: Float[Array, " 2"], coordinates: PathState
) -> Control:
    """Return the control far from the path, which brings the vehicle back to it.

        ψ* = −sign(e_y) min(K_y/K_ψ |e_y|, √(2 |e_y| / R), `STEEPEST`),   R ~ v²/a
        δ = u*_δ − K_ψ sat(e_ψ − ψ*) − K_r r,   |δ| ≤ (dδ/dκ) a / v²

    Near the path ψ* is that of the linear law; farther away the vehicle can turn in on
    an arc of radius R. It is slower, the more it has to turn, and speeds up once it
    points the right way; steering and drive share the grip a.

    Args:
        turn: whose state, control and gain are used.
        grip: see `SteadyTurn`.
        coordinates: ξ.
    """
    errors = coordinates - turn.state
    slope, available = grip[0], grip[1]
    speed = jnp.maximum(jnp.abs(coordinates[PATH_SPEED]), 1.0)
    sideways, radius = jnp.abs(errors[LATERAL]), speed**2 / (ARC * available)
    steering, drive = turn.gain[0], turn.gain[1]

    # A law that does not steer has no approach.
    ratio = steering[LATERAL] / jnp.maximum(steering[HEADING], 1e-6)
    linear = ratio * sideways
    angle = jnp.minimum(
        jnp.minimum(linear, jnp.sqrt(2.0 * sideways / radius)), STEEPEST
    )
    turned = wrap_angle(errors[HEADING] + jnp.sign(errors[LATERAL]) * angle)
    # Feed-forward helps along the path only; the rates of the body damp a slide.
    ahead = turn.control[0] * jnp.maximum(1.0 - jnp.abs(turned), 0.0)
    rest = steering[PATH_SPEED + 1 :] @ errors[PATH_SPEED + 1 :]
    wanted = ahead - steering[HEADING] * jnp.clip(turned, -TURN, TURN) - DAMPING * rest
    most = slope * CORNERING * available / speed**2 + 0.01
    wanted = jnp.clip(wanted, -most, most)

    reference = turn.state[PATH_SPEED]
    slow = jnp.minimum(reference, jnp.sqrt(CIRCLE * slope * available))
    astray = jnp.clip((jnp.abs(turned) - SLOWER[0]) / SLOWER[1], 0.0, 1.0)
    away = jnp.clip((sideways - DISTANT[0]) / DISTANT[1], 0.0, 1.0)
    target = reference + (slow - reference) * jnp.maximum(astray, away)
    # What cornering uses of the friction circle is missing for the drive.
    used = jnp.clip(jnp.abs(wanted) * speed**2 / (slope * available), 0.0, 1.0)
    left = jnp.sqrt(1.0 - SHARED * used**2)
    error = jnp.clip(
        coordinates[PATH_SPEED] - target,
        -FASTER * left * (1.0 - astray),
        BRAKING * left,
    )
    return jnp.stack([wanted, turn.control[1] - drive[PATH_SPEED] * error])


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

    Args:
        moved: (ξ, u) -> ξ one step later.
        start: (ξ, u).
        derivative: `by_differentiation` or `by_differences`.
        steps: of Newton's method.
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
    """Return K of the Riccati recursion; 0 where it is not finite.

    Args:
        slopes: (A, B) of one step.
        state_weights: of the first coordinates; further ones weigh nothing.
        control_weights: of u.
    """
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
