"""What planners carry, search and return, and what is done to plans."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import Control, Key, Scalar

Plan: TypeAlias = Float[Array, "horizon control"]
Plans: TypeAlias = Float[Array, "horizon sample control"]


class Tuning(NamedTuple):
    """Settings that a running planner carries as data: `state._replace(tuning=…)` changes them and compiles nothing.

    Attributes:
        temperature: λ of MPPI, in units of cost.
        effective_samples: what λ is chosen for instead, if the planner was built to.
        noise_std: per control channel, in control units.
        elapsed: sampling periods since the last call; the plan is shifted by as many,
            also by fractions, and by one where this is NaN.
        cost: weights of the task's cost.
    """

    temperature: Scalar
    effective_samples: Scalar
    noise_std: Control
    elapsed: Scalar
    cost: Any


class PlannerState(NamedTuple):
    """What a planner carries from one control step to the next.

    Attributes:
        plan: perturbations ν_0 … ν_{T-1} around the law.
        controls: what they amounted to at the last clean step.
        previous: the control applied last.
        started: whether there was one.
        key: for the next samples.
        past: perturbations applied before the plan, oldest first, as far back as
            smoothing looks; 0 before the start.
        proposals: plans of the user's own, sampled beside the planner's, (proposal,
            horizon, control); they stay until replaced.
        tuning: see `Tuning`.
    """

    plan: Plan
    controls: Plan
    previous: Control
    started: Bool[Array, ""]
    key: Key
    past: Float[Array, "past control"]
    proposals: Float[Array, "proposal horizon control"]
    tuning: Tuning


class Found(NamedTuple):
    """What a search returns.

    Attributes:
        plan: chosen.
        usable: whether any rollout was finite.
        cost: the best seen.
        effective_samples: of the weights.
    """

    plan: Plan
    usable: Bool[Array, ""]
    cost: Scalar
    effective_samples: Scalar


Evaluate: TypeAlias = Callable[[Plans], tuple[Float[Array, " sample"], Plans]]
"""Plans -> costs, and the perturbations that were effective within the limits."""
Search: TypeAlias = Callable[[Key, PlannerState, Evaluate], Found]


def drawn_around(
    plan: Plan, noise: Plans, state: PlannerState
) -> Float[Array, "horizon candidate control"]:
    """Candidates: the plan itself, the plan perturbed, and the proposals of the user."""
    return jnp.concatenate(
        [plan[:, None] + noise.at[:, 0].set(0.0), state.proposals.swapaxes(0, 1)],
        axis=1,
    )


def weighted(weights: Float[Array, " sample"], plans: Plans) -> tuple[Plan, Plan]:
    """Mean and standard deviation of plans, step by step and control by control."""
    mean = jnp.einsum("m,tmc->tc", weights, plans)
    return mean, jnp.sqrt(
        jnp.einsum("m,tmc->tc", weights, (plans - mean[:, None]) ** 2)
    )


def finite_or_dear(costs: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """Infinity in place of what is not finite: a bad rollout is never the cheapest."""
    return jnp.where(jnp.isfinite(costs), costs, jnp.inf)


def shift(plan: Plan, elapsed: Scalar) -> Plan:
    """The plan as it stands `elapsed` sampling periods later: linear between its steps, its last step held."""
    last = plan.shape[0] - 1
    times = jnp.clip(jnp.arange(plan.shape[0]) + elapsed, 0, last)
    index = jnp.floor(times).astype(int)
    after = plan[jnp.minimum(index + 1, last)]
    return plan[index] + (times - index)[:, None] * (after - plan[index])


def finite_or_zero(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Zero in place of what is not finite."""
    return jnp.where(jnp.isfinite(values), values, 0.0)


def by_chunks(roll: Callable[[Plans], Any], plans: Plans, chunk: int) -> Any:
    """Roll out all plans, `chunk` at a time; the sample axis of every result is its last, or second to last."""
    horizon, count, channels = plans.shape
    if not chunk or chunk >= count:
        return roll(plans)
    parts = (
        jnp.pad(plans, ((0, 0), (0, -count % chunk), (0, 0)))
        .reshape(horizon, -1, chunk, channels)
        .swapaxes(0, 1)
    )
    costs, tracks = jax.lax.map(roll, parts)

    def joined(leaf: Array) -> Array:
        return jnp.moveaxis(leaf, 0, -3).reshape(*leaf.shape[1:-2], -1, leaf.shape[-1])[
            ..., :count, :
        ]

    return joined(costs[..., None])[..., 0], jax.tree.map(joined, tracks)


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every entry of every leaf is finite."""
    return jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)])
    )
