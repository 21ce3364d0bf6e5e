"""The state and the search interface of planners, and operations on plans."""

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
    """Settings that are data of a running planner: changing them recompiles nothing.

    Set them with `state._replace(tuning=state.tuning._replace(…))`.

    Attributes:
        temperature: λ of MPPI, in units of cost.
        effective_samples: target of 1 / Σ w² from which λ follows, for planners built
            with one.
        noise_std: per control channel, in control units.
        elapsed: sampling periods since the last call. The plan is shifted by as many,
            fractions included; NaN counts as one.
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
        plan: perturbations ν_0 … ν_{T-1} of the law.
        controls: the controls of the last healthy rollout of that plan.
        previous: the control applied last.
        started: whether a control was planned before.
        key: random key of the next samples.
        past: perturbations applied before the plan, oldest first, as many as smoothing
            needs; zero before the start.
        proposals: the user's own plans, evaluated beside the sampled ones at every
            step, (proposal, horizon, control).
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


class SearchResult(NamedTuple):
    """The outcome of a search.

    Attributes:
        plan: the chosen plan.
        usable: whether any rollout had a finite cost.
        cost: the lowest cost of all samples.
        effective_samples: 1 / Σ w² of the sample weights.
    """

    plan: Plan
    usable: Bool[Array, ""]
    cost: Scalar
    effective_samples: Scalar


Evaluate: TypeAlias = Callable[[Plans], tuple[Float[Array, " sample"], Plans]]
"""Plans -> their costs, and the perturbations that the limits allowed."""
Search: TypeAlias = Callable[[Key, PlannerState, Evaluate], SearchResult]


def candidate_plans(
    plan: Plan, noise: Plans, state: PlannerState
) -> Float[Array, "horizon candidate control"]:
    """Return the plan itself, its perturbed copies, and the user's proposals."""
    return jnp.concatenate(
        [plan[:, None] + noise.at[:, 0].set(0.0), state.proposals.swapaxes(0, 1)],
        axis=1,
    )


def weighted_mean_and_std(
    weights: Float[Array, " sample"], plans: Plans
) -> tuple[Plan, Plan]:
    """Return mean and standard deviation over the samples, step by step."""
    mean = jnp.einsum("m,tmc->tc", weights, plans)
    return mean, jnp.sqrt(
        jnp.einsum("m,tmc->tc", weights, (plans - mean[:, None]) ** 2)
    )


def replace_nonfinite(
    values: Float[Array, "*shape"], fill: float
) -> Float[Array, "*shape"]:
    """Replace NaN and infinity by `fill`."""
    return jnp.where(jnp.isfinite(values), values, fill)


def shift(plan: Plan, elapsed: Scalar) -> Plan:
    """Shift a plan by `elapsed` periods: linear in between, the last step held."""
    last = plan.shape[0] - 1
    times = jnp.clip(jnp.arange(plan.shape[0]) + elapsed, 0, last)
    index = jnp.floor(times).astype(int)
    after = plan[jnp.minimum(index + 1, last)]
    return plan[index] + (times - index)[:, None] * (after - plan[index])


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every entry of every leaf is finite."""
    return jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)])
    )


def clip_environment(
    env: Float[Array, "*particle environment"],
    low: tuple[float, ...] | None,
    high: tuple[float, ...] | None,
) -> Float[Array, "*particle environment"]:
    """Clip an environment to its box, if there is one."""
    if low is None or high is None:
        return env
    return jnp.clip(env, jnp.array(low), jnp.array(high))
