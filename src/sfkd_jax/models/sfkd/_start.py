"""Where training may start from: operators and input map identified for the initial lift, the rest as drawn."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.rollouts import fibers_along
from sfkd_jax.models._continuous import scaled_env
from sfkd_jax.models._identification import bounded_ridge
from sfkd_jax.models.sfkd._bounds import attainable, unbounded
from sfkd_jax.models.sfkd._budget import budget_factors
from sfkd_jax.models.sfkd._networks import Networks, PerEnvironment
from sfkd_jax.types import Key, Model, Params, Space, Trajectory


class Pairs(NamedTuple):
    """Transitions as regression sees them.

    Attributes:
        before, after: z_k, and z_{k+1} carried back into the fibre of e_k, less the
            residual at z_k.
        mixtures: w(e_k).
        inputs: (ψ(e_k), 1) ⊗ u_k.
    """

    before: Float[Array, "*sample rank"]
    after: Float[Array, "*sample rank"]
    mixtures: Float[Array, "*sample vertex"]
    inputs: Float[Array, "*sample feature"]


def identified(
    model: Model,
    networks: Networks,
    space: Space,
    environment: bool,
    params: Params,
    driven: Trajectory,
    key: Key,
    *,
    transitions: int = 20000,
    ridge: float = 1e-4,
    iterations: int = 200,
) -> Params:
    """Params whose A_j and B(e) solve (eq:koopid) for the lift, embedding, mixture and residual that they have.

        min Σ_k |T(e_{k+1} → e_k) z_{k+1} − r(z_k; u_k, e_k) − Σ_j w_j(e_k) A_j z_k − B(e_k) u_k|² + ridge

    under the model's own bound, in the coordinates in which it has it: with a joint budget A_j = α L M_j R' that is
    ||M_j|| ≤ 1 and the sum of squares is that of L⁻¹ times the errors. The Gram bound overestimates norms, so the
    matrices that every choice of singular values can attain (`attainable`) are searched, up to 2.7 % shorter at rank
    32, and the raw parameters that the model bounds give them back exactly.

    Args:
        model, networks: of `sfkd`.
        environment: whether e is used.
        driven: trajectories, of which the key draws some.
        transitions: about how many, at most.
        ridge, iterations: of `bounded_ridge`.
    """
    drawn = jax.random.permutation(key, driven.controls.shape[0])
    chosen = drawn[: max(transitions // driven.controls.shape[1], 1)]
    few = jax.tree.map(lambda leaf: leaf[chosen], driven)
    found = jax.vmap(
        lambda one: _pairs(model, networks, space, environment, params, one)
    )(few)
    pairs = jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), found)
    rank = networks.rank
    raw = params["networks"]
    joint = "couplings" in raw
    left, right = (
        budget_factors(raw["couplings"]) if joint else (jnp.eye(rank), jnp.eye(rank))
    )
    size, bound = (networks.rho + networks.beta, 1.0) if joint else (1.0, networks.rho)
    operators, gains = bounded_ridge(
        pairs.before @ right,
        pairs.mixtures,
        pairs.inputs,
        jax.scipy.linalg.solve_triangular(size * left, pairs.after.T, lower=True).T,
        bound=attainable(bound, rank),
        ridge=ridge,
        iterations=iterations,
    )
    *kernel, bias = (
        (size * left @ gains).reshape(rank, -1, networks.control).swapaxes(0, 1)
    )
    head = {"kernel": jnp.stack(kernel).reshape(len(kernel), -1), "bias": bias.ravel()}
    return params | {
        "networks": raw
        | {"operators": jax.vmap(unbounded)(operators), "input_head": head}
    }


def _pairs(
    model: Model,
    networks: Networks,
    space: Space,
    environment: bool,
    params: Params,
    driven: Trajectory,
) -> Pairs:
    """The transitions of one trajectory."""
    fibers, later = fibers_along(model, params, driven)
    origin = model.encode(_first(fibers), driven.states[0])
    seen = jax.vmap(model.observe, in_axes=(0, None, 0))
    before = seen(fibers, origin, driven.states[:-1])
    after = jax.vmap(model.transport)(
        later, fibers, seen(later, origin, driven.states[1:])
    )
    alone = fibers._replace(
        A=jax.tree.map(jnp.zeros_like, fibers.A), B=jnp.zeros_like(fibers.B)
    )
    residual = jax.vmap(model.step)(alone, before, driven.controls)

    def features(env: Array, control: Array) -> tuple[Array, Array]:
        scaled = scaled_env(space, env, environment)
        local = networks.apply(
            {"params": params["networks"]}, scaled, method="per_environment"
        )
        mixture, embedding = (
            cast(PerEnvironment, local).mixture,
            cast(PerEnvironment, local).embedding,
        )
        u = (control - space.control_mean) / space.control_scale
        return mixture, jnp.outer(jnp.append(embedding, 1.0), u).ravel()

    mixtures, inputs = jax.vmap(features)(driven.envs, driven.controls)
    return Pairs(before.z, after.z - residual.z, mixtures, inputs)


def _first(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], tree)
