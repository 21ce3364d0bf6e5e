"""What any `Model` does along a trajectory: free-running predictions and one-step defects."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Fiber, Latent, Model, Params, Trajectory


def fibers_along(model: Model, params: Params, trajectory: Trajectory) -> tuple[Fiber, Fiber]:
    """Fibres of e_0 … e_{T-1} and of the environment one step later (the last is held)."""
    fibers = jax.vmap(model.fiber, in_axes=(None, 0))(params, trajectory.envs)
    later = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), fibers)
    return fibers, later


def rollout(
    model: Model, params: Params, trajectory: Trajectory
) -> tuple[Float[Array, "time state"], Latent, tuple[Fiber, Fiber]]:
    """Predict x_1 … x_T from x_0, the controls and the environments; latents and fibres come along."""
    fibers, later = fibers_along(model, params, trajectory)
    start = model.encode(_at(fibers, 0), trajectory.states[0])

    def step(latent: Latent, inputs: Any) -> tuple[Latent, Latent]:
        fiber, fiber_next, control = inputs
        latent = model.transport(fiber, fiber_next, model.step(fiber, latent, control))
        return latent, latent

    _, latents = jax.lax.scan(step, start, (fibers, later, trajectory.controls))
    return jax.vmap(model.decode)(later, latents), latents, (fibers, later)


def defects(
    model: Model, params: Params, trajectory: Trajectory, along: tuple[Fiber, Fiber] | None = None
) -> tuple[Float[Array, "time rank"], Float[Array, "time state"]]:
    """One-step disturbances d_k, and beside them the states that each single step predicts.

        d_k = z_{k+1} − T(e_k → e_{k+1}) F(z_k, u_k, e_k),   z_k = Φ(x_k, e_k), F the latent step

    Args:
        model, params: any model.
        trajectory: one, states (T + 1, state).
        along: fibres from `fibers_along`, if they are at hand.
    """
    fibers, later = along or fibers_along(model, params, trajectory)
    origin = model.encode(_at(fibers, 0), trajectory.states[0])
    seen = jax.vmap(model.observe, in_axes=(0, None, 0))
    now = seen(fibers, origin, trajectory.states[:-1])
    expected = jax.vmap(model.step)(fibers, now, trajectory.controls)
    expected = jax.vmap(model.transport)(fibers, later, expected)
    after = seen(later, origin, trajectory.states[1:])
    gap = jax.vmap(model.vector)(after) - jax.vmap(model.vector)(expected)
    return gap, jax.vmap(model.decode)(later, expected)


def _at(tree: Any, index: int) -> Any:
    """One entry along the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
