"""The frame that all planners share: warm start, clean state, limits, one scan over the horizon."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.control.planners._plans import (
    PlannerState,
    Plans,
    Search,
    Tuning,
    all_finite,
    by_chunks,
    finite_or_zero,
    shift,
)
from sfkd_jax.control.planners._risk import risk_measure
from sfkd_jax.control.planners._smoothing import plan_smoother
from sfkd_jax.control.tasks._task import Applied, Began, Environments, Task
from sfkd_jax.types import Control, Controller, Key, Params, State


def planner(
    task: Task,
    search: Search,
    *,
    horizon: int = 20,
    temperature: float = 5.0,
    effective_samples: float = 0.0,
    noise_std: tuple[float, ...] = (0.02, 0.3),
    num_proposals: int = 0,
    smoothing_window: int = 0,
    smoothing_order: int = 2,
    risk: str = "mean",
    risk_level: float = 0.25,
    chunk: int = 0,
    sharding: jax.sharding.Sharding | None = None,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
) -> Controller:
    """A `Controller` out of a task and a search for its best plan.

    Each step shifts the plan, searches around it, smooths what was found, rolls it out
    within the limits, and keeps the perturbations that were effective, so a plan never
    asks for more than the actuators give.

    What is not finite never enters the plan: if all rollouts are bad, or the
    observation, environment or reference is, the last clean plan is continued and
    `info["healthy"]` is False.

    An environment of shape (particle, ne) holds equally likely ones: a plan's cost is
    the `risk` of its whole trajectories over them, and what is reported of the chosen
    plan is its course under the first.

    Args:
        task: what is planned.
        search: how; see `mppi`, `cem`, `gradient_planner`, which call this.
        horizon: T.
        temperature, effective_samples, noise_std: where `Tuning` starts.
        num_proposals: how many plans of the user's own the state holds; zeros (the law
            alone) until replaced.
        smoothing_window, smoothing_order: of the Savitzky-Golay filter on ν, see
            `plan_smoother`; 0 for none.
        risk: "mean", "worst" or "cvar", of trajectories over environments.
        risk_level: share of the worst that "cvar" averages.
        chunk: roll out so many samples at a time, to bound memory; 0 for all at once.
        sharding: of samples over devices, for plans of shape (horizon, sample,
            control); the same plan comes out, up to the order of sums, on any number of
            devices that divides the samples.
        env_low, env_high: certified environment box; an environment outside is clamped
            and flagged.

    Returns:
        A `Controller`; `info` has `cost` (best), `mean_cost` (of the plan chosen),
        `effective_samples`, `healthy`, `env_inside`, `predicted_states` (horizon,
        state) of the plan that was chosen.

    Raises:
        ValueError: settings that cannot be meant, or a filter that does not fit the
            horizon or smooths nothing.
    """
    if len(noise_std) != task.low.shape[0] or not all(std > 0 for std in noise_std):
        raise ValueError(
            f"noise_std needs {task.low.shape[0]} positive numbers, got {noise_std}"
        )
    smooth = plan_smoother(
        horizon=horizon, window=smoothing_window, order=smoothing_order
    )
    measure = risk_measure(risk, risk_level)
    final_step = jnp.zeros(horizon).at[-1].set(1.0)
    first = Tuning(
        temperature=jnp.asarray(temperature, dtype=float),
        effective_samples=jnp.asarray(effective_samples, dtype=float),
        noise_std=jnp.asarray(noise_std, dtype=float),
        elapsed=jnp.ones(()),
        cost=jax.tree.map(
            lambda weight: jnp.asarray(weight, dtype=float), task.weights
        ),
    )

    def init(key: Key) -> PlannerState:
        zeros = jnp.zeros((horizon, task.low.shape[0]))
        proposals = jnp.zeros((num_proposals, *zeros.shape))
        past = zeros[: smoothing_window // 2]
        return PlannerState(
            zeros, zeros, zeros[0], jnp.asarray(False), key, past, proposals, first
        )

    def roll(
        weights: Any, began: Began, plans: Plans
    ) -> tuple[Array, tuple[Plans, Plans, Array]]:
        """All samples in one scan over the horizon: costs (sample,), then controls, perturbations, states by step."""
        shape = plans.shape[1]
        batch = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (shape, *leaf.shape)), began.start
        )

        def body(carry: Any, inputs: Any) -> Any:
            costs, samples = carry
            nus, target, last = inputs
            step = jax.vmap(task.advance, in_axes=(None, None, 0, 0, None, None))
            after = step(weights, began.context, samples, nus, target, last)
            return (costs + after.cost, after.sample), (
                after.control,
                after.perturbation,
                after.state,
            )

        (costs, _), tracks = jax.lax.scan(
            body, (jnp.zeros(shape), batch), (plans, began.targets, final_step)
        )
        return costs, tracks

    def act(
        params: Params,
        state: PlannerState,
        observation: State,
        env: Environments,
        reference: Any,
    ) -> tuple[Control, PlannerState, dict[str, Array]]:
        task.check(observation, env, reference, horizon)
        # A plan is kept as of one period after it was made; of a call that comes later,
        # only the call knows. Without a number, as from a clock that fails, the call
        # counts as one that comes in time.
        elapsed = jnp.where(jnp.isnan(state.tuning.elapsed), 1.0, state.tuning.elapsed)
        late = jnp.maximum(elapsed - 1.0, 0.0)
        state = state._replace(
            plan=shift(state.plan, late), controls=shift(state.controls, late)
        )
        search_key, next_key = jax.random.split(state.key)
        clean = all_finite((observation, env, reference))
        inside = (
            env
            if env_low is None or env_high is None
            else jnp.clip(env, jnp.array(env_low), jnp.array(env_high))
        )
        several = env.ndim == 2
        applied = Applied(state.previous, state.started)
        begin = (
            jax.vmap(task.begin, in_axes=(None, None, 0, None, None))
            if several
            else task.begin
        )
        began = begin(params, observation, inside, reference, applied)
        rolled = jax.vmap(roll, in_axes=(None, 0, None)) if several else roll

        def evaluate(plans: Plans) -> tuple[Array, Plans]:
            if (
                sharding is not None and plans.shape[1] > 1
            ):  # a single plan cannot be dealt out
                plans = jax.lax.with_sharding_constraint(plans, sharding)
            costs, (_, effective, _) = by_chunks(
                lambda part: rolled(state.tuning.cost, began, part), plans, chunk
            )
            return (
                (measure(costs), jnp.mean(effective, axis=0))
                if several
                else (costs, effective)
            )

        searched = state
        if began.proposals is not None:
            suggested = began.proposals[0] if several else began.proposals
            searched = state._replace(
                proposals=jnp.concatenate([state.proposals, suggested])
            )
        found = search(search_key, searched, evaluate)
        plan = smooth(state.past, found.plan)
        best, tracks = rolled(state.tuning.cost, began, plan[:, None])
        mean_cost = measure(best)[0] if several else best[0]
        controls, effective, states = (
            track[0, :, 0] if several else track[:, 0] for track in tracks
        )
        healthy = clean & found.usable & jnp.isfinite(mean_cost)
        if smoothing_window:  # a smoothed plan may have left the limits again
            plan = finite_or_zero(effective)

        kept = [(plan, state.plan), (controls, state.controls)]
        plan, controls = (jnp.where(healthy, new, old) for new, old in kept)
        control = jnp.clip(controls[0], task.low, task.high)
        info = {
            "cost": found.cost,
            "mean_cost": mean_cost,
            "effective_samples": found.effective_samples,
            "healthy": healthy,
            "env_inside": jnp.all(inside == env),
            "predicted_states": states,
        }
        elapsed = jnp.minimum(elapsed, 1.0)
        shifted = state._replace(
            plan=shift(plan, elapsed),
            controls=shift(controls, elapsed),
            previous=control,
            started=state.started | healthy,
            key=next_key,
            past=jnp.concatenate([state.past, plan[:1]])[1:],
        )
        return control, shifted, info

    return Controller(init, act)
