"""Rollouts of many plans of a task: their layout in memory, their costs and batches."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._finite import replace_nonfinite
from sfkd_jax.control._task import RolloutSetup, Sample, StepIndex, Task
from sfkd_jax.rollout import in_batches

Plan: TypeAlias = Float[Array, "horizon control"]
Plans: TypeAlias = Float[Array, "horizon sample control"]
LARGEST_BATCH = 2**25
"""Number of entries of the states of all samples and steps up to which samples are
rolled out at once. That is 128 MiB in float32, and XLA holds a few copies of it.
"""
SHORT_STATE = 24
"""Number of entries of a sample's state up to which samples are the last axis."""
UNROLLED_STEPS = 4
"""Number of steps in one pass of the loop over the horizon, for longer states."""


class Evaluated(NamedTuple):
    """The results of the rollouts of several plans.

    Attributes:
        costs: of the whole rollouts.
        controls: that were applied, within the limits of the actuators.
        perturbations: the parts of the plans that the limits allowed.
        states: predicted ones, every leaf (horizon, sample, …).
        violations: the largest value of a constraint over the horizon, which is not
            above 0 where all constraints are kept; None without constraints.
    """

    costs: Float[Array, " sample"]
    controls: Plans
    perturbations: Plans
    states: Any
    violations: Float[Array, " sample"] | None

    def ranked(self) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
        """Return a rank of each sample, and whether any sample keeps the constraints.

        The rank of a sample is its cost. It is infinite if the rollout is not finite or
        violates a constraint. If all samples violate one, the ranks are the violations.
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


@dataclass(frozen=True, eq=False)
class Rollouts:
    """A function that rolls out plans: (horizon, sample, control) -> `Evaluated`.

    The layout in memory depends on the length of a sample's state. A processor would
    use a fraction of its width for vectors of a few entries, so for short states the
    samples are the last axis, and the costs of all steps are evaluated after the scan.
    Longer states are multiplied faster as rows, and should not leave the cache, so each
    step is charged inside the scan.

    Attributes:
        task: the planning problem.
        setup: what the task evaluated once for this control step.
        weights: of the task's cost.
        constraint_data: that the task's constraint is given.
    """

    task: Task
    setup: RolloutSetup
    weights: Any
    constraint_data: Any

    def __call__(self, plans: Plans) -> Evaluated:
        """Roll out all plans, as many at a time as the memory holds."""
        horizon = plans.shape[0]
        count = plans.shape[1]
        largest = max(LARGEST_BATCH // (self._state_size * horizon), 1)
        # All batches have the same size, so one program serves all of them.
        size = math.ceil(count / math.ceil(count / largest))
        by_sample = in_batches(self._roll_out, jnp.swapaxes(plans, 0, 1), size=size)
        evaluated = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), by_sample)
        # A product, because XLA would fuse a sum with the costs that it adds up. In
        # full precision, because accelerators round factors to ten bits.
        costs = jnp.matmul(
            jnp.ones(horizon, evaluated.costs.dtype),
            evaluated.costs,
            precision=jax.lax.Precision.HIGHEST,
        )
        violations = evaluated.violations
        if violations is not None:
            violations = jnp.max(violations, axis=0)
        return evaluated._replace(costs=costs, violations=violations)

    @property
    def _state_size(self) -> int:
        """Number of entries in the state of one sample."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.setup.start))

    @property
    def _is_short(self) -> bool:
        """Whether samples are the last axis."""
        return self._state_size <= SHORT_STATE

    def _roll_out(self, plans: Float[Array, "sample horizon control"]) -> Evaluated:
        """Roll out one batch; costs and violations are those of each step.

        Every leaf of the result has the axes (sample, horizon, …).
        """
        targets = self.setup.targets
        numbers = jnp.arange(plans.shape[1])
        last = (numbers == plans.shape[1] - 1).astype(plans.dtype)
        steps = StepIndex(numbers, last)
        # The axis of the samples in one step, and in arrays of all steps.
        axis = -1 if self._is_short else 0
        axis_of_all = -1 if self._is_short else 1

        def repeat(leaf: Array) -> Array:
            return jnp.repeat(jnp.expand_dims(leaf, axis), plans.shape[0], axis)

        start = jax.tree.map(repeat, self.setup.start)
        advance = jax.vmap(
            self._advance, in_axes=(axis, (axis, None, None)), out_axes=axis
        )
        _, results = jax.lax.scan(
            advance,
            start,
            (jnp.moveaxis(plans, 0, axis_of_all), targets, steps),
            unroll=1 if self._is_short else UNROLLED_STEPS,
        )
        if self._is_short:
            charge = jax.vmap(
                self._charge, in_axes=(axis, axis, None, None), out_axes=axis
            )
            before = self._samples_before(start, results)
            results = jax.vmap(charge)(before, results, targets, steps)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis_of_all, 0), results)

    def _advance(self, before: Any, inputs: Any) -> Any:
        """Advance one sample by one step: (row of the plan, target, step index)."""
        row, target, step = inputs
        after = self.task.step(
            self.weights, self.setup.context, before, row, target, step
        )
        result = after._replace(sample=None)
        if not self._is_short:
            result = self._charge(before, result, target, step)
        return after.sample, result

    def _charge(self, before: Any, after: Any, target: Any, step: StepIndex) -> Any:
        """Return the cost and the violation of one step of one sample."""
        task = self.task
        cost = after.cost
        if task.cost is not None:
            earlier = before._replace(latent=())
            later = Sample((), after.state, after.control)
            cost = task.cost(self.weights, earlier, later, target, step)
        violation = None
        if task.constraint is not None:
            values = task.constraint(
                self.constraint_data, after.state, after.control, target, step
            )
            # NaN compares as kept, so it must not get through.
            violation = jnp.max(jnp.where(jnp.isnan(values), jnp.inf, values))
        return Evaluated(
            cost, after.control, after.perturbation, after.state, violation
        )

    def _samples_before(self, start: Any, results: Any) -> Any:
        """Return the samples before each step, without latents; None without a cost."""
        if self.task.cost is None:
            return None

        def shifted(first: Array, after: Array) -> Array:
            return jnp.concatenate([first[None], after[:-1]])

        after = Sample((), results.state, results.control)
        return jax.tree.map(shifted, start._replace(latent=()), after)
