"""The control step that all planners share: warm start, search, rollout, fallback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, UInt32

from sfkd_jax.control._factory import Stateful
from sfkd_jax.control._finite import all_finite
from sfkd_jax.control._task import PlanningStart, Task
from sfkd_jax.control.planners._rollouts import Evaluated, Plan, Plans, Rollouts
from sfkd_jax.info import Claim, ControllerInfo, PlanInfo, Reason, first
from sfkd_jax.ranges import AtLeastOne, Positive, check_intervals
from sfkd_jax.types import Control, Key, Params, Scalar

Evaluate: TypeAlias = Callable[[Plans], Evaluated]
"""A function that rolls out plans, (horizon, sample, control)."""
Carry = TypeVar("Carry")
ControllerState = TypeVar("ControllerState")


class Tuning(NamedTuple):
    """Settings that are data of a running planner, so a change compiles nothing again.

    Attributes:
        temperature: λ of MPPI, in units of cost.
        effective_samples: the value of 1 / Σ w² from which λ follows; only a planner
            that was built with such a value reads it.
        noise_std: standard deviation of the samples, in units of each control.
        elapsed: number of sampling periods since the last call. The plan is shifted by
            as many, fractions included. NaN counts as one period. Every call sets the
            entry to one, so a later call counts as one period as well.
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
    """What a planner carries from one control step to the next."""

    plan: Plan  # rows ν_0 … ν_{T-1}, perturbations of the task's law if it has one
    controls: Plan  # the controls of the last healthy rollout of that plan
    previous: Control  # the control that was applied last
    started: Bool[Array, ""]  # whether a control was planned before
    # The data of the random key of the next samples, so that the state is plain arrays.
    key: UInt32[Array, " word"]
    tuning: Tuning


class ChosenPlan(NamedTuple):
    """The plan that is driven, with the results of its rollout.

    Attributes:
        plan: rows of the task.
        cost: of its rollout.
        controls: that the rollout applied.
        states: predicted ones, every leaf (horizon, …).
        violation: the largest value of a constraint; None without constraints.
    """

    plan: Plan
    cost: Scalar
    controls: Plan
    states: Any
    violation: Scalar | None


class SearchResult(NamedTuple):
    """The outcome of a search.

    Attributes:
        plan: the chosen plan.
        usable: whether any rollout had a finite cost.
        cost: the lowest cost of all samples.
        effective_samples: 1 / Σ w² of the sample weights; NaN if nothing is sampled.
        best: the best single candidate, for a task with constraints.
    """

    plan: Plan
    usable: Bool[Array, ""]
    cost: Scalar
    effective_samples: Scalar
    best: Plan | None = None


@dataclass(frozen=True, eq=False)
class Planner(Stateful):
    """The receding-horizon controller of a task; a subclass searches for its best plan.

    Values that are not finite never enter the plan. If no rollout is finite, or the
    observation, environment or reference is not finite, the controller goes on with the
    last healthy plan and `info.plan.healthy` is False. `info.healthy` is also False
    where the reference cannot be followed, see `RolloutSetup.followable`.

    To write another planner, define `search` in a subclass. `factory(Mine,
    Mine.controller)` is then its factory, and an entry in `assembly.PLANNERS` gives it
    settings.

    Attributes:
        task: the planning problem.
        horizon: T, number of steps.
        noise_std: scale of a perturbation, one entry for each control. It is the
            initial value of the entry in `Tuning`.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.
    """

    task: Task
    _: KW_ONLY
    horizon: AtLeastOne = 20
    noise_std: tuple[Positive, ...] = (0.02, 0.3)
    env_low: tuple[float, ...] | None = None
    env_high: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_intervals(self)
        shape = self.task.low.shape
        std = self.noise_std
        if shape not in ((), (len(std),)):
            raise ValueError(f"noise_std needs a number a control, got {std}")

    def search(
        self, key: Key, plan: Plan, tuning: Tuning, evaluate: Evaluate
    ) -> SearchResult:
        """Return the best plan near another one; a subclass defines this.

        A search sees plans and their costs alone, so it works for any task.

        Args:
            key: random key, which the search consumes.
            plan: the shifted plan of the last step, around which to search.
            tuning: settings that are data.
            evaluate: rolls out plans of shape (horizon, sample, control).
        """
        raise NotImplementedError

    def init(self, key: Key) -> PlannerState:
        """Return the state before the first step, whose plan of zeros is the law alone.

        No two entries share a buffer, so the state can be donated.
        """
        shape = (self.horizon, len(self.noise_std))
        as_real = partial(jnp.array, dtype=float)
        tuning = Tuning(
            temperature=jnp.ones(()),
            effective_samples=jnp.zeros(()),
            noise_std=as_real(self.noise_std),
            elapsed=jnp.ones(()),
            cost=jax.tree.map(as_real, self.task.weights),
            constraints=jax.tree.map(as_real, self.task.constraint_data),
        )
        return PlannerState(
            plan=jnp.zeros(shape),
            controls=jnp.zeros(shape),
            previous=jnp.zeros(shape[1]),
            started=jnp.asarray(False),
            key=jax.random.key_data(key),
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
        task = self.task
        tuning = state.tuning
        precise = task.check(observation, env, reference, self.horizon)
        # What is not finite must be noticed even where neither model nor cost reads it.
        clean = all_finite((observation, env, reference))
        inside = self._nearest(env)
        search_key, next_key = jax.random.split(jax.random.wrap_key_data(state.key))
        # A clock that fails gives NaN; the call then counts as being in time.
        elapsed = jnp.where(jnp.isnan(tuning.elapsed), 1.0, tuning.elapsed)
        # The stored plan begins one period after the last call; this call may be later.
        late = jnp.maximum(elapsed - 1.0, 0.0)
        before, controls_before = shift((state.plan, state.controls), late)

        # Everything that all samples share is computed once, outside the rollouts.
        start = PlanningStart(state.previous, state.started)
        setup = task.prepare(params, observation, inside, reference, start)
        evaluate = Rollouts(task, setup, tuning.cost, tuning.constraints)
        result = self.search(search_key, before, tuning, evaluate)
        chosen = self._choose(result, evaluate)

        # If the step is not healthy, the last healthy plan goes on: it was shifted, and
        # its end is held.
        healthy = clean & result.usable & jnp.isfinite(chosen.cost)
        plan = jnp.where(healthy, chosen.plan, before)
        controls = jnp.where(healthy, chosen.controls, controls_before)
        # Zeros, the controls before the first plan, may lie outside the box.
        control = jnp.clip(controls[0], task.low, task.high)
        # A delay of more than one period is made up for by the next call.
        plan, controls = shift((plan, controls), jnp.minimum(elapsed, 1.0))
        after = PlannerState(
            plan=plan,
            controls=controls,
            previous=control,
            started=state.started | healthy,
            key=jax.random.key_data(next_key),
            tuning=tuning._replace(elapsed=jnp.ones_like(tuning.elapsed)),
        )
        env_inside = jnp.asarray(True) if inside is env else jnp.all(inside == env)
        info = ControllerInfo(
            plan=PlanInfo(
                cost=result.cost,
                mean_cost=chosen.cost,
                effective_samples=result.effective_samples,
                healthy=healthy,
                states=chosen.states,
                violation=chosen.violation,
            ),
            claim=_no_claim(precise, setup.followable),
            env_inside=env_inside,
        )
        return control, after, info

    def _nearest(self, env: Any) -> Any:
        """Return the environment, clipped to its box if there is one."""
        if self.env_low is None or self.env_high is None:
            return env
        return jnp.clip(env, jnp.asarray(self.env_low), jnp.asarray(self.env_high))

    def _choose(self, result: SearchResult, evaluate: Evaluate) -> ChosenPlan:
        """Return the plan to drive; it is new (a mean), so it is rolled out once more.

        The mean of plans that pass an obstacle on both sides hits it. With constraints,
        the best single candidate replaces the mean where it violates less.
        """
        plans = result.plan[:, None]
        if self.task.constraint is not None and result.best is not None:
            plans = jnp.stack([result.plan, result.best], axis=1)
        evaluated = evaluate(plans)
        index = 0
        violation = None
        if evaluated.violations is not None:
            index = jnp.argmin(evaluated.violations)
            violation = evaluated.violations[index]
        return ChosenPlan(
            plan=plans[:, index],
            cost=evaluated.costs[index],
            controls=evaluated.controls[:, index],
            states=jax.tree.map(lambda leaf: leaf[:, index], evaluated.states),
            violation=violation,
        )


def _no_claim(
    precise: Bool[Array, ""] | None, followable: Bool[Array, ""] | bool
) -> Claim:
    """Return the claim of a planner alone: none, with what speaks against the inputs.

    Args:
        precise: whether the positions are resolved; None if there are none.
        followable: whether the reference can be followed.
    """
    # A coarse plan is driven, not replaced: it is better than the last one.
    coarse = False if precise is None else ~precise
    reason = first(
        Reason.CERTIFIED,
        (~jnp.asarray(followable), Reason.BAD_REFERENCE),
        (coarse, Reason.IMPRECISE),
        (True, Reason.NO_CERTIFICATE),
    )
    return Claim(reason=reason)


def iterate(
    improve: Callable[[Carry, Key], tuple[Carry, SearchResult]],
    start: Carry,
    key: Key,
    count: int,
) -> SearchResult:
    """Return the result of the last of `count` improvements of a plan."""
    # A single iteration uses the key as it is; a split would change its samples.
    if count == 1:
        return improve(start, key)[1]
    _, results = jax.lax.scan(improve, start, jax.random.split(key, count))
    return jax.tree.map(lambda leaf: leaf[-1], results)


def tuned(state: ControllerState, **changes: Any) -> ControllerState:
    """Return the state of a controller with other values of entries of `Tuning`.

    The values are converted to the types that the entries have. A plain number has a
    weaker type, with which the planner would be compiled again.

    Args:
        state: of a controller; the state of a planner may lie at any depth in it.
        changes: entries of `Tuning`. If `cost` is a dictionary, a part of it suffices.

    Raises:
        ValueError: the state holds no planner, an entry is unknown, or a value has
            another shape.
    """

    def is_planner(node: Any) -> bool:
        return isinstance(node, PlannerState)

    if not any(map(is_planner, jax.tree.leaves(state, is_leaf=is_planner))):
        raise ValueError(f"{type(state).__name__} holds no state of a planner to tune")
    unknown = sorted(set(changes) - set(Tuning._fields))
    if unknown:
        known = ", ".join(Tuning._fields)
        raise ValueError(f"unknown entry of tuning {unknown[0]}; there are {known}")

    def as_before(before: Array, value: Any) -> Array:
        after = jnp.asarray(value, dtype=before.dtype)
        if after.shape != before.shape:
            raise ValueError(f"tuning has shape {before.shape}, got {after.shape}")
        return after

    def change(node: Any) -> Any:
        if not is_planner(node):
            return node
        before = node.tuning
        values = dict(changes)
        if isinstance(before.cost, dict):
            # Weights that are not named keep their values.
            values["cost"] = {**before.cost, **changes.get("cost", {})}
        after = jax.tree.map(as_before, before, before._replace(**values))
        return node._replace(tuning=after)

    return jax.tree.map(change, state, is_leaf=is_planner)


def shift(plans: Any, elapsed: Scalar) -> Any:
    """Shift plans in time by `elapsed` periods.

    Between two steps a plan is interpolated linearly; after its last step it is held.

    Args:
        plans: arrays with the horizon as their leading axis.
        elapsed: number of sampling periods, not below 0.
    """
    steps = jnp.arange(len(jax.tree.leaves(plans)[0]), dtype=elapsed.dtype)
    times = jnp.clip(steps + elapsed, 0, len(steps) - 1)
    whole = jnp.floor(times)
    index = whole.astype(int)
    share = (times - whole)[:, None]
    after = jnp.minimum(index + 1, len(steps) - 1)

    def interpolated(plan: Plan) -> Plan:
        return plan[index] + share * (plan[after] - plan[index])

    return jax.tree.map(interpolated, plans)
