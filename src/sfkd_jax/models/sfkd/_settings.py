"""Checks of the settings of SFKD."""

from __future__ import annotations

from sfkd_jax.models.sfkd._networks import LOWEST_RATE

FRAMES = ("body", "segment", "path")
RESIDUALS = ("sandwich", "free", "none")
BUDGETS = ("joint", "sum")


def check_settings(
    rank: int,
    rho: float,
    beta: float,
    frame: str,
    residual: str,
    budget: str,
    learn_alpha: bool,
) -> None:
    """Raise ValueError for invalid settings, listing the choices."""
    if frame not in FRAMES:
        raise ValueError(
            f"model.frame must be one of {', '.join(FRAMES)}, got {frame!r}"
        )
    if residual not in RESIDUALS:
        raise ValueError(
            f"model.residual must be one of {', '.join(RESIDUALS)}, got {residual!r}"
        )
    if budget not in BUDGETS:
        raise ValueError(
            f"model.budget must be one of {', '.join(BUDGETS)}, got {budget!r}"
        )
    if rank < 2 or rank % 2:
        raise ValueError(f"model.rank must be even and at least 2, got {rank}")
    if min(rho, beta) <= 0.0 or max(rho, beta) >= 1.0:
        raise ValueError(
            f"model.rho and model.beta must lie in (0, 1), got {rho} and {beta}"
        )
    if learn_alpha and (residual, budget) != ("sandwich", "joint"):
        raise ValueError(
            "model.learn_alpha needs model.residual=sandwich and model.budget=joint"
        )
    if learn_alpha and rho + beta <= LOWEST_RATE:
        raise ValueError(
            "model.learn_alpha needs model.rho + model.beta above "
            f"{LOWEST_RATE}, got {rho + beta}"
        )
