"""The tube that any model gets: measured prediction errors and nothing proved."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._calibration import conformal_quantile
from sfkd_jax.core.rollouts import in_batches, window_errors
from sfkd_jax.types import Model, Params, Trajectory

KINDS = ("position_m", "yaw_rad", "body")
RESOLUTION = np.asarray([1e-3, 1e-4, 1e-3])
"""No radius is smaller [m, rad, body]: 600 m from the origin float32 positions lie 6e-5
m apart, and steps add up.
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
    """Radii that all windows of a new trajectory respect together with probability ≥ level (split-conformal).

        r_jk = unit_jk q,   q the ⌈(n+1) level⌉-th smallest of the scores max over windows, j, k of error_jk / unit_jk

    with unit_jk the 95 % quantile of the validation errors of kind k after j steps. A
    trajectory is one draw: its windows overlap and are not independent.

    Args:
        model, params: any model.
        validation: fixes the units.
        calibration: sets q. Both batches of trajectories.
        level: 1 − δ.
        horizon, stride: steps, as in `window_errors`.

    Returns:
        "position_m" [m], "yaw_rad" [rad] and "body" (2-norm in its own units), each of
        length `horizon`.

    Raises:
        ValueError: too few trajectories for the level, errors that are not finite, a
            horizon that does not fit.
    """

    def along(
        params: Params, data: Trajectory
    ) -> Float[Array, "trajectory window horizon 3"]:
        one = partial(window_errors, model, params, horizon=horizon, stride=stride)
        return in_batches(one, data, size=64)

    both = jax.tree.map(lambda *parts: jnp.concatenate(parts), validation, calibration)
    found = np.asarray(jax.jit(along)(params, both), dtype=np.float64)
    seen, errors = np.split(found, [validation.controls.shape[0]])
    if not np.all(np.isfinite(seen)):
        raise ValueError("prediction errors are not finite")
    units = np.maximum(np.quantile(seen, 0.95, axis=(0, 1)), RESOLUTION)
    factor = conformal_quantile(np.max(errors / units, axis=(1, 2, 3)), level)
    radii = np.maximum(units * factor, RESOLUTION)
    return dict(zip(KINDS, radii.T.tolist(), strict=True))
