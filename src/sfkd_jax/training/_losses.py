"""The training loss: multi-step prediction in physical units, and what keeps the latent honest."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.rollouts import defects, rollout
from sfkd_jax.se2 import rotate, wrap_angle
from sfkd_jax.types import BODY, Model, Params, Scalar, Space, Trajectory

Loss: TypeAlias = Callable[[Params, Trajectory], tuple[Scalar, dict[str, Scalar]]]

YAW_LENGTH = 5.0
"""What 1 rad of yaw is worth in the loss [m]: its lever over half a second at the benchmark's speed."""


def state_errors(predicted: Float[Array, "time state"], true: Float[Array, "time state"]) -> Float[Array, "time state"]:
    """Predicted minus true: position along and across the true heading [m], yaw wrapped [rad], body state."""
    position = jax.vmap(rotate)(-true[:, 2], predicted[:, :2] - true[:, :2])
    yaw = wrap_angle(predicted[:, 2:3] - true[:, 2:3])
    return jnp.concatenate([position, yaw, predicted[:, BODY] - true[:, BODY]], axis=1)


def multi_step_loss(
    model: Model,
    space: Space,
    *,
    prediction: float = 1.0,
    one_step: float = 1.0,
    consistency: float = 0.001,
    reconstruction: float = 0.1,
    transport: float = 0.1,
    growth: float = 0.5,
) -> Loss:
    """Mean over windows and steps of the prediction error in physical units, with four terms beside it.

        λ_p |x_k − x̂_k|²_W / (1 + γ (k − 1))² + λ_1 |x_k − x̂_{k|k−1}|²_{W}·10²
            + λ_c |d_k|² + λ_r |s − C Φ(x)|² + λ_t |Φ(x, e') − T(e → e') Φ(x, e)|²

    W measures position in units of 0.01 m at the first step; a prediction's error grows about linearly with k, so
    the division by its expected growth lets the near steps, which the planner leans on, count as much as the far ones.
    The one-step term, in units of 0.001 m, sees what the sums over a window hide: slip, a lateral millimetre per step.

    Args:
        model, space: what is trained and its scales.
        prediction: λ_p, on free-running predictions; 0 leaves the one-step loss alone.
        one_step: λ_1, on predictions from the true state one step before.
        consistency: λ_c, on the one-step latent defect: larger gives a tighter tube and a less accurate model, see
            `docs/certificate.md`. reconstruction: λ_r. transport: λ_t, on
            Φ(x, e') − T(e → e') Φ(x, e) with e' another window's environment.
        growth: γ.

    Returns:
        (params, batch of windows) -> loss, parts.
    """

    def window(params: Params, data: Trajectory, other: Float[Array, " environment"]) -> dict[str, Scalar]:
        predicted, _, along = rollout(model, params, data)
        errors = state_errors(predicted, data.states[1:])
        units = jnp.concatenate([jnp.asarray([1.0, 1.0, YAW_LENGTH]), 0.1 / space.body_scale * 2.0])
        steps = 1.0 + growth * jnp.arange(errors.shape[0])
        weighted = (errors * units / 0.01 / steps[:, None]) ** 2
        gap, single = defects(model, params, data, along)
        near = state_errors(single, data.states[1:]) * units / 0.001
        fiber, there = jax.tree.map(lambda leaf: leaf[0], along[0]), model.fiber(params, other)
        here = model.encode(fiber, data.states[0])
        moved = model.vector(model.transport(fiber, there, here)) - model.vector(model.encode(there, data.states[0]))
        rebuilt = (model.decode(fiber, here) - data.states[0])[BODY] / space.body_scale
        parts = {
            "prediction": jnp.mean(jnp.sum(weighted, axis=1)),
            "one_step": jnp.mean(jnp.sum(near**2, axis=1)),
            "consistency": jnp.mean(jnp.sum(gap**2, axis=1)) / 1e-4,
            "reconstruction": jnp.sum(rebuilt**2) / 1e-4,
            "transport": jnp.sum(moved**2) / 1e-4,
        }
        if model.penalty is not None:
            parts["penalty"] = model.penalty(fiber, here, data.controls[0])
        return parts

    def loss(params: Params, batch: Trajectory) -> tuple[Scalar, dict[str, Scalar]]:
        others = jnp.roll(batch.envs[:, -1], 1, axis=0)
        parts = jax.vmap(window, in_axes=(None, 0, 0))(params, batch, others)
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        weights = {
            "prediction": prediction,
            "one_step": one_step,
            "consistency": consistency,
            "reconstruction": reconstruction,
            "transport": transport,
        }
        return sum((weights.get(name, 1.0) * part for name, part in parts.items()), jnp.zeros(())), parts

    return loss
