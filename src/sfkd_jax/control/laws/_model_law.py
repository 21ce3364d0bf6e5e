"""Steady turns and Riccati gains: of a model while planning, or of any step.

One derivation serves both laws, `ModelLaw` and `PathLaw`: Newton's method finds the
steady turn, the Riccati recursion the gain around it. Only the derivative differs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._path_errors import path_errors
from sfkd_jax.ranges import Positive
from sfkd_jax.types import BODY, Control, Fiber, Model, Reference, Scalar, State

NEWTON = 4
"""Newton steps to a steady turn from straight driving. For the benchmark's vehicles
that reaches the accuracy of float32.
"""
RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control."""

Derivative: TypeAlias = Callable[[Callable[[Array], Array], Array], tuple[Array, Array]]
"""(function, point) -> (value, Jacobian)."""


class SteadyTurn(NamedTuple):
    """Steady driving along a circle, and the feedback gain around it.

    Attributes:
        state: path coordinates ξ* = (distance left of the path, yaw relative to it,
            body state).
        control: u*.
        gain: K.
    """

    state: Float[Array, "*step coordinate"]
    control: Float[Array, "*step control"]
    gain: Float[Array, "*step control coordinate"]


class Linearised(NamedTuple):
    """A step around ξ and u: its matrices, and how far ξ moves.

    Attributes:
        both: (ξ, u).
        slopes: (A, B).
        residual: largest |ξ⁺ − ξ| of an entry.
    """

    both: Float[Array, "*turn both"]
    slopes: Float[Array, "*turn coordinate both"]
    residual: Float[Array, "*turn"]

    def is_steady(self) -> Bool[Array, "*turn"]:
        """Whether Newton's method has found a steady turn; False for NaN."""
        finite = jnp.all(jnp.isfinite(self.both), axis=-1)
        # A NaN residual compares as False, so that a diverged turn is never steady.
        return finite & (self.residual < RESIDUAL_TOLERANCE)


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
        return better, Linearised(both, slopes, jnp.max(jnp.abs(gap)))

    nothing = Linearised(start, jnp.zeros((size, size + 2)), jnp.zeros(()))
    # The loop holds the only copy of the step and its derivative, which take long to
    # compile; its last pass evaluates them where the others have led.
    return jax.lax.fori_loop(0, steps + 1, newton, (start[free], nothing))[1]


def riccati_gain(
    slopes: Float[Array, "coordinate both"],
    Q: Float[Array, "coordinate coordinate"],
    R: Float[Array, "2 2"],
) -> Float[Array, "2 coordinate"]:
    """Return K of the Riccati recursion; 0 where it is not finite.

    Args:
        slopes: (A, B) of one step.
        Q: weights of ξ.
        R: weights of u.
    """
    A, B = jnp.split(slopes, [slopes.shape[0]], axis=1)

    def best(value: Array) -> Array:
        # R > 0 keeps the matrix invertible, also where a control has no effect.
        return solve(R + B.T @ value @ B, B.T @ value @ A)

    def before(_: Any, value: Array) -> Array:
        return Q + A.T @ value @ (A - B @ best(value))

    gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, Q))
    # Without a gain the law is its feed-forward alone, which is finite.
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def weights_of(size: int, *entries: float) -> Float[Array, "size size"]:
    """Return the diagonal matrix of the first entries; further ones weigh nothing."""
    return jnp.diag(jnp.zeros(size).at[: len(entries)].set(jnp.asarray(entries)))


class ModelLaw(NamedTuple):
    """A feedback law around the steady turns of a model, with its Riccati gains.

        u = u*(κ, v, e) − K(e) (ξ − ξ*(κ, v, e)),   ξ* = F(ξ*, u*; κ, e)

    F is one step of the model in coordinates along a circle of curvature κ. ξ* has no
    lateral error and the reference speed; K solves the Riccati equation of F linearised
    there, with the weights below. In side wind ξ* crabs, on a slippery road u* steers
    more: what the model knows of e becomes feed-forward, and a planner samples only the
    rest. If Newton's method does not converge (the circle is too fast for the
    friction), the law is that of straight driving, gain included.

    Attributes:
        dt: sampling period [s].
        lateral: weight in the Riccati equation [1/m²].
        heading: weight [1/rad²].
        speed: weight [s²/m²]; the weights of further body states are zero.
        steering: weight [1/rad²].
        drive: weight, per control unit².
    """

    dt: float
    lateral: float = 1.0
    heading: float = 1.0
    speed: float = 1.0
    steering: Positive = 20.0
    drive: Positive = 0.5

    def prepare(
        self,
        model: Model,
        fiber: Fiber,
        like: State,
        reference: Reference,
        curvature: Array,
    ) -> SteadyTurn:
        """Return the steady turns at every point of a reference.

        Args:
            model: any model of world states.
            fiber: of the environment.
            like: a state, for its size.
            reference: x, y, yaw, speed of each step.
            curvature: of the path at each point [1/m].
        """
        size = like.shape[0] - 1
        step = _along_circle(model, fiber, like.shape[0], self.dt)

        def turn(kappa: Scalar, speed: Scalar) -> Linearised:
            return steady_turn(
                lambda both: step(both[:size], both[size:], kappa, speed),
                # Newton starts from straight driving at the reference speed.
                jnp.zeros(size + 2).at[2].set(speed),
                by_differentiation,
                steps=NEWTON,
            )

        both = jax.vmap(jax.vmap(turn), in_axes=(0, None))(
            # Straight driving in the same batch: what is chosen where a turn fails.
            jnp.stack([curvature, 0.0 * curvature]),
            reference[:, 3],
        )
        # A circle that the tyres cannot hold has no steady turn: drive straight.
        valid = both.is_steady()[0]
        chosen = jax.tree.map(lambda part: jax.vmap(jnp.where)(valid, *part), both)
        # One gain, of the first step: it varies little over a horizon, and the Riccati
        # recursion is the most expensive part.
        gain = riccati_gain(
            chosen.slopes[0],
            weights_of(size, self.lateral, self.heading, self.speed),
            weights_of(2, self.steering, self.drive),
        )
        state, control = jnp.split(chosen.both, [size], axis=1)
        return SteadyTurn(
            state, control, jnp.broadcast_to(gain, (*control.shape, size))
        )

    def control(
        self,
        turn: SteadyTurn,
        state: State,
        point: Float[Array, " 4"],
        curvature: Scalar,
    ) -> Control:
        """Return the control at one step of the reference.

        Args:
            turn: steady turn of the step.
            state: in the world.
            point: x, y, yaw, speed of the reference.
            curvature: of the path at `point` [1/m].
        """
        errors = path_errors(state, point, curvature)
        now = jnp.concatenate(
            [jnp.stack([errors.lateral, errors.heading]), state[BODY]]
        )
        # Relative to ξ*, not to 0: in side wind a car on its path has a heading error.
        return turn.control - turn.gain @ (now - turn.state)


def _along_circle(model: Model, fiber: Fiber, size: int, dt: float) -> Any:
    """(ξ, u, κ, speed) -> ξ one step later, relative to the point speed · dt ahead."""

    def step(along: Array, control: Control, kappa: Scalar, speed: Scalar) -> Array:
        state = (
            jnp.zeros(size)
            .at[1]
            .set(along[0])
            .at[2]
            .set(along[1])
            .at[BODY]
            .set(along[2:])
        )
        after = model.decode(
            fiber, model.step(fiber, model.encode(fiber, state), control)
        )
        turned = kappa * speed * dt
        half = 0.5 * turned
        # The chord of the arc; sin(h)/h by its series, so that κ = 0 is not special.
        chord = speed * dt * (1.0 - half**2 / 6.0 + half**4 / 120.0)
        point = jnp.stack([chord * jnp.cos(half), chord * jnp.sin(half), turned, speed])
        errors = path_errors(after, point, kappa)
        return jnp.concatenate(
            [jnp.stack([errors.lateral, errors.heading]), after[BODY]]
        )

    return step


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
