"""Every attack beside a proof, and what each may reach at most."""

from __future__ import annotations

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
from sfkd_jax.types import Model, Params, Polytope

FLOAT32 = 1e-5
"""An attack runs on the model in float32; a bound is contradicted when it is exceeded
by more than this, relatively.
"""


class CertificateContradicted(CertificationRefused):
    """An attack exceeds a proved bound: a fault in this code or in what the model says about itself, never data."""


def attack_all(
    model: Model,
    params: Params,
    weights: Exported,
    claims: Claims,
    box: Any,
    starts: int,
    seed: int,
) -> dict[str, float]:
    """Lower bounds by name, none of which may exceed what was proved."""
    limits, found = limits_of(claims, weights), {}
    with one_thread():
        for name, network in {
            "residual": weights.residual,
            **decoders(weights),
        }.items():
            if network:
                found[f"{name}_slopes"] = attack_slopes(network, seed=seed)
        if "step_slopes" in limits:
            slopes = [
                attack_slopes(weights.residual, vertex, starts=8)
                for vertex in weights.operators.vertices
            ]
            found["step_slopes"] = max(slopes)
    if starts:
        step_key, transport_key, decoder_key = jax.random.split(jax.random.key(seed), 3)
        driving = jax.jit(model.fold)(params)
        found["transport"] = attack_transport(model, driving, box, transport_key)
        emitted = attack_decoder(model, driving, box, decoder_key, starts=starts)
        found |= {name: value for name, value in emitted.items() if name in limits}
        if claims.kappa == 1.0:
            found["step"] = attack_step(model, driving, box, step_key, starts=starts)
    for name, value in found.items():
        if not value <= limits[name] * (1 + FLOAT32):
            raise CertificateContradicted(
                f"INTERNAL ERROR: the attack on the {name} reaches {value:.6f}, above the bound {limits[name]:.6f}"
            )
    return found


def limits_of(claims: Claims, weights: Exported) -> dict[str, float]:
    """What an attack may reach at most, by its name; in another metric than I the step is not attacked."""
    limits = {"residual_slopes": claims.beta, "transport": 1.0, **claims.lipschitz}
    limits |= {f"{name}_slopes": claims.lipschitz[name] for name in decoders(weights)}
    if claims.kappa == 1.0:
        limits["step"] = claims.alpha
        if isinstance(weights.operators, Polytope):
            limits["step_slopes"] = claims.alpha
    return limits
