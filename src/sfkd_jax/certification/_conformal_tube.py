"""Conformal tube of any model from measured prediction errors, without a proof."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._calibration import conformal_quantile
from sfkd_jax.rollout import in_batches, window_errors
from sfkd_jax.types import Model, Params, Trajectory

KINDS = ("position_m", "yaw_rad", "body")
RESOLUTION = np.asarray([1e-3, 1e-4, 1e-3])
"""Smallest radii [m, rad, body], above the accumulated rounding of float32 positions
(6e-5 m at 600 m from the origin).
"""


def conformal_tube(
    model: Model,
    params: Params,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    level: float,
    horizon: int,
    stride: int,
) -> dict[str, list[float]]:
    """Return split-conformal radii of the prediction error up to a horizon.

    With probability at least `level`, all windows of a new trajectory respect all radii

        r_jk = unit_jk q,

    where unit_jk is the 95 % quantile of the validation errors of kind k after j steps,
    q is the ⌈(n+1) level⌉-th smallest score, and the score of a trajectory is the
    maximum of error_jk / unit_jk over its windows, j and k. A trajectory is one sample,
    because its windows overlap and are not independent.

    Args:
        model: any model.
        params: its weights.
        validation: trajectories that fix the units.
        calibration: trajectories that set q.
        level: 1 − δ.
        horizon: number of steps predicted.
        stride: steps between the starts of windows.

    Returns:
        "position_m" [m], "yaw_rad" [rad] and "body" (2-norm in its own units), each of
        length `horizon`.

    Raises:
        ValueError: too few trajectories for the level, errors that are not finite, or a
            horizon longer than a trajectory.
    """

    def along(
        params: Params, data: Trajectory
    ) -> Float[Array, "trajectory window horizon 3"]:
        one = partial(window_errors, model, params, horizon=horizon, stride=stride)
        return in_batches(one, data, size=64)

    both = jax.tree.map(lambda *parts: jnp.concatenate(parts), validation, calibration)
    errors = np.asarray(jax.jit(along)(params, both), dtype=np.float64)
    reference, errors = np.split(errors, [validation.controls.shape[0]])
    if not np.all(np.isfinite(reference)):
        raise ValueError("prediction errors are not finite")
    units = np.maximum(np.quantile(reference, 0.95, axis=(0, 1)), RESOLUTION)
    factor = conformal_quantile(np.max(errors / units, axis=(1, 2, 3)), level)
    radii = np.maximum(units * factor, RESOLUTION)
    return dict(zip(KINDS, radii.T.tolist(), strict=True))
