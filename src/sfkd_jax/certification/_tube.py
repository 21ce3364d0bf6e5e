"""Error tubes that follow from a contraction rate and a disturbance bound (thm:ISS, as corrected)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float


def latent_tube(
    alpha: float, d_bar: float, horizon: int, *, initial: float = 0.0
) -> Float[np.ndarray, " horizon"]:
    """R_k = α^k |e_0| + d̄ (1 − α^k)/(1 − α), k = 1 … horizon: |z_k − ẑ_k| ≤ R_k whenever every |d_j| ≤ d̄."""
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
    """Radii of e_y [m], e_ψ [rad] and the rest of the state along a path, for k = 1 … horizon, from z_0 known exactly.

        |e_i,k| ≤ L_i α R_{k−1} + ε_i

    Position and heading are read from z like everything else, so nothing adds up over
    the horizon: with the limit of R_k the radii hold for ever. Arguments as
    `physical_tube`.
    """
    before = np.concatenate([[0.0], latent[:-1]])
    kinds = {"position_m": "position", "yaw_rad": "yaw", "body": "body"}
    return {
        name: (lipschitz[kind] * alpha * before + residual[kind]).tolist()
        for name, kind in kinds.items()
    }


def for_ever(
    ultimate: float,
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
) -> dict[str, float]:
    """`path_tube` at the limit d̄/(1 − α) of R_k: what holds at every step, however many there are."""
    radii = path_tube(
        np.asarray([ultimate, ultimate]),
        alpha=alpha,
        lipschitz=lipschitz,
        residual=residual,
    )
    return {name: values[-1] for name, values in radii.items()}


def physical_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
    largest_increment: float,
) -> dict[str, list[float]]:
    """Radii of position [m], yaw [rad] and body state for k = 1 … horizon, from z_0 known exactly.

    The pose is a sum of increments on SE(2), so its error is bounded by finite sums, not by a contraction:
        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw),   |e_p,k| ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|),   j = 0 … k − 1
        |e_s,k| ≤ L_s α R_{k−1} + ε_s

    Args:
        latent: R_1 … R_T.
        alpha: the contraction factor behind them.
        lipschitz: L of the decoder's parts, by "position", "yaw", "body".
        residual: ε, the decoder's one-step residuals at the true latent, by the same
            names.
        largest_increment: |dp|, the longest step driven [m].
    """
    before = np.concatenate([[0.0], latent[:-1]])
    yaw = np.cumsum(lipschitz["yaw"] * before + residual["yaw"])
    turned = np.concatenate([[0.0], yaw[:-1]])
    position = np.cumsum(
        lipschitz["position"] * before
        + residual["position"]
        + largest_increment * turned
    )
    body = lipschitz["body"] * alpha * before + residual["body"]
    return {
        "position_m": position.tolist(),
        "yaw_rad": yaw.tolist(),
        "body": body.tolist(),
    }
