"""Poses in the plane, and path coordinates: a vehicle relative to its path.

A path state is a `State` whose pose is that of the foot point in its own frame, 0, and
whose body is ξ = (e_y [m], e_ψ [rad], v [m/s], …): distance left of the path, yaw
relative to it, and the vehicle's own body state. Its control is w = (ν, κ, v_ref): a
perturbation added to the law's control, the path's curvature [1/m] over the step, and
the reference speed [m/s].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Pose,
    Reference,
    Scalar,
    State,
    Step,
)


def wrap_angle(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the same angle in [-π, π], with gradient 1."""
    # round has derivative 0 everywhere: differences of angles stay differentiable.
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def rotate(angle: Float[Array, ""], vector: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return R(angle) vector."""
    c = jnp.cos(angle)
    s = jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def entrywise(function: Callable[..., Scalar], *vectors: Any) -> Array:
    """Return a function of the entries of vectors, one by one.

    A planner has the samples as the last axis. One operation on a vector of each of
    them and another that all share, or a number of each, would turn the arrays around.
    """
    entries = [function(*entries) for entries in zip(*vectors, strict=True)]
    return jnp.stack(jax.lax.optimization_barrier(entries))


def put(vector: Array, index: int, value: Array) -> Array:
    """Return the vector with another entry; a choice fuses where a scatter does not."""
    return jnp.where(np.arange(vector.shape[0]) == index, value, vector)


def compose(
    pose: Float[Array, " 3"], increment: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g ∘ Δ, the pose after a motion Δ in the frame of g; yaw is not wrapped."""
    position = pose[:2] + rotate(pose[2], increment[:2])
    # Unwrapped, so that the yaw of a run is continuous.
    return jnp.concatenate([position, pose[2:] + increment[2:]])


def between(
    pose: Float[Array, " 3"], pose_next: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g⁻¹ ∘ g', the motion from g to g' in the frame of g, yaw wrapped."""
    # Differences before the rotation: far from the origin float32 loses less.
    position = rotate(-pose[2], pose_next[:2] - pose[:2])
    return jnp.concatenate([position, wrap_angle(pose_next[2:] - pose[2:])])


FAR = 5e4
"""Distance from the origin up to which float32 resolves positions well enough, to 4 mm
[m].
"""
CELL = 2048.0
"""Spacing of the origins of `relative` [m]."""


Places: TypeAlias = Float[Array | np.ndarray, "..."]
"""States or points of a reference, p_x and p_y first."""


def relative(observation: Places, reference: Places) -> tuple[Places, Places, Places]:
    """Return both with positions relative to an origin near the reference, and it.

    For positions on Earth in double precision, outside `jax.jit`, which rounds its
    arguments. Nothing changes within 1 km of the origin, and for float32.
    """
    given = (observation, reference)
    if any(one.dtype.itemsize < 8 for one in given):
        return observation, reference, np.zeros(2)
    xp: Any = jnp if any(isinstance(one, jax.Array) for one in given) else np
    near = reference[..., 0, :2]
    # On a grid, or a sensor that freezes would seem to move against the reference.
    origin = CELL * xp.round(xp.where(xp.isfinite(near), near, 0.0) / CELL)
    return (
        shifted(observation, -origin),
        shifted(reference, -origin[..., None, :]),
        origin,
    )


def shifted(states: Any, by: Places) -> Any:
    """Return states at positions moved `by`; in numpy if both allow it."""
    host = isinstance(by, np.ndarray) and not isinstance(states, jax.core.Tracer)  # pyright: ignore
    xp, states = (np, np.asarray(states, by.dtype)) if host else (jnp, states)
    return xp.concatenate([states[..., :2] + by, states[..., 2:]], axis=-1)


def is_precise(observation: State, reference: Reference) -> Bool[Array, ""]:
    """Whether positions are as near to the origin as their precision needs."""
    step = jnp.asarray(0.0)
    for places in (observation, reference):
        largest = jnp.max(jnp.abs(places[..., :2]))
        # float64 reaches the same step 5e8 times farther away.
        step = jnp.maximum(step, largest * jnp.finfo(largest.dtype).eps)
    # Not `<=`: NaN is somebody else's finding.
    return ~(step > FAR * jnp.finfo(jnp.float32).eps)


PathState: TypeAlias = Float[Array, " coordinate"]
"""ξ = (e_y, e_ψ, v, …): the body of a path state."""
LATERAL, HEADING, PATH_SPEED = 0, 1, 2
"""Indices of e_y, e_ψ and v in ξ."""
PERTURBATION = slice(0, 2)
"""Entries of ν in w."""
CURVATURE, REFERENCE_SPEED = 2, 3
"""Indices of κ and v_ref in w."""
SMALLEST_SCALE = 0.2
"""Lower limit of 1 − κ e_y: below it the car is too close to the path's centre of
curvature for path coordinates to be meaningful.
"""

PathFeedback: TypeAlias = Callable[[PathState, Scalar, Scalar, Environment], Control]
"""(ξ, κ, v_ref, e) -> u, not yet clipped."""


def circle_errors(pose: Pose, curvature: Scalar) -> tuple[Scalar, Scalar]:
    """Return e_y [m] and e_ψ [rad] of a pose relative to a circle through the origin.

        q = κ (x² + y²) − 2 y,   e_y = −q / (1 + √(1 + κ q)),
        e_ψ = yaw − atan2(κ x, 1 − κ y)

    Exact, and without a singularity at κ = 0. √(1 + κ q) = 1 − κ e_y is limited from
    below to `SMALLEST_SCALE`, so that the result is always finite; see `is_valid`.

    Args:
        pose: x [m], y [m], yaw [rad] in the frame whose x axis is tangent to the circle
            at the origin.
        curvature: κ [1/m], left positive.
    """
    x = pose[0]
    y = pose[1]
    yaw = pose[2]
    q = curvature * (x**2 + y**2) - 2.0 * y
    # 1 + κ q is the squared distance to the centre in radii;
    # limited before the root, whose gradient at 0 is infinite.
    scale = jnp.sqrt(jnp.maximum(1.0 + curvature * q, SMALLEST_SCALE**2))
    turned = jnp.arctan2(curvature * x, 1.0 - curvature * y)
    # Division by at least 1 + 0.2: the conjugate form has no cancellation at κ → 0.
    return -q / (1.0 + scale), wrap_angle(yaw - turned)


def is_valid(
    lateral: Float[Array, "*shape"], curvature: Float[Array, "*shape"]
) -> Bool[Array, "*shape"]:
    """Whether path coordinates are meaningful: 1 − κ e_y > 0.2; False for NaN."""
    # A comparison with NaN is False, so that an unknown position is never valid.
    return 1.0 - curvature * lateral > SMALLEST_SCALE


def path_coordinates(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathState:
    """Return ξ of a world state, relative to the circle through a reference point.

    Args:
        state: pose and body state.
        point: x, y, yaw, speed of the reference.
        curvature: of the circle [1/m].
    """
    lateral, heading = circle_errors(between(point[POSE], state[POSE]), curvature)
    return jnp.concatenate([jnp.stack([lateral, heading]), state[BODY]])


STANDING = 1e-3
"""Distance below which two points of a reference are the same place [m]."""
SLOWEST = 0.1
"""Reference speed above which the points have to move [m/s]."""


def followable(reference: Reference) -> tuple[Reference, Bool[Array, ""]]:
    """Return a reference that a car can follow, and whether it is the given one.

    The speed is 0 where points stand still at a speed, or where the speed is negative:
    every law here drives forwards.
    """
    steps = jnp.diff(reference[:, :2], axis=0)
    still = jnp.hypot(steps[:, 0], steps[:, 1]) < STANDING
    # The first point has none before it, and moves as the next one does.
    still = jnp.concatenate([still[:1], still]) & (reference[:, 3] > SLOWEST)
    wrong = still | (reference[:, 3] < 0.0)
    speed = jnp.where(wrong, 0.0, reference[:, 3])
    return jnp.concatenate([reference[:, :3], speed[:, None]], 1), ~wrong.any()


def curvature_between(reference: Reference) -> Float[Array, " gap"]:
    """Return κ [1/m] between reference points: the change of yaw over the distance.

    Where points coincide, as where a car waits, it is that of the gap before.
    """
    steps = jnp.diff(reference, axis=0)
    distance = jnp.hypot(steps[:, 0], steps[:, 1])
    # Points that coincide have no direction to turn from.
    moved = distance > STANDING
    turned = wrap_angle(steps[:, 2])
    curvature = jnp.where(moved, turned / jnp.where(moved, distance, 1.0), 0.0)
    # A car that stops in a bend keeps its steering.
    last = jax.lax.cummax(jnp.where(moved, jnp.arange(moved.shape[0]), 0))
    return curvature[last]


def reference_curvature(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] at each reference point, the mean of both sides."""
    gaps = curvature_between(reference)
    ends = jnp.concatenate([gaps[:1], gaps, gaps[-1:]])
    return 0.5 * (ends[1:] + ends[:-1])


def curvature_ahead(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] over the step to each reference point.

    The first step begins at the vehicle, where there is no reference point: its
    curvature is extrapolated linearly from the next two.
    """
    gaps = curvature_between(reference)
    first = 2.0 * gaps[0] - gaps[min(1, gaps.shape[0] - 1)]
    return jnp.concatenate([first[None], gaps])


def path_state(coordinates: PathState) -> State:
    """Return ξ as a `State`: the pose of the foot in its own frame, 0, and body ξ."""
    return jnp.concatenate([jnp.zeros(3), coordinates])


def beside(coordinates: PathState, point: Float[Array, " 4"]) -> State:
    """Return the state beside a reference point, on the normal of the path there."""
    normal = jnp.stack([-jnp.sin(point[2]), jnp.cos(point[2])])
    position = point[:2] + coordinates[LATERAL] * normal
    yaw = point[2] + coordinates[HEADING]
    return jnp.concatenate([position, yaw[None], coordinates[PATH_SPEED:]])


def vehicle_state(coordinates: PathState) -> State:
    """Return the vehicle's state in the foot frame: pose (0, e_y, e_ψ), body s."""
    return jnp.concatenate([jnp.zeros(1), coordinates])


def path_step(
    step: Step,
) -> Callable[[PathState, Control, Scalar, Environment], PathState]:
    """Return (ξ, u, κ, e) -> ξ one period later, exact on a circle of curvature κ."""

    def along(
        coordinates: PathState, control: Control, curvature: Scalar, env: Environment
    ) -> PathState:
        after = step(vehicle_state(coordinates), control, env)
        # From the old foot point, through which the circle goes: the errors stay exact.
        lateral, heading = circle_errors(after[POSE], curvature)
        return jnp.concatenate([jnp.stack([lateral, heading]), after[BODY]])

    return along


def closed_loop(
    step: Step, law: PathFeedback, low: tuple[float, ...], high: tuple[float, ...]
) -> Step:
    """Return (path state, w, e) -> path state, the vehicle in closed loop with a law.

        ξ⁺ = F(ξ, clip(law(ξ; κ, v_ref, e) + ν); κ, e)

    Args:
        step: of the vehicle, in the world frame.
        law: (ξ, κ, v_ref, e) -> u.
        low: lower limits of the vehicle's controls.
        high: upper limits of the vehicle's controls.
    """
    along = path_step(step)
    bottom = jnp.asarray(low)
    top = jnp.asarray(high)

    def closed(state: State, inputs: Control, env: Environment) -> State:
        curvature = inputs[CURVATURE]
        wanted = law(state[BODY], curvature, inputs[REFERENCE_SPEED], env)
        # Clipped after the perturbation is added: the actuator limits their sum.
        control = jnp.clip(wanted + inputs[PERTURBATION], bottom, top)
        return path_state(along(state[BODY], control, curvature, env))

    return closed
