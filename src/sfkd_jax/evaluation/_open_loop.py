"""Open-loop prediction errors by horizon on held-out trajectories."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.path_frame import HEADING, LATERAL, PATH_SPEED
from sfkd_jax.core.rollouts import every_window, in_batches, rollout
from sfkd_jax.core.se2 import rotate, wrap_angle
from sfkd_jax.types import BODY, Model, Params, Trajectory


def open_loop(
    model: Model, params: Params, trajectories: Trajectory, *, horizon: int
) -> Float[Array, "horizon 4"]:
    """Return the RMSE of free-running predictions 1 … horizon steps ahead.

    Predictions start at every `horizon`-th step of each trajectory.

    Columns: along and across the true heading [m] (so that each axis means the same on
    every trajectory), yaw [rad], speed [m/s]. In path coordinates: 0, e_y [m], e_ψ
    [rad], speed [m/s].

    Args:
        model: that predicts.
        params: of the model.
        trajectories: held out from training.
        horizon: steps.

    Raises:
        ValueError: the horizon does not fit the trajectories.
    """
    cut = jax.vmap(partial(every_window, horizon=horizon, stride=horizon))
    pieces = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), cut(trajectories)
    )

    def squares(piece: Trajectory) -> Float[Array, "horizon 4"]:
        predicted, _, _ = rollout(model, params, piece)
        true = piece.states[1:]
        if model.along_path:
            gap = (predicted - true)[:, BODY]
            return (
                jnp.column_stack(
                    [
                        jnp.zeros(gap.shape[0]),
                        gap[:, LATERAL],
                        wrap_angle(gap[:, HEADING]),
                        gap[:, PATH_SPEED],
                    ]
                )
                ** 2
            )
        position = jax.vmap(rotate)(-true[:, 2], predicted[:, :2] - true[:, :2])
        yaw = wrap_angle(predicted[:, 2] - true[:, 2])
        return jnp.column_stack([position, yaw, predicted[:, 3] - true[:, 3]]) ** 2

    return jnp.sqrt(jnp.mean(in_batches(squares, pieces, size=128), axis=0))
