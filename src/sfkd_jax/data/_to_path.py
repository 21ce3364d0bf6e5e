"""Convert drives from world coordinates to path coordinates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.geometry import PathFeedback, is_valid, path_state, wrap_angle
from sfkd_jax.scenarios import Path, path_through, point_at, project
from sfkd_jax.types import BODY, Scalar, State, Trajectory

TIGHTEST = 0.2
"""Largest plausible curvature of a path that was logged as positions [1/m]."""


def to_path(
    driven: Trajectory, path: Path, law: PathFeedback, speeds: Float[Array, " time"]
) -> Trajectory:
    """Return one drive as path states ξ_k and w_k = (u_k − law(ξ_k; …), κ_k, v_k).

    Each state is projected onto the path by Newton steps from the foot point of the
    state before, the first one from the nearest sample of the path. κ_k is the turn of
    the path between two foot points over their distance.

    Args:
        driven: states (T + 1, state) in the world, the controls that were applied,
            environments.
        path: that the drive followed.
        law: (ξ, κ, v_ref, e) -> u, not clipped.
        speeds: v_ref [m/s], (T,).
    """
    progress, laterals = _feet(path, driven.states)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, progress)
    headings = wrap_angle(driven.states[:, 2] - points[:, 2])
    coordinates = jnp.column_stack([laterals, headings, driven.states[:, BODY]])
    along = jnp.diff(progress)
    moved = jnp.abs(along) > 1e-2
    turned = wrap_angle(jnp.diff(points[:, 2]))
    curvatures = jnp.where(moved, turned / jnp.where(moved, along, 1.0), points[:-1, 3])
    feedback = jax.vmap(law)(coordinates[:-1], curvatures, speeds, driven.envs)
    inputs = jnp.column_stack([driven.controls - feedback, curvatures, speeds])
    return Trajectory(jax.vmap(path_state)(coordinates), inputs, driven.envs)


def logged_path(positions: Float[Array, "point 2"], *, spacing: float = 0.5) -> Path:
    """Return the path through logged positions, its curvature estimated and checked.

    Raises:
        ValueError: a path too short, positions that coincide, or an implausible
            curvature.
    """
    path = path_through(positions, spacing=spacing)
    largest = float(jnp.max(jnp.abs(path.points[:, 3])))
    if not largest <= TIGHTEST:
        raise ValueError(
            f"the curvature of the logged path reaches {largest:.3g} 1/m, a car "
            f"follows {TIGHTEST}: its positions are too noisy or too sparse; "
            "smooth them"
        )
    return path


def check_on_path(trajectories: Trajectory) -> None:
    """Refuse drives that left their path.

    Raises:
        ValueError: the number of drives with 1 − κ e_y ≤ 0.2 or states that are not
            finite.
    """
    valid = _stays_on_path(trajectories)
    if not bool(jnp.all(valid)):
        raise ValueError(
            f"{int(jnp.sum(~valid))} of {valid.size} drives left their path "
            "(1 - kappa e_y <= 0.2): dataset.law does not stabilise the car"
        )


def check_logged(trajectories: Trajectory, names: tuple[str, ...]) -> None:
    """Refuse drives whose path coordinates are invalid, by name.

    Raises:
        ValueError: the first drive with 1 − κ e_y ≤ 0.2 or states that are not finite.
    """
    for name, valid in zip(names, _stays_on_path(trajectories).tolist(), strict=True):
        if not valid:
            raise ValueError(
                f"{name}: 1 - kappa e_y falls to 0.2 or below, or the path is lost: "
                "is it the one followed?"
            )


def _stays_on_path(trajectories: Trajectory) -> Bool[Array, " drive"]:
    """Whether path coordinates are valid and finite throughout."""
    lateral = trajectories.states[..., :-1, BODY.start]
    valid = is_valid(lateral, trajectories.controls[..., 2])
    finite = jnp.isfinite(trajectories.states)
    return jnp.all(valid, axis=-1) & jnp.all(finite, axis=(-2, -1))


def _feet(
    path: Path, states: Float[Array, "time state"]
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Arc length and signed distance of every state along a drive."""

    def follow(
        carry: tuple[Scalar, State], state: State
    ) -> tuple[tuple[Scalar, State], tuple[Scalar, Scalar]]:
        s, before = carry
        ahead = jnp.hypot(state[0] - before[0], state[1] - before[1])
        s, lateral = project(path, state[:2], s + ahead)
        return (s, state), (s, lateral)

    nearest = jnp.argmin(jnp.hypot(*(path.points[:, :2] - states[0, :2]).T))
    _, feet = jax.lax.scan(follow, (nearest * path.spacing, states[0]), states)
    return feet
