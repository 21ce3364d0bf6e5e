"""Path coordinates: a vehicle relative to its path.

A path state describes a vehicle in the frame of its foot point, the nearest point of
the path. It is a `State` whose pose is (0, 0, 0) and whose body is
ξ = (e_y [m], e_ψ [rad], v [m/s], …): the distance left of the path, the yaw relative to
the path, and the body state of the vehicle. The control that belongs to it is
w = (ν, κ, v_ref): a perturbation that is added to the control of the law, the curvature
of the path [1/m] over the step, and the reference speed [m/s].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.geometry import between, wrap_angle
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Frame,
    Pose,
    Reference,
    Scalar,
    State,
    Step,
)

PathState: TypeAlias = Float[Array, " coordinate"]
"""ξ = (e_y, e_ψ, v, …): the body of a path state."""
LATERAL = 0
"""Index of e_y in ξ."""
HEADING = 1
"""Index of e_ψ in ξ."""
PATH_SPEED = 2
"""Index of v in ξ."""
PERTURBATION = slice(0, 2)
"""Entries of ν in w."""
CURVATURE = 2
"""Index of κ in w."""
REFERENCE_SPEED = 3
"""Index of v_ref in w."""
SMALLEST_SCALE = 0.2
"""Lower limit of 1 − κ e_y. Below it the car is so close to the path's centre of
curvature that path coordinates are not meaningful.
"""


def _at_reference_speed(inputs: Control, size: int) -> PathState:
    """Return ξ of a vehicle on its path, at the reference speed."""
    return jnp.zeros(size).at[PATH_SPEED].set(inputs[1])


PATH_FRAME = Frame(
    name="path",
    has_pose=False,
    outputs={"position": slice(3, 4), "yaw": slice(4, 5), "body": slice(5, None)},
    units={"position": "m", "yaw": "rad", "body": ""},
    angles=(4,),
    # Body rates and steering move the car along a path only in later steps.
    lengths=(1.0, 1.0, 5.0, 1.0, 5.0),
    length=0.05,
    distances=(0, 1, 3),
    inputs=2,
    following=_at_reference_speed,
)
"""Path coordinates: the body state is ξ, and the inputs are ρ = (κ [1/m], v_ref [m/s]).
The outputs "position" and "yaw" are e_y and e_ψ.
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
    # 1 + κ q is the squared distance to the centre of the circle, in radii. It is
    # limited before the root is taken, because the root has an infinite gradient at 0.
    scale = jnp.sqrt(jnp.maximum(1.0 + curvature * q, SMALLEST_SCALE**2))
    circle_yaw = jnp.arctan2(curvature * x, 1.0 - curvature * y)
    # (1 − √(1 + κ q)) / κ would cancel at κ → 0. Its conjugate form does not, and its
    # denominator is at least 1.2.
    return -q / (1.0 + scale), wrap_angle(yaw - circle_yaw)


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


def projected(
    state: State,
    points: Float[Array, "point 4"],
    curvature: Float[Array, " point"],
) -> tuple[PathState, Scalar]:
    """Return ξ of a world state relative to a path, and its place on it [m].

    The path is a circle up to each of its points. The vehicle is beside the circle that
    ends at the first point which it has not passed. The place is counted from the first
    point, and is negative before it.

    Args:
        state: pose and body state.
        points: x, y, yaw, speed of the reference.
        curvature: up to each point, see `curvature_ahead` [1/m].
    """
    end, along = place_on(state[:2], points, curvature)
    return path_coordinates(state, points[end], curvature[end]), along


def place_on(
    position: Float[Array, " 2"],
    points: Float[Array, "point 4"],
    curvature: Float[Array, " point"],
) -> tuple[Int[Array, ""], Scalar]:
    """Return the first point that a position has not passed, and its place [m].

    The arguments are those of `projected`.
    """
    pose = jnp.append(position, 0.0)
    beside_points = jax.vmap(between, in_axes=(0, None))(points[:, POSE], pose)
    passed = jnp.sum(jnp.cumprod(beside_points[:, 0] > 0.0))
    end = jnp.minimum(passed, len(points) - 1)
    # Beside a bend the same angle is a longer way outside, and a shorter one inside.
    scale = 1.0 - curvature[end] * beside_points[end, 1]
    ahead = beside_points[end, 0] / jnp.maximum(scale, SMALLEST_SCALE)
    return end, lengths_along(points)[end] + ahead


def lengths_along(points: Float[Array, "point 4"]) -> Float[Array, " point"]:
    """Return the distance of every point of a path from the first one [m]."""
    steps = jnp.diff(points[:, :2], axis=0)
    return jnp.append(0.0, jnp.cumsum(jnp.hypot(steps[:, 0], steps[:, 1])))


STANDING = 1e-3
"""Distance below which two points of a reference count as the same place [m]."""
SLOWEST = 0.1
"""Reference speed above which consecutive points must be different places [m/s]."""


def followable(reference: Reference) -> tuple[Reference, Bool[Array, ""]]:
    """Return a reference that a car can follow, and whether nothing had to change.

    The speed of a point is set to 0 if the point stands still although it has a speed,
    or if its speed is negative, since every law here drives forwards.
    """
    steps = jnp.diff(reference[:, :2], axis=0)
    still = jnp.hypot(steps[:, 0], steps[:, 1]) < STANDING
    # No point comes before the first one: it counts as moving if the next one moves.
    still = jnp.concatenate([still[:1], still]) & (reference[:, 3] > SLOWEST)
    wrong = still | (reference[:, 3] < 0.0)
    speed = jnp.where(wrong, 0.0, reference[:, 3])
    return jnp.concatenate([reference[:, :3], speed[:, None]], 1), ~wrong.any()


def curvature_between(reference: Reference) -> Float[Array, " gap"]:
    """Return κ [1/m] between reference points: the change of yaw over the distance.

    Where points coincide, as where a car waits, κ is that of the last gap before at
    which they do not.
    """
    steps = jnp.diff(reference, axis=0)
    distance = jnp.hypot(steps[:, 0], steps[:, 1])
    # Points that coincide have no direction to turn from.
    moved = distance > STANDING
    yaw_change = wrap_angle(steps[:, 2])
    curvature = jnp.where(moved, yaw_change / jnp.where(moved, distance, 1.0), 0.0)
    # A car that stops in a bend keeps its steering.
    last_moved = jax.lax.cummax(jnp.where(moved, jnp.arange(moved.shape[0]), 0))
    return curvature[last_moved]


def reference_curvature(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] at each reference point: the mean of the gaps on both sides."""
    gaps = curvature_between(reference)
    ends = jnp.concatenate([gaps[:1], gaps, gaps[-1:]])
    return 0.5 * (ends[1:] + ends[:-1])


def curvature_ahead(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] over the step that ends at each reference point.

    The first step begins at the vehicle, where there is no reference point. Its
    curvature is extrapolated linearly from those of the next two steps.
    """
    gaps = curvature_between(reference)
    first = 2.0 * gaps[0] - gaps[min(1, gaps.shape[0] - 1)]
    return jnp.concatenate([first[None], gaps])


def beside(coordinates: PathState, point: Float[Array, " 4"]) -> State:
    """Return the state beside a reference point, on the normal of the path there."""
    normal = jnp.stack([-jnp.sin(point[2]), jnp.cos(point[2])])
    position = point[:2] + coordinates[LATERAL] * normal
    yaw = point[2] + coordinates[HEADING]
    return jnp.concatenate([position, yaw[None], coordinates[PATH_SPEED:]])


def vehicle_state(coordinates: PathState) -> State:
    """Return the vehicle's state in the frame of the foot point.

    Its pose is (0, e_y, e_ψ), its body is the vehicle's body state.
    """
    return jnp.concatenate([jnp.zeros(1), coordinates])


def path_step(
    step: Step,
) -> Callable[[PathState, Control, Scalar, Environment], PathState]:
    """Return the step of a vehicle in path coordinates, (ξ, u, κ, e) -> ξ⁺.

    It is exact if the path is a circle of curvature κ during the sampling period.

    Args:
        step: of the vehicle in the world frame, (x, u, e) -> x⁺.
    """

    def along(
        coordinates: PathState, control: Control, curvature: Scalar, env: Environment
    ) -> PathState:
        after = step(vehicle_state(coordinates), control, env)
        # The new pose is in the frame of the old foot point, and the circle passes
        # through that point: the errors are exact.
        lateral, heading = circle_errors(after[POSE], curvature)
        return jnp.concatenate([jnp.stack([lateral, heading]), after[BODY]])

    return along
