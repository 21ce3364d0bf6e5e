"""A path-following law from a model: its steady turn and its Riccati gains."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._path_errors import path_errors
from sfkd_jax.core.ranges import Positive
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
        turn = jax.vmap(
            lambda kappa, speed: _steady(step, like.shape[0] - 1, kappa, speed)
        )
        both = turn(
            jnp.stack([curvature, 0.0 * curvature]).ravel(), jnp.tile(speeds, 2)
        )
        states, controls, residuals = (jnp.stack(jnp.split(part, 2)) for part in both)
        finite = jnp.all(
            jnp.isfinite(jnp.concatenate([states[0], controls[0]], axis=1)), axis=1
        )
        valid = finite & (residuals[0] < RESIDUAL_TOLERANCE)
        states, controls = (
            jnp.where(valid[:, None], part[0], part[1]) for part in (states, controls)
        )
        at = jnp.where(valid, curvature, 0.0)
        # One gain, of the first step: it varies little over a horizon, and the Riccati
        # recursion is the most expensive part.
        gain = self._gain(step, states[0], controls[0], at[0], speeds[0])
        return SteadyTurn(
            states, controls, jnp.broadcast_to(gain, (*controls.shape, states.shape[1]))
        )

    def _gain(
        self, step: Any, state: Array, control: Control, kappa: Scalar, speed: Scalar
    ) -> Array:
        """K by the Riccati recursion."""
        A, B = jax.jacfwd(step, argnums=(0, 1))(state, control, kappa, speed)
        Q = jnp.diag(
            jnp.zeros(state.shape[0])
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


def _steady(
    step: Any, coordinates: int, kappa: Scalar, speed: Scalar
) -> tuple[Array, Control, Scalar]:
    """ξ* and u* by Newton's method, and the residual.

    The unknowns are the relative yaw, the body state without v, and u.
    """

    def unpack(unknown: Array) -> tuple[Array, Array]:
        state = (
            jnp.zeros(coordinates)
            .at[1]
            .set(unknown[0])
            .at[2]
            .set(speed)
            .at[3:]
            .set(unknown[1:-2])
        )
        return state, unknown[-2:]

    def residual(unknown: Array) -> Array:
        state, control = unpack(unknown)
        return step(state, control, kappa, speed) - state

    def newton(_: Any, unknown: Array) -> Array:
        return (
            unknown
            - solve(jax.jacfwd(residual)(unknown), residual(unknown)[:, None])[:, 0]
        )

    unknown = jax.lax.fori_loop(0, NEWTON, newton, jnp.zeros(coordinates))
    return *unpack(unknown), jnp.max(jnp.abs(residual(unknown)))


def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Return matrix⁻¹ right by Gaussian elimination with pivoting; for few unknowns.

    `jnp.linalg.solve` calls LAPACK, and XLA takes tens of seconds to compile a program
    with several such calls inside maps.
    """
    size = matrix.shape[0]
    rows = jnp.concatenate([matrix, right], axis=1)
    for column in range(size):
        pivot = column + jnp.argmax(jnp.abs(rows[column:, column]))
        order = jnp.arange(size).at[column].set(pivot).at[pivot].set(column)
        rows = rows[order]
        lead = rows[column] / rows[column, column]
        rows = (rows - rows[:, column : column + 1] * lead).at[column].set(lead)
    return rows[:, size:]
