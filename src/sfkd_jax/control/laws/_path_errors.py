"""Errors of a state relative to a reference path, and a feedback law on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import Control, Reference, Scalar, State


class PathErrors(NamedTuple):
    """Errors of a state relative to one reference point.

    Attributes:
        lateral: distance left of the path [m].
        heading: yaw relative to the path [rad].
        speed: relative to the reference [m/s].
    """

    lateral: Scalar
    heading: Scalar
    speed: Scalar


FeedbackLaw: TypeAlias = Callable[[PathErrors, Scalar, Scalar], Control]
"""(path errors, curvature [1/m], reference speed [m/s]) -> control."""


def path_errors(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathErrors:
    """Return the errors relative to the circle that touches the path at `point`.

    They are exact to second order in the distance along the circle.

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


def curvature_between(reference: Reference) -> Float[Array, " gap"]:
    """Return κ [1/m] between reference points: the change of yaw over the distance."""
    steps = jnp.diff(reference, axis=0)
    distance = jnp.hypot(steps[:, 0], steps[:, 1])
    # Points that coincide, as where a car waits, have no direction to turn from.
    moved = distance > 1e-3
    return jnp.where(
        moved, wrap_angle(steps[:, 2]) / jnp.where(moved, distance, 1.0), 0.0
    )


def reference_curvature(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] at each reference point, the mean of both sides."""
    between = curvature_between(reference)
    ends = jnp.concatenate([between[:1], between, between[-1:]])
    return 0.5 * (ends[1:] + ends[:-1])


def path_feedback(
    *,
    wheelbase: float,
    lateral_gain: float = 0.03,
    heading_gain: float = 0.4,
    speed_gain: float = 1.0,
    speed_loop: bool = False,
) -> FeedbackLaw:
    """Return the path-following law u = u_ff(κ) + K ξ.

        δ = atan(L κ) − k_y e_y − k_ψ e_ψ
        a = −k_v e_v,   or the speed command v_ref − k_v e_v

    Args:
        wheelbase: L [m].
        lateral_gain: k_y [rad/m].
        heading_gain: k_ψ [-].
        speed_gain: k_v [1/s], or [-] with a speed loop.
        speed_loop: whether the second control is a speed command.
    """

    def law(errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        # Feed-forward of the bicycle without slip; feedback makes up for the rest.
        steering = (
            jnp.arctan(wheelbase * curvature)
            - lateral_gain * errors.lateral
            - heading_gain * errors.heading
        )
        correction = -speed_gain * errors.speed
        return jnp.stack([steering, correction + speed if speed_loop else correction])

    return law


def no_feedback(*, speed_loop: bool = False) -> FeedbackLaw:
    """Return the law u = 0, or the reference speed: sampling without feedback."""

    def law(errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        del errors, curvature
        return jnp.stack(
            [jnp.zeros_like(speed), speed if speed_loop else jnp.zeros_like(speed)]
        )

    return law
