"""Initial parameters whose linear part is identified from data for the initial lift."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._identification import bounded_ridge
from sfkd_jax.models.sfkd._bounds import attainable, unbounded
from sfkd_jax.models.sfkd._budget import budget_factors
from sfkd_jax.models.sfkd._dynamics import Dynamics
from sfkd_jax.rollout import fibers_along
from sfkd_jax.types import Key, Model, Params, Trajectory


class Pairs(NamedTuple):
    """Transitions as regressors and targets.

    Attributes:
        before: z_k.
        after: z_{k+1} transported back to the fiber of e_k, minus the residual at z_k.
        mixtures: w(e_k).
        inputs: (ψ(e_k), 1) ⊗ u_k.
    """

    before: Float[Array, "*sample rank"]
    after: Float[Array, "*sample rank"]
    mixtures: Float[Array, "*sample vertex"]
    inputs: Float[Array, "*sample feature"]


def identify_start(
    model: Model,
    dynamics: Dynamics,
    params: Params,
    data: Trajectory,
    key: Key,
    *,
    transitions: int = 20000,
    ridge: float = 1e-4,
    iterations: int = 200,
) -> Params:
    """Return params whose A_j and B(e) solve (eq:koopid) for their other parts.

        min Σ_k |T(e_{k+1} → e_k) z_{k+1} − r(z_k; u_k, e_k)
                 − Σ_j w_j(e_k) A_j z_k − B(e_k) u_k|² + ridge

    Lift, embedding, mixture and residual are those of `params`. The bound is the
    model's own, in the coordinates in which the model has it: with a joint budget A_j =
    α L M_j R' that is ||M_j|| ≤ 1 and the sum of squares is that of L⁻¹ times the
    errors. The Gram bound overestimates norms, so the search is over matrices that
    every choice of singular values can attain (`attainable`), up to 2.7 % smaller at
    rank 32, and `bounded` maps the raw parameters back to them exactly.

    Args:
        model: SFKD.
        dynamics: of the same model.
        params: of the model.
        data: trajectories, a random part of which is used.
        key: consumed.
        transitions: largest number, approximately.
        ridge: of `bounded_ridge`.
        iterations: of `bounded_ridge`.
    """
    networks = dynamics.networks
    order = jax.random.permutation(key, data.controls.shape[0])
    chosen = order[: max(transitions // data.controls.shape[1], 1)]
    subset = jax.tree.map(lambda leaf: leaf[chosen], data)
    by_trajectory = jax.vmap(lambda one: _pairs(model, dynamics, params, one))(subset)
    pairs = jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), by_trajectory)
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
    linear = {"operators": jax.vmap(unbounded)(operators), "input_head": head}
    return params | {"networks": raw | linear}


def _pairs(model: Model, dynamics: Dynamics, params: Params, data: Trajectory) -> Pairs:
    """The transitions of one trajectory."""
    fibers, later = fibers_along(model, params, data)
    first = jax.tree.map(lambda leaf: leaf[0], fibers)
    origin = model.encode(first, data.states[0])
    observe = jax.vmap(model.observe, in_axes=(0, None, 0))
    before = observe(fibers, origin, data.states[:-1])
    after = jax.vmap(model.transport)(
        later, fibers, observe(later, origin, data.states[1:])
    )
    without_linear = fibers._replace(
        A=jax.tree.map(jnp.zeros_like, fibers.A), B=jnp.zeros_like(fibers.B)
    )
    residual = jax.vmap(model.step)(without_linear, before, data.controls)

    def features(env: Array, control: Array) -> tuple[Array, Array]:
        local = dynamics.per_environment(params, env)
        space = dynamics.space
        u = (control - space.control_mean) / space.control_scale
        inputs = jnp.outer(jnp.append(local.embedding, 1.0), u).ravel()
        return local.mixture, inputs

    mixtures, inputs = jax.vmap(features)(data.envs, data.controls)
    return Pairs(before.z, after.z - residual.z, mixtures, inputs)
