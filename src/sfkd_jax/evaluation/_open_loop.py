"""Open-loop prediction errors by horizon on held-out trajectories."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, wrap_angle
from sfkd_jax.rollout import in_batches, rollout, sliding_windows, state_errors
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
    return prediction_rmse(
        lambda window: rollout(model, params, window)[0],
        trajectories,
        horizon=horizon,
        along_path=model.along_path,
    )


def prediction_rmse(
    predict: Callable[[Trajectory], Float[Array, "horizon state"]],
    trajectories: Trajectory,
    *,
    horizon: int,
    along_path: bool,
) -> Float[Array, "horizon 4"]:
    """Return the RMSE of any predictor, as `open_loop` does.

    Args:
        predict: window -> predicted x_1 … x_horizon; the window's first state, controls
            and environments are known.
        trajectories: held out from training.
        horizon: steps.
        along_path: whether states are those of `path_frame`.

    Raises:
        ValueError: the horizon does not fit the trajectories.
    """
    cut = jax.vmap(partial(sliding_windows, horizon=horizon, stride=horizon))
    pieces = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), cut(trajectories)
    )

    def squares(piece: Trajectory) -> Float[Array, "horizon 4"]:
        predicted, true = predict(piece), piece.states[1:]
        if along_path:
            return _path_gaps(predicted, true) ** 2
        return state_errors(predicted, true)[:, :4] ** 2

    return jnp.sqrt(jnp.mean(in_batches(squares, pieces, size=128), axis=0))


def _path_gaps(
    predicted: Float[Array, "horizon state"], true: Float[Array, "horizon state"]
) -> Float[Array, "horizon 4"]:
    """Errors in path coordinates: 0, e_y, e_ψ and speed."""
    gap = (predicted - true)[:, BODY]
    return jnp.column_stack(
        [
            jnp.zeros(gap.shape[0]),
            gap[:, LATERAL],
            wrap_angle(gap[:, HEADING]),
            gap[:, PATH_SPEED],
        ]
    )
