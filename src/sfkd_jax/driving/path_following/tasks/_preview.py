"""What a controller along a path sees of the road ahead."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    curvature_ahead,
    lengths_along,
)
from sfkd_jax.geometry import compose, wrap_angle
from sfkd_jax.types import POSE, Reference, Scalar, State

YAW = 2
"""Column of the yaw in the points of a reference."""


class Preview(NamedTuple):
    """The road ahead, as controllers along a path see it.

    Attributes:
        road: κ [1/m] and v_ref [m/s] of the next steps; NaN if the reference is not
            finite.
        along: distance along the path from the first point of the reference to the
            observed position [m]; behind a `Gate`, to where the vehicle is believed.
        observation: in the world, as it came.
        reference: in the world, as it came.
        sent: the last commands that may still act, newest last; NaN before the first
            one.
        later: periods by which commands act later than stated, see `CommandDelay`.
        repeated: whether the observation is bit for bit the last one, like that of a
            sensor that froze.
        measured: which entries of ξ are measured; behind a `Gate` the others are
            predicted.
        on_time: whether the last call was one period ago.
        reason: CERTIFIED if nothing in the inputs speaks against a claim, else the
            first `Reason` that does, see `Gate`.
    """

    road: Float[Array, "horizon 2"]
    along: Scalar
    observation: State
    reference: Reference
    sent: Float[Array, "step control"]
    later: Scalar
    repeated: Bool[Array, ""]
    measured: Bool[Array, " coordinate"]
    on_time: Bool[Array, ""]
    reason: Int[Array, ""]


def later(
    rows: Float[Array, "step column"],
    periods: Scalar | float,
    count: int,
    *,
    angle: int | None = None,
) -> Float[Array, "later column"]:
    """Return rows of a reference or a preview from some periods later on.

    Between two rows they are interpolated linearly. The last row stands for those after
    it.

    Args:
        rows: one a period.
        periods: by how many.
        count: of the rows that are returned.
        angle: column of an angle [rad], which may jump by 2π; None without one.
    """
    last = len(rows) - 1
    times = jnp.minimum(jnp.arange(count) + periods, last)
    before = jnp.floor(times).astype(int)
    first = rows[before]
    gap = rows[jnp.minimum(before + 1, last)] - first
    if angle is not None:
        gap = gap.at[:, angle].set(wrap_angle(gap[:, angle]))
    return first + (times - before)[:, None] * gap


def state_beside(xi: PathState, preview: Preview) -> State:
    """Return the state in the world of a vehicle at ξ, beside the reference."""
    points = preview.reference
    way = lengths_along(points)
    end = jnp.clip(jnp.sum(way < preview.along), 0, len(points) - 1)
    curvature = curvature_ahead(points)[end]
    along = preview.along - way[end]
    left = xi[LATERAL] + 0.5 * curvature * along**2
    motion = jnp.stack([along, left, xi[HEADING] + curvature * along])
    pose = compose(points[end, POSE], motion)
    return jnp.concatenate([pose, xi[PATH_SPEED:]])


def road_from(preview: Preview, along: Scalar) -> Float[Array, "horizon 2"]:
    """Return κ and v_ref of the next steps of a vehicle at a place of the path.

    A reference begins one step ahead of where it expects the vehicle. A vehicle that is
    further ahead, or behind, is shown the curvature from there on, and beyond the ends
    of the reference that of the end. The speeds are those of the next steps wherever it
    is, since a reference says when to stop and when to start.

    Args:
        preview: with the road from where the reference expects the vehicle.
        along: of the vehicle, see `Preview`; NaN if it is not known.
    """
    way = lengths_along(preview.reference)
    ahead = jnp.nan_to_num(along + way[1])
    curvature = preview.road[:, 0]
    moved = jnp.interp(way + ahead, way, curvature)
    # A reference that is not finite has no lengths.
    moved = jnp.where(jnp.isfinite(way).all(), moved, curvature)
    return jnp.stack([moved, preview.road[:, 1]], axis=1)


def check_preview(xi: Any, env: Any, preview: Any, horizon: int) -> None:
    """Raise a ValueError if there is no preview of this horizon."""
    if not isinstance(preview, Preview):
        raise ValueError(
            "a planner along a path takes ξ and a `Preview`; "
            "`along_reference` makes them of poses in the world"
        )
    if preview.road.shape != (horizon, 2):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; "
            f"got {preview.road.shape[0]} steps"
        )
