"""Open-loop prediction errors of models by horizon."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, wrap_angle
from sfkd_jax.rollout import adjacent_windows, in_batches, rollout, state_errors
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
    """
    windows = adjacent_windows(trajectories, length=horizon)

    def squares(window: Trajectory) -> Float[Array, "horizon 4"]:
        predicted, true = rollout(model, params, window)[0], window.states[1:]
        if not model.along_path:
            return state_errors(predicted, true)[:, :4] ** 2
        gap = (predicted - true)[:, BODY]
        # Along a path nothing is predicted of the way along it.
        still, yaw = jnp.zeros(gap.shape[0]), wrap_angle(gap[:, HEADING])
        columns = [still, gap[:, LATERAL], yaw, gap[:, PATH_SPEED]]
        return jnp.column_stack(columns) ** 2

    return jnp.sqrt(jnp.mean(in_batches(jax.vmap(squares), windows, size=128), axis=0))
