"""Feedback laws on the errors from a reference path: by hand, or from a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._recovery import (
    CREEP,
    GRIP,
    PathErrors,
    SteadyTurn,
    holding,
    moving,
    often,
    recovering,
)
from sfkd_jax.control.laws._steady_turn import (
    Linearised,
    by_differentiation,
    riccati_gain,
    steady_turn,
)
from sfkd_jax.geometry import path_step, wrap_angle
from sfkd_jax.ranges import Positive
from sfkd_jax.types import BODY, Control, Fiber, Model, Reference, Scalar, State

PROBE = 2e-3
"""Curvature of a turn that tells how much steering a curvature takes [1/m]."""
SHORTEST = 0.05
"""Lower limit of what it tells [m]."""
NEWTON = 4
"""Newton steps to a steady turn from straight driving. For the benchmark's vehicles
that reaches the accuracy of float32.
"""


FeedbackLaw: TypeAlias = Callable[[PathErrors, Scalar, Scalar], Control]
"""(path errors, curvature [1/m], reference speed [m/s]) -> control."""


def path_errors(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathErrors:
    """Return the errors relative to the circle that touches the path at `point`.

    They are exact to second order in the distance along the circle, and cheaper than
    `geometry.circle_errors`: a planner needs them thousands of times a step.

    Args:
        state: p_x, p_y, yaw, v, ….
        point: x, y, yaw, speed of the reference.
        curvature: of the path at `point` [1/m].
    """
    dx, dy = state[0] - point[0], state[1] - point[1]
    c, s = jnp.cos(point[2]), jnp.sin(point[2])
    along = c * dx + s * dy
    # The path bends away from its tangent by κ/2 · along².
    lateral = c * dy - s * dx - 0.5 * curvature * along**2
    heading = wrap_angle(state[2] - point[2] - curvature * along)
    return PathErrors(lateral, heading, state[3] - point[3])


@dataclass(frozen=True, kw_only=True)
class LinearFeedback:
    """The path-following law u = u_ff(κ) + K ξ, for small errors.

        δ = atan(L κ) − k_y e_y − k_ψ e_ψ
        a = −k_v e_v,   or the speed command v_ref − k_v e_v

    Attributes:
        wheelbase: L [m].
        lateral_gain: k_y [rad/m].
        heading_gain: k_ψ [-].
        speed_gain: k_v [1/s], or [-] with a speed loop.
        speed_loop: whether the second control is a speed command.
    """

    wheelbase: float
    lateral_gain: float = 0.03
    heading_gain: float = 0.4
    speed_gain: float = 1.0
    speed_loop: bool = False

    def __call__(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        """Return u, without any limit."""
        # Feed-forward of the bicycle without slip; feedback makes up for the rest.
        steering = (
            jnp.arctan(self.wheelbase * curvature)
            - self.lateral_gain * errors.lateral
            - self.heading_gain * errors.heading
        )
        correction = -self.speed_gain * errors.speed
        return jnp.stack(
            [steering, correction + speed if self.speed_loop else correction]
        )


@dataclass(frozen=True, kw_only=True)
class RecoveringFeedback(LinearFeedback):
    """`LinearFeedback` that comes back from anywhere, crawls, and stops.

    Near the path and from 5 m/s on it is that law, bit for bit, far from the path
    `recovering`. Below 5 m/s it steers over a time and not over a distance: K is scaled
    as if the car were that fast. Where the reference stands, it brakes to standstill
    and holds the steering.
    """

    def __call__(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        """Return u, without any limit of the actuators."""
        turn = self._turn(errors, curvature, speed)
        (ahead, base), (lateral, heading, _) = turn.control, turn.gain[0]
        steering = ahead - lateral * errors.lateral - heading * errors.heading
        linear = jnp.stack([steering, base - self.speed_gain * errors.speed])
        steering, drive = recovering(
            turn, jnp.stack(errors), linear, speed_loop=self.speed_loop
        )
        # From lock to lock and more, but at rest none.
        room = jnp.pi * moving(errors.speed + speed, speed)
        steering = jnp.clip(steering, ahead - room, ahead + room)
        return jnp.stack([steering, drive - holding(errors.speed + speed, speed)])

    def authority(self, errors: PathErrors, speed: Scalar) -> Scalar:
        """Return the share of a perturbation that acts, see `SteadyTurn`."""
        turn = self._turn(errors, jnp.zeros_like(speed), speed)
        return turn.authority(turn.state + jnp.stack(errors))

    def _turn(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> SteadyTurn:
        """The steady turn, with the gain of this pace."""
        more = often(jnp.maximum(errors.speed + speed, speed))
        # A car that stops does not turn towards its path in its last metre.
        more = jnp.where(speed > 0.0, more, 1.0)
        zero = jnp.zeros_like(speed)
        steering = more**2 * self.lateral_gain, more * self.heading_gain, zero
        gain = jnp.stack([*steering, zero, zero, zero + self.speed_gain])
        return SteadyTurn(
            jnp.stack([zero, zero, speed]),
            jnp.stack(
                [jnp.arctan(self.wheelbase * curvature), speed * self.speed_loop]
            ),
            gain.reshape(2, 3),
            jnp.asarray([self.wheelbase, GRIP]),
        )


path_feedback = RecoveringFeedback
"""(settings of `LinearFeedback`) -> law."""


def no_feedback(*, speed_loop: bool = False) -> FeedbackLaw:
    """Return the law u = 0, or the reference speed: sampling without feedback."""

    def law(errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        del errors, curvature
        zero = jnp.zeros_like(speed)
        return jnp.stack([zero, speed if speed_loop else zero])

    return law


class ModelLaw(NamedTuple):
    """A feedback law around the steady turns of a model, with its Riccati gains.

        u = u*(κ, v, e) − K(e) (ξ − ξ*(κ, v, e)),   ξ* = F(ξ*, u*; κ, e)

    F is one step of the model in coordinates along a circle of curvature κ. ξ* has no
    lateral error and the reference speed; K solves the Riccati equation of F linearised
    there, with the weights below. In side wind ξ* crabs, on a slippery road u* steers
    more: what the model knows of e becomes feed-forward, and a planner samples only the
    rest. If Newton's method does not converge (the circle is too fast for the
    friction), the law is that of straight driving, gain included. Far from the path
    it is `recovering`.

    Attributes:
        lateral: weight in the Riccati equation [1/m²].
        heading: weight [1/rad²].
        speed: weight [s²/m²]; the weights of further body states are zero.
        steering: weight [1/rad²].
        drive: weight, per control unit².
    """

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

        def step(state: State, control: Control, fiber: Fiber) -> State:
            latent = model.step(fiber, model.encode(fiber, state), control)
            return model.decode(fiber, latent)

        along = path_step(step)

        def turn(kappa: Scalar, speed: Scalar) -> Linearised:
            return steady_turn(
                lambda both: along(both[:size], both[size:], kappa, fiber),
                # Newton starts from straight driving at the reference speed.
                jnp.zeros(size + 2).at[2].set(speed),
                by_differentiation,
                steps=NEWTON,
            )

        # A car that stands has no turn: the slowest one, with which it would start.
        speeds = jnp.maximum(reference[:, 3], CREEP)
        # One point more, which tells how much steering a curvature takes.
        curvature = jnp.append(curvature, PROBE)
        both = jax.vmap(jax.vmap(turn), in_axes=(0, None))(
            # Straight driving in the same batch: what is chosen where a turn fails.
            jnp.stack([curvature, 0.0 * curvature]),
            jnp.append(speeds, speeds[0]),
        )
        wheelbase = (both.both[0, -1, size] - both.both[1, -1, size]) / PROBE
        both = jax.tree.map(lambda leaf: leaf[:, :-1], both)
        # A circle that the tyres cannot hold has no steady turn: drive straight.
        valid = both.steady[0]
        chosen = jax.tree.map(lambda part: jax.vmap(jnp.where)(valid, *part), both)
        # One gain, of the first step: it varies little over a horizon, and the Riccati
        # recursion is the most expensive part.
        gain = riccati_gain(
            chosen.slopes[0],
            (self.lateral, self.heading, self.speed),
            jnp.asarray([self.steering, self.drive]),
        )
        state, control = jnp.split(chosen.both, [size], axis=1)
        # No drive where the reference stands, or the car would creep.
        control = control.at[:, 1].multiply(reference[:, 3] != 0.0)
        state = state.at[:, 2].set(reference[:, 3])
        # NaN compares as False.
        bend = jnp.where(wheelbase > SHORTEST, wheelbase, SHORTEST)
        grip = jnp.stack([bend, jnp.asarray(GRIP)])
        return SteadyTurn(
            state,
            control,
            jnp.broadcast_to(gain, (*control.shape, size)),
            jnp.broadcast_to(grip, (*control.shape[:1], 2)),
        )

    def control(
        self,
        turn: SteadyTurn,
        state: State,
        point: Float[Array, " 4"],
        curvature: Scalar,
    ) -> tuple[Control, Scalar]:
        """Return the control at one step of the reference, and `SteadyTurn.authority`.

        Args:
            turn: steady turn of the step.
            state: in the world.
            point: x, y, yaw, speed of the reference.
            curvature: of the path at `point` [1/m].
        """
        errors = path_errors(state, point, curvature)
        xi = jnp.concatenate([jnp.stack(errors[:2]), state[BODY]])
        control = turn.feedback(xi).at[1].add(-holding(state[3], point[3]))
        return control, turn.authority(xi)
