"""The control step that all planners share: warm start, search, limits, fallback."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.control.planners._gains import Gains, feedback_gains
from sfkd_jax.control.planners._plans import (
    Evaluated,
    Plan,
    PlannerState,
    Plans,
    Search,
    SearchResult,
    Tuning,
    about_samples,
    all_finite,
    catch_up,
    clip_environment,
    replace_nonfinite,
    shift,
)
from sfkd_jax.control.planners._risk import RiskMeasure
from sfkd_jax.control.planners._rollouts import (
    PlanRollout,
    RollOut,
    evaluate_function,
    roll_out_plan,
    rollout_function,
)
from sfkd_jax.control.planners._smoothing import Smoother
from sfkd_jax.control.tasks._task import PlanningStart, RolloutSetup, StepIndex, Task
from sfkd_jax.types import (
    Control,
    ControllerInfo,
    Key,
    Params,
)


class StepSettings(NamedTuple):
    """Settings of a control step, see `planner`."""

    task: Task
    search: Search
    horizon: int
    num_proposals: int
    smooth: Smoother
    smoothing_window: int
    risk: RiskMeasure
    chunk: int
    unroll: int
    sharding: jax.sharding.Sharding | None
    env_low: tuple[float, ...] | None
    env_high: tuple[float, ...] | None
    several: bool | None
    reports_samples: bool
    gain_samples: int
    tuning: Tuning


TASK_STREAM = 31324
"""Folded into the key of a control step for the task's own noise."""
KEY_KINDS = {2: "threefry2x32", 4: "rbg"}
"""Implementations of random keys by the number of words of their data."""


def initial_state(settings: StepSettings, key: Key) -> PlannerState:
    """The state before the first control step: a plan of zeros, the law alone.

    No two entries share a buffer, so that the state can be donated.
    """
    channels = settings.task.low.shape[0]

    def zeros(*shape: int) -> Array:
        return jnp.zeros((*shape, channels))

    return PlannerState(
        plan=zeros(settings.horizon),
        controls=zeros(settings.horizon),
        previous=zeros(),
        started=jnp.asarray(False),
        key=jax.random.key_data(key),
        past=zeros(settings.smoothing_window // 2),
        proposals=zeros(settings.num_proposals, settings.horizon),
        tuning=jax.tree.map(jnp.array, settings.tuning),
    )


def control_step(
    settings: StepSettings,
    params: Params,
    state: PlannerState,
    observation: Any,
    env: Any,
    reference: Any,
) -> tuple[Control, PlannerState, ControllerInfo]:
    """One control step."""
    task, several = settings.task, _is_several(settings, env)
    task.check(observation, env, reference, settings.horizon)
    elapsed, state = catch_up(state)
    key = jax.random.wrap_key_data(state.key, impl=KEY_KINDS[state.key.shape[0]])
    search_key, next_key = jax.random.split(key)
    task_key = jax.random.fold_in(key, TASK_STREAM)
    clean = all_finite((observation, env, reference))
    inside = clip_environment(env, settings.env_low, settings.env_high)

    prepare = task.prepare
    start = PlanningStart(state.previous, state.started, task_key)
    if several:
        count = jax.tree.leaves(env)[0].shape[0]
        start = start._replace(key=jax.random.split(task_key, count))
        shared = jax.tree.map(lambda _: None, start)
        axes = (None, None, 0, None, shared._replace(key=0))
        prepare = jax.vmap(prepare, in_axes=axes)
    setup = prepare(params, observation, inside, reference, start)
    roll_out = _rollouts(settings, state.tuning, setup, several)
    risk = settings.risk if several else None
    evaluate = evaluate_function(
        roll_out, risk, chunk=settings.chunk, sharding=settings.sharding
    )
    proposed = _with_proposals(state, setup, several=several)
    result = settings.search(search_key, proposed, evaluate)
    plan = settings.smooth(state.past, result.plan)
    rollout = roll_out_plan(roll_out, risk, plan)
    if task.constraint is not None:
        plan, rollout, result = _keep_constraints(
            partial(roll_out_plan, roll_out, risk), plan, rollout, result
        )
    healthy = clean & result.usable & jnp.isfinite(rollout.cost)
    if settings.smoothing_window:  # a smoothed plan can exceed the limits again
        plan = replace_nonfinite(rollout.perturbations, 0.0)

    plan = jnp.where(healthy, plan, state.plan)
    controls = jnp.where(healthy, rollout.controls, state.controls)
    control = jnp.clip(controls[0], task.low, task.high)
    info: ControllerInfo = {
        "cost": result.cost,
        "mean_cost": rollout.cost,
        "effective_samples": result.effective_samples,
        "healthy": healthy,
        "env_inside": _is_inside(settings, env, inside),
        "predicted_states": rollout.states,
        **about_samples(result.samples if settings.reports_samples else None),
    }
    if rollout.violation is not None:
        info["violation"] = rollout.violation
        info["constraints_kept"] = rollout.violation <= 0.0
    if settings.gain_samples:
        gains = _gains(
            settings,
            state.tuning,
            setup,
            lambda moved: prepare(params, moved, inside, reference, start).start,
            observation,
            result,
            several,
        )
        info["gains"] = jnp.where(healthy, gains, 0.0)
    elapsed = jnp.minimum(elapsed, 1.0)
    after = state._replace(
        plan=shift(plan, elapsed),
        controls=shift(controls, elapsed),
        previous=control,
        started=state.started | healthy,
        key=jax.random.key_data(next_key),
        past=jnp.concatenate([state.past, plan[:1]])[1:],
        tuning=state.tuning._replace(elapsed=jnp.ones_like(state.tuning.elapsed)),
    )
    return control, after, info


def _keep_constraints(
    roll_out: Callable[[Plan], PlanRollout],
    plan: Plan,
    rollout: PlanRollout,
    result: SearchResult,
) -> tuple[Plan, PlanRollout, SearchResult]:
    """The chosen plan, or the best candidate where that violates less.

    The mean of plans that pass an obstacle on both sides hits it. The gains of a single
    candidate are those of the task's feedback law alone, as at an infinite temperature.
    """
    best, samples = result.best, result.samples
    if best is None:
        raise ValueError("constraints need a search that ranks by them: mppi or cem")
    other = roll_out(best)
    assert other.violation is not None
    assert rollout.violation is not None
    instead = other.violation < rollout.violation
    plan, rollout = jax.tree.map(
        lambda a, b: jnp.where(instead, b, a), (plan, rollout), (best, other)
    )
    if samples is not None and samples.temperature is not None:
        temperature = jnp.where(instead, jnp.inf, samples.temperature)
        samples = samples._replace(temperature=temperature)
    return plan, rollout, result._replace(plan=plan, samples=samples)


def _gains(
    settings: StepSettings,
    tuning: Tuning,
    setup: RolloutSetup,
    start_of: Callable[[Array], Any],
    observation: Array,
    result: SearchResult,
    several: bool,
) -> Gains:
    """The feedback gains of the plan that a search chose; see `feedback_gains`."""
    task = settings.task
    if result.samples is None:
        raise ValueError("gain_samples needs a search that reports its samples")

    def evaluate(start: Any, plans: Plans) -> Evaluated:
        moved = setup._replace(start=start)
        roll_out = _rollouts(settings, tuning, moved, several)
        risk = settings.risk if several else None
        return evaluate_function(roll_out, risk, chunk=0, sharding=None)(plans)

    def control_of(start: Any, perturbation: Control) -> Control:
        context, targets = setup.context, setup.targets
        if several:
            context, start, targets = jax.tree.map(
                lambda leaf: leaf[0], (context, start, targets)
            )
        target = jax.tree.map(lambda leaf: leaf[0], targets)
        at = StepIndex(jnp.zeros((), int), jnp.zeros(()))
        return task.step(tuning.cost, context, start, perturbation, target, at).control

    return feedback_gains(
        result.samples,
        start_of,
        evaluate,
        control_of,
        observation,
        result.plan,
        settings.gain_samples,
    )


def _rollouts(
    settings: StepSettings, tuning: Tuning, setup: RolloutSetup, several: bool
) -> RollOut:
    """The function that rolls out plans from a setup."""
    return rollout_function(
        settings.task, tuning, setup, several=several, unroll=settings.unroll
    )


def _is_several(settings: StepSettings, env: Any) -> bool:
    """Whether an environment is several that are equally likely."""
    if settings.several is not None:
        return settings.several
    return getattr(env, "ndim", 0) == 2


def _is_inside(settings: StepSettings, env: Any, inside: Any) -> Bool[Array, ""]:
    """Whether an environment was not changed by its box."""
    return jnp.all(inside == env) if settings.env_low else jnp.asarray(True)


def _with_proposals(
    state: PlannerState, setup: RolloutSetup, *, several: bool
) -> PlannerState:
    """The state with the task's proposals beside the user's."""
    if setup.proposals is None:
        return state
    suggested = setup.proposals[0] if several else setup.proposals
    return state._replace(proposals=jnp.concatenate([state.proposals, suggested]))
