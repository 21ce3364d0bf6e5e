"""All attacks on a certificate, and the bound that each of them tests."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax

from sfkd_jax.certification._attack import (
    attack_decoder,
    attack_slopes,
    attack_step,
    attack_transport,
)
from sfkd_jax.certification._claims import Claims, decoders
from sfkd_jax.certification._exported import CertificationRefused, Exported, one_thread
from sfkd_jax.rollout import fold
from sfkd_jax.types import Model, Params, Polytope

FLOAT32 = 1e-5
"""Relative excess over a bound that float32 rounding of the attacked model explains."""


class CertificateContradicted(CertificationRefused):
    """An attack exceeds a proved bound, which is a fault of the code, never of data.

    Either this package is wrong or what the model declares about itself.
    """


def attack_all(
    model: Model,
    params: Params,
    weights: Exported,
    claims: Claims,
    box: Any,
    starts: int,
    seed: int,
) -> dict[str, float]:
    """Run all attacks and return the lower bounds that they reach, by name.

    Raises:
        CertificateContradicted: a lower bound exceeds the proved bound.
    """
    limits, reached = limits_of(claims, weights), {}
    networks = {"residual": weights.residual, **decoders(weights)}
    with one_thread():
        for name, network in networks.items():
            if network:
                reached[f"{name}_slopes"] = attack_slopes(network, seed=seed)
        if "step_slopes" in limits:
            slopes = [
                attack_slopes(weights.residual, vertex, starts=8)
                for vertex in weights.operators.vertices
            ]
            reached["step_slopes"] = max(slopes)
    if starts:
        step_key, transport_key, decoder_key = jax.random.split(jax.random.key(seed), 3)
        folded = jax.jit(partial(fold, model))(params)
        reached["transport"] = attack_transport(model, folded, box, transport_key)
        outputs = attack_decoder(model, folded, box, decoder_key, starts=starts)
        reached |= {name: value for name, value in outputs.items() if name in limits}
        if claims.kappa == 1.0:
            reached["step"] = attack_step(model, folded, box, step_key, starts=starts)
    for name, value in reached.items():
        if not value <= limits[name] * (1 + FLOAT32):
            raise CertificateContradicted(
                f"INTERNAL ERROR: the attack on the {name} reaches {value:.6f}, "
                f"above the bound {limits[name]:.6f}"
            )
    return reached


def limits_of(claims: Claims, weights: Exported) -> dict[str, float]:
    """Return the proved bound behind each attack, by name of the attack.

    The step is attacked in the 2-norm only.
    """
    limits = {"residual_slopes": claims.beta, "transport": 1.0, **claims.lipschitz}
    limits |= {f"{name}_slopes": claims.lipschitz[name] for name in decoders(weights)}
    if claims.kappa == 1.0:
        limits["step"] = claims.alpha
        if isinstance(weights.operators, Polytope):
            limits["step_slopes"] = claims.alpha
    return limits
