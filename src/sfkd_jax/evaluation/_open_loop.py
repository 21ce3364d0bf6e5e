"""Prediction error by horizon on held-out trajectories."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.rollouts import rollout
from sfkd_jax.se2 import rotate, wrap_angle
from sfkd_jax.types import Model, Params, Trajectory


def open_loop(model: Model, params: Params, trajectories: Trajectory, *, horizon: int) -> Float[Array, "horizon 4"]:
    """RMSE of free-running predictions 1 … horizon steps ahead, from every `horizon`-th step of each trajectory.

    Columns: along and across the true heading [m] (so that each axis means the same on every trajectory),
    yaw [rad], speed [m/s].

    Args:
        model, params: what predicts. trajectories: never used for training.
        horizon: steps.

    Raises:
        ValueError: the horizon does not fit the trajectories.
    """
    steps = trajectories.controls.shape[1]
    if horizon > steps:
        raise ValueError(f"a horizon of {horizon} steps does not fit trajectories of {steps} steps")
    pieces = []
    for start in range(0, steps - horizon + 1, horizon):
        stop = start + horizon
        states = trajectories.states[:, start : stop + 1]
        pieces.append(Trajectory(states, trajectories.controls[:, start:stop], trajectories.envs[:, start:stop]))
    batch = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pieces)

    def squares(piece: Trajectory) -> Float[Array, "horizon 4"]:
        predicted, _, _ = rollout(model, params, piece)
        true = piece.states[1:]
        position = jax.vmap(rotate)(-true[:, 2], predicted[:, :2] - true[:, :2])
        yaw = wrap_angle(predicted[:, 2] - true[:, 2])
        return jnp.column_stack([position, yaw, predicted[:, 3] - true[:, 3]]) ** 2

    return jnp.sqrt(jnp.mean(jax.lax.map(squares, batch, batch_size=128), axis=0))
