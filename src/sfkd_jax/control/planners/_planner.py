"""The control step that all planners share: warm start, search, limits, fallback."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.control.planners._plans import (
    INFO_LEVELS,
    PlannerState,
    Search,
    Tuning,
    about_samples,
    all_finite,
    clip_environment,
    replace_nonfinite,
    shift,
)
from sfkd_jax.control.planners._risk import RiskMeasure, risk_measure
from sfkd_jax.control.planners._rollouts import (
    evaluate_function,
    roll_out_plan,
    rollout_function,
)
from sfkd_jax.control.planners._smoothing import Smoother, plan_smoother
from sfkd_jax.control.tasks._task import PlanningStart, RolloutSetup, Task
from sfkd_jax.core.ranges import AtLeastTwo, NonNegativeInt, Positive, PositiveFraction
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Key,
    Params,
    Scalar,
)


class _Settings(NamedTuple):
    """Settings of `planner` as its functions need them."""

    task: Task
    search: Search
    horizon: int
    num_proposals: int
    smooth: Smoother
    smoothing_window: int
    risk: RiskMeasure
    chunk: int
    sharding: jax.sharding.Sharding | None
    env_low: tuple[float, ...] | None
    env_high: tuple[float, ...] | None
    several: bool | None
    tuning: Tuning


def planner(
    task: Task,
    search: Search,
    *,
    horizon: AtLeastTwo = 20,
    temperature: Positive = 5.0,
    effective_samples: float = 0.0,
    noise_std: tuple[Positive, ...] = (0.02, 0.3),
    num_proposals: NonNegativeInt = 0,
    smoothing_window: NonNegativeInt = 0,
    smoothing_order: NonNegativeInt = 2,
    risk: str = "mean",
    risk_level: PositiveFraction = 0.25,
    chunk: NonNegativeInt = 0,
    sharding: jax.sharding.Sharding | None = None,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
    several: bool | None = None,
    info_level: str = "plan",
) -> Controller:
    """Return the receding-horizon controller of a task and a search for its best plan.

    Each control step shifts the plan, searches around it, smooths the result, rolls it
    out within the limits, and keeps the perturbations that the limits allowed. The
    stored plan therefore never exceeds the actuators.

    Values that are not finite never enter the plan. If all rollouts are not finite, or
    the observation, environment or reference is not, the controller continues the last
    healthy plan and `info["healthy"]` is False.

    An environment of shape (particle, ne) holds equally likely environments. The cost
    of a plan is then the `risk` of its trajectories over them, and `info` describes
    the chosen plan in the first one.

    Args:
        task: the planning problem.
        search: the algorithm; see `mppi`, `cem` and `gradient_planner`, which call
            this function.
        horizon: T, number of steps.
        temperature: initial value in `Tuning`.
        effective_samples: initial value in `Tuning`.
        noise_std: initial value in `Tuning`.
        num_proposals: number of user-defined plans in the state; they are zeros (the
            law alone) until replaced.
        smoothing_window: of the Savitzky-Golay filter, see `plan_smoother`; 0 for none.
        smoothing_order: of the filter's polynomial.
        risk: "mean", "worst" or "cvar", over the environments.
        risk_level: fraction of the largest costs that "cvar" averages.
        chunk: number of samples rolled out at a time, to bound the memory; 0 for all
            at once.
        sharding: of the samples over devices, for plans of shape (horizon, sample,
            control). Up to the order of sums, the plan does not depend on the number
            of devices, which must divide the number of samples.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.
        several: whether the leading axis of every leaf of an environment runs over
            equally likely ones; None if it does for a matrix alone.
        info_level: "plan", or "samples" to report every candidate as well.

    Returns:
        A `Controller`; `info` has `cost` (lowest), `mean_cost` (of the chosen plan),
        `effective_samples`, `healthy`, `env_inside` and `predicted_states` (horizon,
        state) of the chosen plan. With `info_level="samples"` it has `sample_costs`,
        `sample_weights`, `sample_plans` (perturbations) and `sample_states` too.

    Raises:
        ValueError: `noise_std` does not fit the task, the horizon or the temperature
            is not positive, the risk is unknown, or the filter does not fit the
            horizon.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    if info_level not in INFO_LEVELS:
        raise ValueError(
            f"info_level must be one of {', '.join(INFO_LEVELS)}, got {info_level!r}"
        )
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, got {temperature}")
    if len(noise_std) != task.low.shape[0] or not all(std > 0 for std in noise_std):
        raise ValueError(
            f"noise_std needs {task.low.shape[0]} positive numbers, got {noise_std}"
        )
    settings = _Settings(
        task=task,
        search=search,
        horizon=horizon,
        num_proposals=num_proposals,
        smooth=plan_smoother(
            horizon=horizon, window=smoothing_window, order=smoothing_order
        ),
        smoothing_window=smoothing_window,
        risk=risk_measure(risk, risk_level),
        chunk=chunk,
        sharding=sharding,
        env_low=env_low,
        env_high=env_high,
        several=several,
        tuning=Tuning(
            temperature=jnp.asarray(temperature, dtype=float),
            effective_samples=jnp.asarray(effective_samples, dtype=float),
            noise_std=jnp.asarray(noise_std, dtype=float),
            elapsed=jnp.ones(()),
            cost=jax.tree.map(
                lambda weight: jnp.asarray(weight, dtype=float), task.weights
            ),
        ),
    )
    return Controller(partial(_init, settings), partial(_act, settings))


TASK_STREAM = 31324
"""Folded into the key of a control step for the task's own noise."""
KEY_KINDS = {2: "threefry2x32", 4: "rbg"}
"""Implementations of random keys by the number of words of their data."""


def _init(settings: _Settings, key: Key) -> PlannerState:
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


def _act(
    settings: _Settings,
    params: Params,
    state: PlannerState,
    observation: Any,
    env: Any,
    reference: Any,
) -> tuple[Control, PlannerState, ControllerInfo]:
    """One control step."""
    task, several = settings.task, _is_several(settings, env)
    task.check(observation, env, reference, settings.horizon)
    elapsed, state = _catch_up(state)
    key = jax.random.wrap_key_data(state.key, impl=KEY_KINDS[state.key.shape[0]])
    search_key, next_key = jax.random.split(key)
    task_key = jax.random.fold_in(key, TASK_STREAM)
    clean = all_finite((observation, env, reference))
    inside = clip_environment(env, settings.env_low, settings.env_high)

    prepare, start = (
        task.prepare,
        PlanningStart(state.previous, state.started, task_key),
    )
    if several:
        count = jax.tree.leaves(env)[0].shape[0]
        start = start._replace(key=jax.random.split(task_key, count))
        shared = jax.tree.map(lambda _: None, start)
        axes = (None, None, 0, None, shared._replace(key=0))
        prepare = jax.vmap(prepare, in_axes=axes)
    setup = prepare(params, observation, inside, reference, start)
    roll_out = rollout_function(task, state.tuning.cost, setup, several=several)
    risk = settings.risk if several else None
    evaluate = evaluate_function(
        roll_out, risk, chunk=settings.chunk, sharding=settings.sharding
    )
    proposed = _with_proposals(state, setup, several=several)
    result = settings.search(search_key, proposed, evaluate)
    plan = settings.smooth(state.past, result.plan)
    rollout = roll_out_plan(roll_out, risk, plan)
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
        **about_samples(result.samples),
    }
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


def _is_several(settings: _Settings, env: Any) -> bool:
    """Whether an environment is several that are equally likely."""
    if settings.several is not None:
        return settings.several
    return getattr(env, "ndim", 0) == 2


def _is_inside(settings: _Settings, env: Any, inside: Any) -> Bool[Array, ""]:
    """Whether an environment was not changed by its box."""
    return jnp.all(inside == env) if settings.env_low else jnp.asarray(True)


def _catch_up(state: PlannerState) -> tuple[Scalar, PlannerState]:
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


def _with_proposals(
    state: PlannerState, setup: RolloutSetup, *, several: bool
) -> PlannerState:
    """The state with the task's proposals beside the user's."""
    if setup.proposals is None:
        return state
    suggested = setup.proposals[0] if several else setup.proposals
    return state._replace(proposals=jnp.concatenate([state.proposals, suggested]))
