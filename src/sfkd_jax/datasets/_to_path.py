"""Drives in the world as drives in path coordinates: what was logged, seen from the path that was followed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.path_frame import PathFeedback, is_valid, path_state
from sfkd_jax.core.se2 import wrap_angle
from sfkd_jax.scenarios import Path, path_through, point_at, project
from sfkd_jax.types import BODY, Scalar, State, Trajectory

TIGHTEST = 0.2
"""Largest curvature of a path that was only logged as positions [1/m]: beyond, the
positions are noise.
"""


def to_path(
    driven: Trajectory, path: Path, law: PathFeedback, speeds: Float[Array, " time"]
) -> Trajectory:
    """One drive as path states ξ_0 … ξ_T and w_k = (u_k − law(ξ_k; κ_k, v_k, e_k), κ_k, v_k).

    Each state is projected on the path by Newton steps from the foot before it, so the
    first one must lie within a few metres of the path's start or the drive must begin
    there. κ_k is the turn of the path between two feet over their distance, which is
    what a step on a circle of that curvature sees.

    Args:
        driven: states (T + 1, state) in the world, the controls that were applied,
            environments.
        path: that was followed.
        law: (ξ, κ, v_ref, e) -> u, not clipped.
        speeds: v_ref [m/s], (T,).
    """
    places, laterals = _feet(path, driven.states)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, places)
    headings = wrap_angle(driven.states[:, 2] - points[:, 2])
    coordinates = jnp.column_stack([laterals, headings, driven.states[:, BODY]])
    along = jnp.diff(places)
    moved = jnp.abs(along) > 1e-2
    turned = wrap_angle(jnp.diff(points[:, 2]))
    curvatures = jnp.where(moved, turned / jnp.where(moved, along, 1.0), points[:-1, 3])
    asked = jax.vmap(law)(coordinates[:-1], curvatures, speeds, driven.envs)
    inputs = jnp.column_stack([driven.controls - asked, curvatures, speeds])
    return Trajectory(jax.vmap(path_state)(coordinates), inputs, driven.envs)


def logged_path(positions: Float[Array, "point 2"], *, spacing: float = 0.5) -> Path:
    """The path that a log names by its positions alone, its curvature estimated and checked.

    Raises:
        ValueError: a path too short, positions that coincide, or a curvature that no
            car follows.
    """
    path = path_through(positions, spacing=spacing)
    largest = float(jnp.max(jnp.abs(path.points[:, 3])))
    if not largest <= TIGHTEST:
        raise ValueError(
            f"the curvature of the logged path reaches {largest:.3g} 1/m, a car follows {TIGHTEST}: its positions are "
            "too noisy or too far apart; smooth them"
        )
    return path


def check_logged(trajectories: Trajectory, names: tuple[str, ...]) -> None:
    """Refuse drives whose path coordinates mean nothing, by name.

    Raises:
        ValueError: the first drive that came too near to the path's centre of
            curvature, or is not finite.
    """
    lateral, curvature = (
        trajectories.states[:, :-1, BODY.start],
        trajectories.controls[..., 2],
    )
    sound = jnp.all(is_valid(lateral, curvature), axis=1) & jnp.all(
        jnp.isfinite(trajectories.states), axis=(1, 2)
    )
    for name, good in zip(names, sound.tolist(), strict=True):
        if not good:
            raise ValueError(
                f"{name}: 1 - kappa e_y falls to 0.2 or below, or the path is lost: is it the one followed?"
            )


def _feet(
    path: Path, states: Float[Array, "time state"]
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Arc length and signed distance of every state, each searched from the one before plus the way driven."""

    def follow(
        carry: tuple[Scalar, State], state: State
    ) -> tuple[tuple[Scalar, State], tuple[Scalar, Scalar]]:
        place, before = carry
        ahead = jnp.hypot(state[0] - before[0], state[1] - before[1])
        place, lateral = project(path, state[:2], place + ahead)
        return (place, state), (place, lateral)

    nearest = jnp.argmin(jnp.hypot(*(path.points[:, :2] - states[0, :2]).T))
    _, found = jax.lax.scan(follow, (nearest * path.spacing, states[0]), states)
    return found
