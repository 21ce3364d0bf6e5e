"""Error tubes that follow from a contraction rate and a disturbance bound (thm:ISS, as corrected)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def latent_tube(alpha: float, d_bar: float, horizon: int, *, initial: float = 0.0) -> Float[np.ndarray, " horizon"]:
    """R_k = α^k |e_0| + d̄ (1 − α^k)/(1 − α), k = 1 … horizon: |z_k − ẑ_k| ≤ R_k whenever every |d_j| ≤ d̄."""
    radii, radius = [], initial
    for _ in range(horizon):
        radius = alpha * radius + d_bar
        radii.append(radius)
    return np.asarray(radii)


def physical_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    position_lipschitz: float,
    yaw_lipschitz: float,
    body_lipschitz: float,
    position_error: float,
    yaw_error: float,
    body_error: float,
    largest_increment: float,
) -> dict[str, list[float]]:
    """Radii of position [m], yaw [rad] and body state for k = 1 … horizon, from z_0 known exactly.

    The pose is a sum of increments on SE(2), so its error is bounded by finite sums, not by a contraction:
        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw),   |e_p,k| ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|),   |e_s,k| ≤ L_s R_k + ε_s

    Args:
        latent: R_1 … R_T. position_lipschitz, yaw_lipschitz, body_lipschitz: of the decoder's parts.
        position_error, yaw_error, body_error: one-step residuals ε of the decoder at the true latent.
        largest_increment: |dp|, the longest step driven [m].
    """
    before = np.concatenate([[0.0], latent[:-1]])
    yaw = np.cumsum(yaw_lipschitz * before + yaw_error)
    turned = np.concatenate([[0.0], yaw[:-1]])
    position = np.cumsum(position_lipschitz * before + position_error + largest_increment * turned)
    body = body_lipschitz * latent + body_error
    return {"position_m": position.tolist(), "yaw_rad": yaw.tolist(), "body": body.tolist()}
