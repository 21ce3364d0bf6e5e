"""A regression of single steps: linear by least squares, a network for the rest."""

from __future__ import annotations

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.geometry import between, compose
from sfkd_jax.models._continuous import Conditioned, mlp
from sfkd_jax.models._state_model import state_model
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Fitting,
    Key,
    Model,
    Params,
    Space,
    State,
    Trajectory,
)


def one_step(space: Space, *, hidden: tuple[int, ...] = (64, 64)) -> Model:
    """Return a regression of one step: linear by least squares, a network for the rest.

        (Δ, s⁺ − s) = Wᵀ [1; s; u; e] + σ tanh network(s, u, e),   Δ in the body frame

    `fitting.identify` finds W and the standard deviations σ of its residuals, and draws
    initial weights of the network. A gradient reaches the weights of the network only.

    Args:
        space: measured scales, which fix all sizes.
        hidden: widths of the network.
    """
    outputs = 3 + space.body_mean.shape[0]
    network = mlp(hidden, outputs, (nn.tanh,) * len(hidden), last=0.1)

    def inputs_of(state: State, control: Control, env: Environment) -> Array:
        return jnp.concatenate(
            [
                space.scaled_body(state),
                space.scaled_control(control),
                space.scaled_env(env),
            ]
        )

    def init(key: Key) -> Params:
        # `identify` gives all parameters.
        return {}

    def identify(train: Trajectory, held_out: Trajectory, key: Key) -> Params:
        before = train.states[:, :-1]
        after = train.states[:, 1:]
        inputs = jax.vmap(jax.vmap(inputs_of))(before, train.controls, train.envs)
        inputs = inputs.reshape(-1, inputs.shape[-1])
        moved = jax.vmap(jax.vmap(_increment))(before, after).reshape(-1, outputs)
        columns = jnp.column_stack([jnp.ones(inputs.shape[0]), inputs])
        # The inputs are scaled, so the normal equations are well conditioned in
        # float32.
        gram = columns.T @ columns + 1e-3 * jnp.eye(columns.shape[1])
        linear = jnp.linalg.solve(gram, columns.T @ moved)
        scale = jnp.std(moved - columns @ linear, axis=0)
        return {
            "linear": linear,
            "scale": jnp.where(scale > 1e-6, scale, 1e-6),
            "network": network.init(key, inputs[0])["params"],
        }

    def step(fiber: Conditioned, state: State, control: Control) -> State:
        inputs = inputs_of(state, control, fiber.env)
        fixed = jax.lax.stop_gradient(fiber.params)
        residual = network.apply({"params": fiber.params["network"]}, inputs)
        linear = fixed["linear"][0] + inputs @ fixed["linear"][1:]
        change = linear + fixed["scale"] * cast(jax.Array, residual)
        pose = compose(state[POSE], change[POSE])
        return jnp.concatenate([pose, state[BODY] + change[BODY]])

    model = state_model(init, Conditioned, step, vector=space.scaled_body)
    return model._replace(fitting=Fitting(identify=identify))


def _increment(before: State, after: State) -> State:
    """Return the motion in the frame of the body, and the change of the body state."""
    pose = between(before[POSE], after[POSE])
    return jnp.concatenate([pose, after[BODY] - before[BODY]])
