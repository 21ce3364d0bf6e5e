"""The control step that all planners share: warm start, search, rollout, fallback."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from sfkd_jax.control._factory import Stateful
from sfkd_jax.control.tasks._task import (
    PlanningStart,
    RolloutSetup,
    Sample,
    StepIndex,
    Task,
)
from sfkd_jax.ranges import AtLeastOne, Positive, check_intervals
from sfkd_jax.rollout import in_batches
from sfkd_jax.types import Control, ControllerInfo, Key, Params, Scalar

Plan: TypeAlias = Float[Array, "horizon control"]
Plans: TypeAlias = Float[Array, "horizon sample control"]
TOGETHER = 2**25
"""Entries of the states of all samples and steps up to which they are rolled out at
once: 128 MiB, of which there are a few copies.
"""
SHORT = 24
"""Entries of a sample's state up to which samples are the last axis of a step."""
UNROLLED = 4
"""Steps of longer states in one pass of a loop."""
C = TypeVar("C")
Memory = TypeVar("Memory")


class Tuning(NamedTuple):
    """Settings that are data of a running planner: changing them recompiles nothing.

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
    """What a planner carries from one control step to the next."""

    plan: Plan  # rows ν_0 … ν_{T-1}, perturbations of the task's law if it has one
    controls: Plan  # the controls of the last healthy rollout of that plan
    previous: Control  # the control applied last
    started: Bool[Array, ""]  # whether a control was planned before
    # Data of the random key of the next samples: the state is plain arrays.
    key: UInt32[Array, " word"]
    tuning: Tuning  # see `Tuning`


class Evaluated(NamedTuple):
    """What the rollouts of plans came to."""

    costs: Float[Array, " sample"]  # of the whole rollouts
    controls: Plans  # applied, within the limits
    perturbations: Plans  # the parts of the plans that the limits allowed
    states: Any  # predicted, (horizon, sample, …)
    # The largest of a constraint over the horizon, not above 0 where all are kept; None
    # without constraints.
    violations: Float[Array, " sample"] | None

    def ranked(self) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
        """Return costs in lexicographic order, and whether a sample keeps constraints.

        The rank of a sample that violates one, or is not finite, is infinite; if all
        violate one, the ranks are the violations.
        """
        costs = replace_nonfinite(self.costs, jnp.inf)
        if self.violations is None:
            return costs, jnp.asarray(True)
        # A rollout that is not finite keeps nothing, whatever its violation says.
        violations = jnp.where(jnp.isfinite(costs), self.violations, jnp.inf)
        kept = violations <= 0.0
        any_kept = jnp.any(kept)
        costs = jnp.where(kept, costs, jnp.inf)
        return jnp.where(any_kept, costs, violations), any_kept


Evaluate: TypeAlias = Callable[[Plans], Evaluated]
"""Rolls out plans."""


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

    Values that are not finite never enter the plan. If all rollouts are not finite, or
    the observation, environment or reference is not, the controller continues the last
    healthy plan and `info["healthy"]` is False. So it is where the reference cannot be
    followed, see `RolloutSetup.followable`.

    A planner of your own is a subclass with `search`, and `factory(Mine,
    Mine.controller)` its factory; an entry in `build.PLANNERS` gives it settings.

    Attributes:
        task: the planning problem.
        horizon: T, number of steps.
        noise_std: scale of a perturbation, one entry a control; initial value in
            `Tuning`.
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
        """Return the best plan near another; what a subclass defines.

        It sees plans and their costs alone, so it works for any task.

        Args:
            key: consumed.
            plan: the shifted one, around which to search.
            tuning: settings that are data.
            evaluate: rolls out plans of shape (horizon, sample, control).
        """
        raise NotImplementedError

    def init(self, key: Key) -> PlannerState:
        """Return the state before the first step: a plan of zeros, the law alone.

        No two entries share a buffer, so that the state can be donated.
        """
        shape = (self.horizon, len(self.noise_std))
        real = partial(jnp.array, dtype=float)
        tuning = Tuning(
            temperature=jnp.ones(()),
            effective_samples=jnp.zeros(()),
            noise_std=real(self.noise_std),
            elapsed=jnp.ones(()),
            cost=jax.tree.map(real, self.task.weights),
            constraints=jax.tree.map(real, self.task.constraint_data),
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
        inside = env
        if self.env_low is not None and self.env_high is not None:
            inside = jnp.clip(
                env, jnp.asarray(self.env_low), jnp.asarray(self.env_high)
            )
        search_key, next_key = jax.random.split(jax.random.wrap_key_data(state.key))
        # A clock that fails gives NaN; the call then counts as being in time.
        elapsed = jnp.where(jnp.isnan(tuning.elapsed), 1.0, tuning.elapsed)
        # The stored plan begins one period after the last call; this one may be later.
        late = jnp.maximum(elapsed - 1.0, 0.0)
        before, held = shift((state.plan, state.controls), late)

        # Everything that all samples share is computed once, outside the rollouts.
        start = PlanningStart(state.previous, state.started)
        setup = task.prepare(params, observation, inside, reference, start)
        evaluate = partial(self._roll_out, tuning, setup)
        result = self.search(search_key, before, tuning, evaluate)

        # The chosen plan is new (a mean): its cost is known from its rollout.
        plans = result.plan[:, None]
        chosen = 0
        if task.constraint is not None and result.best is not None:
            # The mean of plans that pass an obstacle on both sides hits it: the best
            # single candidate replaces it where that violates less.
            plans = jnp.stack([result.plan, result.best], axis=1)
        costs, controls, _, states, violations = evaluate(plans)
        if violations is not None:
            chosen = jnp.argmin(violations)

        # Otherwise the last healthy plan continues: it was shifted, its end is held.
        healthy = clean & result.usable & jnp.isfinite(costs[chosen])
        plan = jnp.where(healthy, plans[:, chosen], before)
        controls = jnp.where(healthy, controls[:, chosen], held)
        # Zeros, the controls before the first plan, may lie outside the box.
        control = jnp.clip(controls[0], task.low, task.high)
        # Further delay is made up for by the next call.
        elapsed = jnp.minimum(elapsed, 1.0)
        plan, controls = shift((plan, controls), elapsed)
        after = PlannerState(
            plan=plan,
            controls=controls,
            previous=control,
            started=state.started | healthy,
            key=jax.random.key_data(next_key),
            tuning=tuning._replace(elapsed=jnp.ones_like(tuning.elapsed)),
        )
        known = jnp.asarray(True) if inside is env else jnp.all(inside == env)
        info: ControllerInfo = {
            "cost": result.cost,
            "mean_cost": costs[chosen],
            "effective_samples": result.effective_samples,
            "healthy": healthy & setup.followable,
            "env_inside": known,
            "predicted_states": jax.tree.map(lambda leaf: leaf[:, chosen], states),
        }
        if precise is not None:
            # A coarse plan is driven, not replaced: it is better than the last one.
            info["precision"] = precise
            info["healthy"] = info["healthy"] & precise
        if violations is not None:
            info["violation"] = violations[chosen]
            info["constraints_kept"] = violations[chosen] <= 0.0
        return control, after, info

    def _roll_out(self, tuning: Tuning, setup: RolloutSetup, plans: Plans) -> Evaluated:
        """Roll out all plans, as many at a time as the memory holds."""
        task = self.task
        start = setup.start
        targets = setup.targets
        numbers = jnp.arange(self.horizon)
        places = StepIndex(numbers, (numbers == self.horizon - 1).astype(plans.dtype))

        # Of vectors of a few entries a processor would use a fraction of its width, so
        # that samples are the last axis, and costs are evaluated for all steps at once.
        # Longer ones it multiplies faster as rows, and should not leave its cache.
        entries = sum(leaf.size for leaf in jax.tree.leaves(start))
        short = entries <= SHORT
        # Axis of the samples in one step, and in arrays of all steps.
        axis, along_steps = (-1, -1) if short else (0, 1)

        def judge(before: Any, after: Any, target: Any, at: StepIndex) -> Any:
            cost = after.cost
            worst = None
            seen = (after.state, after.control)
            if task.cost is not None:
                pair = before._replace(latent=()), Sample((), *seen)
                cost = task.cost(tuning.cost, *pair, target, at)
            if task.constraint is not None:
                every = task.constraint(tuning.constraints, *seen, target, at)
                # NaN compares as kept, so it must not get through.
                worst = jnp.max(jnp.where(jnp.isnan(every), jnp.inf, every))
            return Evaluated(
                cost, after.control, after.perturbation, after.state, worst
            )

        def body(before: Any, inputs: Any) -> Any:
            after = task.step(tuning.cost, setup.context, before, *inputs)
            seen = after._replace(sample=None)
            return after.sample, seen if short else judge(before, seen, *inputs[1:])

        step = jax.vmap(body, in_axes=(axis, (axis, None, None)), out_axes=axis)
        each = jax.vmap(judge, in_axes=(axis, axis, None, None), out_axes=axis)

        def together(plans: Array) -> Any:
            count = plans.shape[0]
            first = jax.tree.map(
                lambda leaf: jnp.repeat(jnp.expand_dims(leaf, axis), count, axis), start
            )
            inputs = jnp.moveaxis(plans, 0, along_steps), targets, places
            _, seen = jax.lax.scan(step, first, inputs, unroll=1 if short else UNROLLED)
            if short:
                before = None
                if task.cost is not None:
                    before = jax.tree.map(
                        lambda leaf, rest: jnp.concatenate([leaf[None], rest[:-1]]),
                        first._replace(latent=()),
                        Sample((), seen.state, seen.control),
                    )
                seen = jax.vmap(each)(before, seen, targets, places)
            return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, along_steps, 0), seen)

        # Batches of one size.
        most = max(TOGETHER // (entries * self.horizon), 1)
        size = math.ceil(plans.shape[1] / math.ceil(plans.shape[1] / most))
        along = jax.tree.map(
            lambda leaf: jnp.swapaxes(leaf, 0, 1),
            in_batches(together, jnp.swapaxes(plans, 0, 1), size=size),
        )
        worst = along.violations
        ones = jnp.ones(self.horizon, along.costs.dtype)
        # A product: a sum would be one loop with the costs that it is over. In full
        # precision: accelerators round factors to ten bits.
        exact = jax.lax.Precision.HIGHEST
        return along._replace(
            costs=jnp.matmul(ones, along.costs, precision=exact),
            violations=None if worst is None else jnp.max(worst, axis=0),
        )


def iterate(
    improve: Callable[[C, Key], tuple[C, SearchResult]], start: C, key: Key, count: int
) -> SearchResult:
    """Return the result of the last of several improvements of a plan."""
    # Splitting the key would change the plans of a single iteration.
    if count == 1:
        return improve(start, key)[1]
    _, results = jax.lax.scan(improve, start, jax.random.split(key, count))
    return jax.tree.map(lambda leaf: leaf[-1], results)


def tuned(state: Memory, **changes: Any) -> Memory:
    """Return the state with other entries of `Tuning`, of the types that it has.

    A plain number would be of a weaker type, and compile the planner again.

    Args:
        state: of a controller, in which a planner's is found however deep it lies.
        changes: entries of `Tuning`; of `cost`, any part of a dict.

    Raises:
        ValueError: no planner, an unknown entry, or another shape.
    """

    def is_planner(node: Any) -> bool:
        return isinstance(node, PlannerState)

    if not any(map(is_planner, jax.tree.leaves(state, is_leaf=is_planner))):
        raise ValueError(f"{type(state).__name__} holds no state of a planner to tune")
    if unknown := sorted(set(changes) - set(Tuning._fields)):
        known = ", ".join(Tuning._fields)
        raise ValueError(f"unknown entry of tuning {unknown[0]}; there are {known}")

    def of_type(before: Array, value: Any) -> Array:
        after = jnp.asarray(value, dtype=before.dtype)
        if after.shape != before.shape:
            raise ValueError(f"tuning has shape {before.shape}, got {after.shape}")
        return after

    def change(node: Any) -> Any:
        if not is_planner(node):
            return node
        before = node.tuning
        wanted = dict(changes)
        if isinstance(before.cost, dict):
            # Weights that are not named keep their values.
            wanted["cost"] = before.cost | changes.get("cost", {})
        after = jax.tree.map(of_type, before, before._replace(**wanted))
        return node._replace(tuning=after)

    return jax.tree.map(change, state, is_leaf=is_planner)


def shift(plans: Any, elapsed: Scalar) -> Any:
    """Shift plans by `elapsed` periods: linear in between, the last step held."""
    steps = jnp.arange(len(jax.tree.leaves(plans)[0]), dtype=elapsed.dtype)
    times = jnp.clip(steps + elapsed, 0, len(steps) - 1)
    whole = jnp.floor(times)
    index = whole.astype(int)
    share = (times - whole)[:, None]
    after = jnp.minimum(index + 1, len(steps) - 1)
    return jax.tree.map(lambda p: p[index] + share * (p[after] - p[index]), plans)


def replace_nonfinite(
    values: Float[Array, "*shape"], fill: float
) -> Float[Array, "*shape"]:
    """Replace NaN and infinity by `fill`."""
    return jnp.where(jnp.isfinite(values), values, fill)


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every real or complex entry of every leaf is finite."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    real = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(
        jnp.stack([jnp.asarray(True), *(jnp.all(jnp.isfinite(leaf)) for leaf in real)])
    )
