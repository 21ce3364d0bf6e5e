"""The state of a planner, what a search is given and returns, operations on plans."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from sfkd_jax.types import Control, Scalar

Plan: TypeAlias = Float[Array, "horizon control"]
Plans: TypeAlias = Float[Array, "horizon sample control"]


class Tuning(NamedTuple):
    """Settings that are data of a running planner: changing them recompiles nothing.

    Set them with `tuned(state, temperature=…)`, which keeps their types.

    Attributes:
        temperature: λ of MPPI, in units of cost.
        effective_samples: target of 1 / Σ w² from which λ follows, for planners built
            with one.
        noise_std: per control channel, in control units.
        elapsed: sampling periods since the last call. The plan is shifted by as many,
            fractions included; NaN counts as one, and so does every later call that
            does not set it again.
        cost: weights of the task's cost.
        constraints: data of the task's constraints, see `constrained`.
    """

    temperature: Scalar
    effective_samples: Scalar
    noise_std: Control
    elapsed: Scalar
    cost: Any
    constraints: Any = ()


class PlannerState(NamedTuple):
    """What a planner carries from one control step to the next.

    Attributes:
        plan: perturbations ν_0 … ν_{T-1} of the law.
        controls: the controls of the last healthy rollout of that plan.
        previous: the control applied last.
        started: whether a control was planned before.
        key: data of the random key of the next samples, so that the state consists of
            plain arrays and can be stored.
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
    key: UInt32[Array, " word"]
    past: Float[Array, "past control"]
    proposals: Float[Array, "proposal horizon control"]
    tuning: Tuning


class Evaluated(NamedTuple):
    """What the rollouts of plans came to, in one environment or in several.

    Attributes:
        costs: of the whole rollouts; of several environments, the risk over them.
        controls: applied, within the limits; of several environments, in the first.
        perturbations: that the limits allowed; of several environments, their mean.
        states: predicted, (horizon, sample, …); of several environments, in the first.
        violations: the largest of a constraint over the horizon and the environments,
            not below 0; None without constraints.
    """

    costs: Float[Array, " sample"]
    controls: Plans
    perturbations: Plans
    states: Any
    violations: Float[Array, " sample"] | None = None

    def only(self) -> Evaluated:
        """Return the rollout of a single plan, without the axis of the samples."""
        controls, perturbations, states = jax.tree.map(
            lambda leaf: leaf[:, 0], (self.controls, self.perturbations, self.states)
        )
        violation = None if self.violations is None else self.violations[0]
        return Evaluated(self.costs[0], controls, perturbations, states, violation)


Evaluate: TypeAlias = Callable[[Plans], Evaluated]
"""Rolls out plans."""


class Samples(NamedTuple):
    """The candidates of the last iteration of a search.

    Attributes:
        evaluated: costs, perturbations and states.
        weights: in the chosen plan.
        temperature: λ of the weights; None if they do not depend smoothly on the costs.
    """

    evaluated: Evaluated
    weights: Float[Array, " sample"]
    temperature: Scalar | None = None


class SearchResult(NamedTuple):
    """The outcome of a search.

    Attributes:
        plan: the chosen plan.
        usable: whether any rollout had a finite cost.
        cost: the lowest cost of all samples.
        effective_samples: 1 / Σ w² of the sample weights.
        samples: the candidates, for a planner that reports them.
        best: the best single candidate, for a task with constraints.
    """

    plan: Plan
    usable: Bool[Array, ""]
    cost: Scalar
    effective_samples: Scalar
    samples: Samples | None = None
    best: Plan | None = None


def tuned(state: PlannerState, **changes: Any) -> PlannerState:
    """Return the state with other entries of `Tuning`, of the types that it has.

    A plain number in their place would be of a weaker type, and compile the planner
    again.

    Args:
        state: of a planner.
        changes: entries of `Tuning`; of `cost`, any part of a dict.

    Raises:
        ValueError: an unknown entry, or another shape.
    """
    before = state.tuning._asdict()
    for name, value in changes.items():
        if name not in before:
            known = ", ".join(before)
            raise ValueError(f"unknown tuning {name!r}; choose of {known}")
        if name == "cost" and isinstance(before[name], dict):
            if unknown := value.keys() - before[name].keys():
                raise ValueError(
                    f"the cost has no weights {', '.join(sorted(unknown))}"
                )
            # Weights that are not named keep their values.
            value = before[name] | value
        before[name] = jax.tree.map(partial(_of_type, name), before[name], value)
    return state._replace(tuning=Tuning(**before))


def _of_type(name: str, before: Array, value: Any) -> Array:
    """A value as an array of the type of the one before."""
    after = jnp.asarray(value, dtype=before.dtype)
    if after.shape != before.shape:
        raise ValueError(
            f"tuning {name} must have shape {before.shape}, got {after.shape}"
        )
    return after


def candidate_plans(
    plan: Plan, noise: Plans, state: PlannerState
) -> Float[Array, "horizon candidate control"]:
    """Return the plan itself, its perturbed copies, and the user's proposals."""
    # Sample 0 without noise: the plan itself is always among the candidates.
    return jnp.concatenate(
        [plan[:, None] + noise.at[:, 0].set(0.0), state.proposals.swapaxes(0, 1)],
        axis=1,
    )


def replace_nonfinite(
    values: Float[Array, "*shape"], fill: float
) -> Float[Array, "*shape"]:
    """Replace NaN and infinity by `fill`."""
    return jnp.where(jnp.isfinite(values), values, fill)


def shift(plan: Plan, elapsed: Scalar) -> Plan:
    """Shift a plan by `elapsed` periods: linear in between, the last step held."""
    last = plan.shape[0] - 1
    steps = jnp.arange(plan.shape[0], dtype=plan.dtype)
    times = jnp.clip(steps + elapsed, 0, last)
    whole = jnp.floor(times)
    index = whole.astype(int)
    after = plan[jnp.minimum(index + 1, last)]
    return plan[index] + (times - whole)[:, None] * (after - plan[index])


def catch_up(state: PlannerState) -> tuple[Scalar, PlannerState]:
    """Shift the plan of a late call; return the elapsed periods as well.

    The stored plan is that of one period after the last call. `elapsed` is known only
    at the next call, so any further delay is made up for here.
    """
    # A clock that fails gives NaN; the call then counts as being in time.
    elapsed = jnp.where(jnp.isnan(state.tuning.elapsed), 1.0, state.tuning.elapsed)
    late = jnp.maximum(elapsed - 1.0, 0.0)
    return elapsed, state._replace(
        plan=shift(state.plan, late), controls=shift(state.controls, late)
    )


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every real or complex entry of every leaf is finite."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    real = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(
        jnp.stack([jnp.asarray(True), *(jnp.all(jnp.isfinite(leaf)) for leaf in real)])
    )


def clip_environment(
    env: Any, low: tuple[float, ...] | None, high: tuple[float, ...] | None
) -> Any:
    """Clip an environment to its box, if there is one."""
    if low is None or high is None:
        return env
    box = (jnp.asarray(end, dtype=env.dtype) for end in (low, high))
    lowest, highest = (jnp.broadcast_to(end, env.shape) for end in box)
    return jnp.clip(env, lowest, highest)
