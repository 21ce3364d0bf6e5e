"""Predictions of any `Model` along a trajectory: rollouts and one-step defects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.path_frame import HEADING, LATERAL, PATH_SPEED
from sfkd_jax.core.se2 import between, wrap_angle
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Fiber,
    Latent,
    Model,
    Params,
    State,
    Trajectory,
)


def fibers_along(
    model: Model, params: Params, trajectory: Trajectory
) -> tuple[Fiber, Fiber]:
    """Return the fibers of e_0 … e_{T-1} and of e_1 … e_{T-1}, e_{T-1}."""
    fibers = jax.vmap(model.fiber, in_axes=(None, 0))(params, trajectory.envs)
    later = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), fibers)
    return fibers, later


def rollout(
    model: Model, params: Params, trajectory: Trajectory
) -> tuple[Float[Array, "time state"], Latent, tuple[Fiber, Fiber]]:
    """Predict x_1 … x_T from x_0, u and e; return the latents and fibers as well."""
    fibers, later = fibers_along(model, params, trajectory)
    start = model.encode(_at(fibers, 0), trajectory.states[0])

    def step(latent: Latent, inputs: Any) -> tuple[Latent, Latent]:
        fiber, fiber_next, control = inputs
        latent = model.transport(fiber, fiber_next, model.step(fiber, latent, control))
        return latent, latent

    _, latents = jax.lax.scan(step, start, (fibers, later, trajectory.controls))
    return jax.vmap(model.decode)(later, latents), latents, (fibers, later)


def sliding_windows(trajectory: Trajectory, *, horizon: int, stride: int) -> Trajectory:
    """Return the windows of one trajectory along a new leading axis.

    Args:
        trajectory: one, states (T + 1, state).
        horizon: steps of a window.
        stride: steps between the starts of two windows.

    Raises:
        ValueError: the horizon does not fit the trajectory.
    """
    steps = trajectory.controls.shape[0]
    if horizon > steps:
        raise ValueError(
            f"a horizon of {horizon} steps does not fit trajectories of {steps} steps"
        )
    starts = jnp.arange(0, steps - horizon + 1, stride)
    states = trajectory.states[starts[:, None] + jnp.arange(horizon + 1)]
    inside = starts[:, None] + jnp.arange(horizon)
    return Trajectory(states, trajectory.controls[inside], trajectory.envs[inside])


def window_errors(
    model: Model, params: Params, trajectory: Trajectory, *, horizon: int, stride: int
) -> Float[Array, "window horizon 3"]:
    """Return `prediction_errors` 1 … horizon steps ahead, for every window.

    Args:
        model: any model.
        params: of the model.
        trajectory: one, states (T + 1, state).
        horizon: steps of a window.
        stride: steps between the starts of two windows.

    Raises:
        ValueError: the horizon does not fit the trajectory.
    """

    def one(window: Trajectory) -> Float[Array, "horizon 3"]:
        return prediction_errors(
            rollout(model, params, window)[0], window, along_path=model.along_path
        )

    return jax.vmap(one)(sliding_windows(trajectory, horizon=horizon, stride=stride))


def prediction_errors(
    predicted: Float[Array, "horizon state"],
    window: Trajectory,
    *,
    along_path: bool = False,
) -> Float[Array, "horizon 3"]:
    """Return the errors of position [m], yaw [rad] (wrapped) and body state, as norms.

    Along a path: |e_y| [m], |e_ψ| [rad], 2-norm of the vehicle's own body state.
    """
    gap = predicted - window.states[1:]
    kinds = (
        _kinds_along_path(gap)
        if along_path
        else (gap[:, :2], gap[:, 2:3], gap[:, BODY])
    )
    position, yaw, body = kinds
    return jnp.column_stack(
        [jnp.linalg.norm(kind, axis=1) for kind in (position, wrap_angle(yaw), body)]
    )


def _kinds_along_path(gap: Float[Array, "*batch state"]) -> tuple[Array, Array, Array]:
    """Split path states into e_y, e_ψ (for position and yaw) and the vehicle's body."""
    xi = gap[..., BODY]
    return xi[..., LATERAL, None], xi[..., HEADING, None], xi[..., PATH_SPEED:]


def in_batches(function: Callable[[Any], Any], items: Any, *, size: int) -> Any:
    """Map a function over the leading axis, `size` items at a time.

    The last batch is padded and the padding dropped: `jax.lax.map` would compile a
    second program for the rest.
    """
    count = jax.tree.leaves(items)[0].shape[0]
    size = min(size, count)
    rows = (jnp.arange(-(-count // size) * size) % count).reshape(-1, size)
    results = jax.lax.map(
        lambda chosen: jax.vmap(function)(
            jax.tree.map(lambda leaf: leaf[chosen], items)
        ),
        rows,
    )
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], results)


def defects(
    model: Model,
    params: Params,
    trajectory: Trajectory,
    along: tuple[Fiber, Fiber] | None = None,
) -> tuple[Float[Array, "time rank"], Float[Array, "time state"]]:
    """Return the one-step disturbances d_k and the one-step predictions of the states.

        d_k = z_{k+1} − T(e_k → e_{k+1}) F(z_k, u_k, e_k),   z_k = Φ(x_k, e_k)

    F is the latent step.

    Args:
        model: any model.
        params: of the model.
        trajectory: one, states (T + 1, state).
        along: the result of `fibers_along`, if it is available.
    """
    fibers, later = along or fibers_along(model, params, trajectory)
    origin = model.encode(_at(fibers, 0), trajectory.states[0])
    observe = jax.vmap(model.observe, in_axes=(0, None, 0))
    now = observe(fibers, origin, trajectory.states[:-1])
    expected = jax.vmap(model.step)(fibers, now, trajectory.controls)
    expected = jax.vmap(model.transport)(fibers, later, expected)
    after = observe(later, origin, trajectory.states[1:])
    gap = jax.vmap(model.vector)(after) - jax.vmap(model.vector)(expected)
    return gap, jax.vmap(model.decode)(later, expected)


def step_disturbances(
    model: Model,
    fiber: Fiber,
    fiber_next: Fiber,
    origin: Latent,
    before: State,
    control: Control,
    after: State,
) -> Float[Array, " 4"]:
    """Return the one-step residuals of latent, position [m], yaw [rad] and body state.

        |z' − ẑ'|, |p(g⁻¹ g') − p(g⁻¹ ĝ')|, |yaw(g⁻¹ g') − yaw(g⁻¹ ĝ')|, |s' − ŝ'|,
        ẑ' = T(e → e') F(z, u, e)

    Along a path the last three are e_y [m], e_ψ [rad] and the vehicle's own body state.

    Args:
        model: any model.
        fiber: of e.
        fiber_next: of e'.
        origin: a latent in whose frame z and z' are expressed; `model.encode(fiber,
            before)` gives a new frame at x.
        before: x.
        control: u.
        after: x'.
    """
    now = model.observe(fiber, origin, before)
    expected = model.transport(fiber, fiber_next, model.step(fiber, now, control))
    predicted = model.decode(fiber_next, expected)
    gap = model.vector(model.observe(fiber_next, origin, after)) - model.vector(
        expected
    )
    motion = between(before[POSE], predicted[POSE]) - between(before[POSE], after[POSE])
    kinds = (motion[:2], motion[2:], predicted[BODY] - after[BODY])
    if model.along_path:
        kinds = _kinds_along_path(predicted - after)
    return jnp.stack([jnp.linalg.norm(kind) for kind in (gap, *kinds)])


def _at(tree: Any, index: int) -> Any:
    """Index the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
