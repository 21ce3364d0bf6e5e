"""Open-loop evaluation: the errors of free-running predictions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.rollout import adjacent_windows, in_batches, rollout, state_errors
from sfkd_jax.types import BODY, Model, Params, Trajectory


def open_loop(
    model: Model, params: Params, trajectories: Trajectory, *, horizon: int
) -> Float[Array, "horizon column"]:
    """Return the RMSE of free-running predictions 1 … horizon steps ahead.

    Predictions start at every `horizon`-th step of each trajectory.

    The columns are those of `state_errors`: along and across the true yaw [m], so that
    each axis means the same on every trajectory, the yaw [rad], and the body state. In
    a frame without a pose they are those of the body state alone.

    Args:
        model: that predicts.
        params: of the model.
        trajectories: held out from training.
        horizon: length of a prediction [steps].
    """
    windows = adjacent_windows(trajectories, length=horizon)
    frame = model.frame

    def squared_errors(window: Trajectory) -> Float[Array, "horizon column"]:
        predicted = rollout(model, params, window).free
        errors = state_errors(frame, predicted, window.states[1:])
        return (errors if frame.has_pose else errors[:, BODY]) ** 2

    squares = in_batches(jax.vmap(squared_errors), windows, size=128)
    return jnp.sqrt(jnp.mean(squares, axis=0))
