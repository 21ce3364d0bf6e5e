"""Error tubes from a contraction factor and a disturbance bound (corrected thm:ISS)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float


def latent_tube(
    alpha: float, d_bar: float, horizon: int, *, initial: float = 0.0
) -> Float[np.ndarray, " horizon"]:
    """Return R_1 … R_T with |z_k − ẑ_k| ≤ R_k as long as all |d_j| ≤ d̄.

        R_k = α^k |e_0| + d̄ (1 − α^k)/(1 − α)

    Args:
        alpha: α.
        d_bar: d̄.
        horizon: T [steps].
        initial: |e_0|.
    """
    radii, radius = [], initial
    for _ in range(horizon):
        radius = alpha * radius + d_bar
        radii.append(radius)
    return np.asarray(radii)


def path_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
) -> dict[str, list[float]]:
    """Return radii of e_y [m], e_ψ [rad] and body state along a path for an exact z_0.

        |e_i,k| ≤ L_i α R_{k−1} + ε_i,   k = 1 … T

    Position and heading are decoded from z, so no error accumulates over the horizon.

    Args:
        latent: R_1 … R_T.
        alpha: contraction factor.
        lipschitz: L of the outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the outputs at the true latent, by the same
            names.
    """
    before = np.concatenate([[0.0], latent[:-1]])
    kinds = {"position_m": "position", "yaw_rad": "yaw", "body": "body"}
    return {
        name: (lipschitz[kind] * alpha * before + residual[kind]).tolist()
        for name, kind in kinds.items()
    }


def ultimate_tube(
    ultimate: float,
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
) -> dict[str, float]:
    """Return the radii of `path_tube` for an infinite horizon.

    Args:
        ultimate: d̄/(1 − α), the limit of R_k.
        alpha: contraction factor.
        lipschitz: L of the outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the outputs at the true latent, by the same
            names.
    """
    limits = np.asarray([ultimate, ultimate])
    radii = path_tube(limits, alpha=alpha, lipschitz=lipschitz, residual=residual)
    return {name: values[-1] for name, values in radii.items()}


def physical_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
    largest_increment: float,
) -> dict[str, list[float]]:
    """Return radii of position [m], yaw [rad] and body state for an exact z_0.

    The pose is a sum of increments on SE(2), so its error is bounded by finite sums and
    not by a contraction. For k = 1 … T and sums over j = 0 … k − 1,

        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw)
        |e_p,k|   ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|)
        |e_s,k|   ≤ L_s α R_{k−1} + ε_s

    Args:
        latent: R_1 … R_T.
        alpha: contraction factor.
        lipschitz: L of the decoder's outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the decoder at the true latent, by the same
            names.
        largest_increment: |dp|, the longest step [m].
    """
    before = np.concatenate([[0.0], latent[:-1]])
    yaw = np.cumsum(lipschitz["yaw"] * before + residual["yaw"])
    turned = np.concatenate([[0.0], yaw[:-1]])
    increments = lipschitz["position"] * before + residual["position"]
    position = np.cumsum(increments + largest_increment * turned)
    body = lipschitz["body"] * alpha * before + residual["body"]
    return {
        "position_m": position.tolist(),
        "yaw_rad": yaw.tolist(),
        "body": body.tolist(),
    }
