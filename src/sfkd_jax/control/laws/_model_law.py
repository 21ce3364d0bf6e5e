"""A path-following law from a model: its steady turn and its Riccati gains."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._path_errors import path_errors
from sfkd_jax.ranges import Positive
from sfkd_jax.types import BODY, Control, Fiber, Model, Reference, Scalar, State

NEWTON = 4
"""Newton steps to the steady turn from straight driving. For the benchmark's vehicles
that reaches the accuracy of float32.
"""
RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""


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
        speeds = reference[:, 3]
        step = _along_circle(model, fiber, like.shape[0], self.dt)
        steady = functools.partial(_steady, step, like.shape[0] - 1)
        both = jax.vmap(jax.vmap(steady), in_axes=(0, None))(
            jnp.stack([curvature, 0.0 * curvature]), speeds
        )
        valid = _is_valid(jax.tree.map(lambda part: part[0], both))
        chosen = jax.tree.map(lambda part: jax.vmap(jnp.where)(valid, *part), both)
        # One gain, of the first step: it varies little over a horizon, and the Riccati
        # recursion is the most expensive part.
        gain = self._gain(chosen.A[0], chosen.B[0])
        return SteadyTurn(
            chosen.state,
            chosen.control,
            jnp.broadcast_to(gain, (*chosen.control.shape, gain.shape[1])),
        )

    def _gain(self, A: Array, B: Array) -> Array:
        """K by the Riccati recursion."""
        Q = jnp.diag(
            jnp.zeros(A.shape[0])
            .at[:3]
            .set(jnp.asarray([self.lateral, self.heading, self.speed]))
        )
        R = jnp.diag(jnp.asarray([self.steering, self.drive]))

        def best(value: Array) -> Array:
            return solve(R + B.T @ value @ B, B.T @ value @ A)

        def before(_: Any, value: Array) -> Array:
            closed = A - B @ best(value)
            return Q + A.T @ value @ closed

        gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, Q))
        return jnp.where(jnp.isfinite(gain), gain, 0.0)

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


class _Linear(NamedTuple):
    """A step of the model around a state: its matrices, and how far it moves."""

    state: Array
    control: Control
    A: Array
    B: Array
    residual: Scalar


def _is_valid(turn: _Linear) -> Array:
    """Whether Newton's method has found a steady turn."""
    finite = jnp.isfinite(jnp.concatenate([turn.state, turn.control], axis=1))
    return jnp.all(finite, axis=1) & (turn.residual < RESIDUAL_TOLERANCE)


def _steady(step: Any, coordinates: int, kappa: Scalar, speed: Scalar) -> _Linear:
    """ξ* and u* by Newton's method, and the model around them.

    The unknowns are the relative yaw, the body state without v, and u. The loop holds
    the only copy of the model and its derivative, which take long to compile; its last
    pass evaluates them where the others have led.
    """
    free = jnp.asarray([1, *range(3, coordinates)])

    def moved(state: Array, control: Control) -> tuple[Array, Array]:
        after = step(state, control, kappa, speed)
        return after, after

    def newton(_: Any, carry: tuple[Array, _Linear]) -> tuple[Array, _Linear]:
        unknown, _ = carry
        state = jnp.zeros(coordinates).at[2].set(speed).at[free].set(unknown[:-2])
        control = unknown[-2:]
        (A, B), after = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)(state, control)
        gap = after - state
        matrix = jnp.concatenate([(A - jnp.eye(coordinates))[:, free], B], axis=1)
        better = unknown - solve(matrix, gap[:, None])[:, 0]
        return better, _Linear(state, control, A, B, jnp.max(jnp.abs(gap)))

    start = jnp.zeros(coordinates)
    nothing = _Linear(
        state=start,
        control=jnp.zeros(2),
        A=jnp.zeros((coordinates, coordinates)),
        B=jnp.zeros((coordinates, 2)),
        residual=jnp.zeros(()),
    )
    return jax.lax.fori_loop(0, NEWTON + 1, newton, (start, nothing))[1]


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
