"""The control step that all planners share: warm start, search, limits, fallback."""

from __future__ import annotations

import functools
from dataclasses import KW_ONLY, dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.control.planners._gains import feedback_gains
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Evaluated,
    Plan,
    PlannerState,
    Samples,
    SearchResult,
    Tuning,
    all_finite,
    catch_up,
    clip_environment,
    replace_nonfinite,
    shift,
)
from sfkd_jax.control.planners._rollouts import RiskMeasure, Rollouts, risk_measure
from sfkd_jax.control.planners._smoothing import Smoother, plan_smoother
from sfkd_jax.control.tasks._task import PlanningStart, Task
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, Positive, PositiveFraction
from sfkd_jax.types import Control, Controller, ControllerInfo, Key, Params, Scalar

INFO_LEVELS = ("plan", "samples")
"""What a planner reports: the chosen plan, or all candidates as well."""
TASK_STREAM = 31324
"""Folded into the key of a control step for the task's own noise."""
KEY_KINDS = {2: "threefry2x32", 4: "rbg"}
"""Implementations of random keys by the number of words of their data."""


@dataclass(frozen=True, eq=False)
class Planner:
    """The receding-horizon controller of a task; a subclass searches for its best plan.

    Each control step shifts the plan, searches around it, smooths the result, rolls it
    out within the limits, and keeps the perturbations that the limits allowed. The
    stored plan therefore never exceeds the actuators.

    Values that are not finite never enter the plan. If all rollouts are not finite, or
    the observation, environment or reference is not, the controller continues the last
    healthy plan and `info["healthy"]` is False.

    A planner of your own is a subclass with `search`, and `factory(Mine,
    Mine.controller)` its factory; an entry in `build.PLANNERS` gives it settings.

    An environment of shape (particle, ne) holds equally likely environments. The cost
    of a plan is then the `risk` of its trajectories over them, and `info` describes
    the chosen plan in the first one.

    Attributes:
        task: the planning problem.
        horizon: T, number of steps.
        noise_std: scale of a perturbation, one entry a control; initial value in
            `Tuning`.
        num_proposals: number of user-defined plans in the state; they are zeros (the
            law alone) until replaced.
        smoothing_window: of the Savitzky-Golay filter, see `plan_smoother`; 0 for none.
        smoothing_order: of the filter's polynomial.
        risk: "mean", "worst" or "cvar", over the environments.
        risk_level: fraction of the largest costs that "cvar" averages.
        unroll: number of steps of a rollout that are compiled as one, which saves time
            where steps are short; the plan is the same up to rounding.
        sharding: of the samples over devices, for plans of shape (horizon, sample,
            control). Up to the order of sums, the plan does not depend on the number
            of devices, which must divide the number of samples.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.
        several: whether the leading axis of every leaf of an environment runs over
            equally likely ones; None if it does for a matrix alone.
        info_level: "plan", or "samples" to report every candidate as well.
        gain_samples: number of samples, those with the largest weights, from which the
            feedback gains of the plan are computed, see `between_plans`; 0 for none.
    """

    task: Task
    _: KW_ONLY
    horizon: AtLeastTwo = 20
    noise_std: tuple[Positive, ...] = (0.02, 0.3)
    num_proposals: NonNegativeInt = 0
    smoothing_window: NonNegativeInt = 0
    smoothing_order: NonNegativeInt = 2
    risk: str = "mean"
    risk_level: PositiveFraction = 0.25
    unroll: int = 2
    sharding: jax.sharding.Sharding | None = None
    env_low: tuple[float, ...] | None = None
    env_high: tuple[float, ...] | None = None
    several: bool | None = None
    info_level: str = "plan"
    gain_samples: NonNegativeInt = 0

    def __post_init__(self) -> None:
        """Raise a ValueError that names a setting out of its range."""
        channels, std = self.task.low.shape[0], self.noise_std
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1, got {self.horizon}")
        if len(std) != channels or not all(entry > 0 for entry in std):
            raise ValueError(f"noise_std needs {channels} positive numbers, got {std}")
        if self.unroll < 1:
            raise ValueError(f"unroll must be at least 1, got {self.unroll}")
        if self.info_level not in INFO_LEVELS:
            raise ValueError(
                f"info_level must be one of {', '.join(INFO_LEVELS)}, "
                f"got {self.info_level!r}"
            )
        if self.gain_samples < 0:
            raise ValueError(
                f"gain_samples must not be negative, got {self.gain_samples}"
            )
        if self.gain_samples and self.smoothing_window:
            raise ValueError("gain_samples and smoothing_window exclude each other")
        _ = self._risk, self._smooth  # both raise for settings out of range

    def search(self, key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        """Return the best plan near `state.plan`; what a subclass defines.

        Args:
            key: consumed.
            state: with the shifted plan, proposals and tuning.
            evaluate: rolls out plans of shape (horizon, sample, control).
        """
        raise NotImplementedError

    def init(self, key: Key) -> PlannerState:
        """Return the state before the first step: a plan of zeros, the law alone.

        No two entries share a buffer, so that the state can be donated.
        """
        task, channels = self.task, self.task.low.shape[0]
        real = functools.partial(jnp.array, dtype=float)
        tuning = Tuning(
            temperature=jnp.ones(()),
            effective_samples=jnp.zeros(()),
            noise_std=real(self.noise_std),
            elapsed=jnp.ones(()),
            cost=jax.tree.map(real, task.weights),
            constraints=jax.tree.map(real, task.constraint_data),
        )
        return PlannerState(
            plan=jnp.zeros((self.horizon, channels)),
            controls=jnp.zeros((self.horizon, channels)),
            previous=jnp.zeros(channels),
            started=jnp.asarray(False),
            key=jax.random.key_data(key),
            past=jnp.zeros((self.smoothing_window // 2, channels)),
            proposals=jnp.zeros((self.num_proposals, self.horizon, channels)),
            tuning=tuning,
        )

    def act(
        self,
        params: Params,
        state: PlannerState,
        observation: Any,
        env: Any,
        reference: Any,
    ) -> tuple[Control, PlannerState, ControllerInfo]:
        """Return the control of one step, the next state and `ControllerInfo`."""
        task, several = self.task, self._is_several(env)
        task.check(observation, env, reference, self.horizon)
        # What is not finite must be noticed even where neither model nor cost reads it.
        clean = all_finite((observation, env, reference))
        inside = clip_environment(env, self.env_low, self.env_high)
        key = jax.random.wrap_key_data(state.key, impl=KEY_KINDS[state.key.shape[0]])
        # The task has a stream of its own: a search that draws more does not change it.
        search_key, next_key = jax.random.split(key)
        task_key = jax.random.fold_in(key, TASK_STREAM)
        # The stored plan begins one period after the last call; this call may be later.
        elapsed, state = catch_up(state)

        # Everything that all samples share is computed once, outside the rollouts.
        prepare = task.prepare
        start = PlanningStart(state.previous, state.started, task_key)
        if several:
            # Particles differ in e and in the noise of the dynamics, not in the start.
            count = jax.tree.leaves(env)[0].shape[0]
            start = start._replace(key=jax.random.split(task_key, count))
            shared = jax.tree.map(lambda _: None, start)
            axes = (None, None, 0, None, shared._replace(key=0))
            prepare = jax.vmap(prepare, in_axes=axes)
        setup = prepare(params, observation, inside, reference, start)
        risk = self._risk if several else None
        evaluate = Rollouts(task, state.tuning, setup, risk, self.unroll, self.sharding)

        proposed = state
        if setup.proposals is not None:  # the task's, beside the user's
            suggested = setup.proposals[0] if several else setup.proposals
            proposals = jnp.concatenate([state.proposals, suggested])
            proposed = state._replace(proposals=proposals)
        # The search sees rollouts alone, so it works for any task.
        result = self.search(search_key, proposed, evaluate)
        plan = self._smooth(state.past, result.plan)
        # The chosen plan is new (a mean, smoothed): its cost is known from its rollout.
        rollout = evaluate(plan[:, None]).only()
        if task.constraint is not None:
            plan, rollout, result = _keep_constraints(evaluate, plan, rollout, result)
        if self.smoothing_window:  # a smoothed plan can exceed the limits again
            plan = replace_nonfinite(rollout.perturbations, 0.0)

        # Otherwise the last healthy plan continues: it was shifted, its end is held.
        healthy = clean & result.usable & jnp.isfinite(rollout.costs)
        plan = jnp.where(healthy, plan, state.plan)
        controls = jnp.where(healthy, rollout.controls, state.controls)
        # Zeros, the controls before the first plan, may lie outside the box.
        control = jnp.clip(controls[0], task.low, task.high)
        info = self._info(result, rollout, healthy)
        info["env_inside"] = (
            jnp.all(inside == env) if self.env_low else jnp.asarray(True)
        )
        if self.gain_samples:
            gains = feedback_gains(
                evaluate,
                lambda moved: prepare(params, moved, inside, reference, start).start,
                observation,
                result,
                self.gain_samples,
            )
            info["gains"] = jnp.where(healthy, gains, 0.0)
        # Further delay is made up for by the next call.
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

    def _info(
        self, result: SearchResult, rollout: Evaluated, healthy: Bool[Array, ""]
    ) -> ControllerInfo:
        """What is reported of a search and of its plan, `env_inside` excepted."""
        info: dict[str, Any] = {
            "cost": result.cost,
            "mean_cost": rollout.costs,
            "effective_samples": result.effective_samples,
            "healthy": healthy,
            "predicted_states": rollout.states,
        }
        if rollout.violations is not None:
            info["violation"] = rollout.violations
            info["constraints_kept"] = rollout.violations <= 0.0
        if self.info_level == "samples" and result.samples is not None:
            evaluated = result.samples.evaluated
            info["sample_costs"] = evaluated.costs
            info["sample_weights"] = result.samples.weights
            info["sample_plans"] = evaluated.perturbations
            info["sample_states"] = evaluated.states
        return cast(ControllerInfo, info)

    def controller(self) -> Controller:
        """Return the planner as two functions."""
        return Controller(self.init, self.act)

    @functools.cached_property
    def _risk(self) -> RiskMeasure:
        return risk_measure(self.risk, self.risk_level)

    @functools.cached_property
    def _smooth(self) -> Smoother:
        return plan_smoother(
            horizon=self.horizon,
            window=self.smoothing_window,
            order=self.smoothing_order,
        )

    def _is_several(self, env: Any) -> bool:
        """Whether an environment is several that are equally likely."""
        if self.several is not None:
            return self.several
        # A matrix is rows of environments; other trees need `several`.
        return getattr(env, "ndim", 0) == 2

    def _reported(
        self,
        evaluated: Evaluated,
        weights: Array,
        temperature: Scalar | None = None,
    ) -> Samples | None:
        """The candidates of a search, if anything reads them."""
        if self.info_level == "samples" or self.gain_samples:
            return Samples(evaluated, weights, temperature)
        return None


def _keep_constraints(
    evaluate: Evaluate, plan: Plan, rollout: Evaluated, result: SearchResult
) -> tuple[Plan, Evaluated, SearchResult]:
    """The chosen plan, or the best candidate where that violates less.

    The mean of plans that pass an obstacle on both sides hits it. The gains of a single
    candidate are those of the task's feedback law alone, as at an infinite temperature.
    """
    best, samples = result.best, result.samples
    if best is None:
        raise ValueError("constraints need a search that ranks by them: mppi or cem")
    other = evaluate(best[:, None]).only()
    assert other.violations is not None
    assert rollout.violations is not None
    instead = other.violations < rollout.violations
    plan, rollout = jax.tree.map(
        lambda a, b: jnp.where(instead, b, a), (plan, rollout), (best, other)
    )
    if samples is not None and samples.temperature is not None:
        temperature = jnp.where(instead, jnp.inf, samples.temperature)
        samples = samples._replace(temperature=temperature)
    return plan, rollout, result._replace(plan=plan, samples=samples)
