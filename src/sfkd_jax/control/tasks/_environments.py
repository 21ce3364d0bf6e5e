"""A task in several environments at once: the risk of a plan over what is not known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.tasks._task import (
    PlanningStart,
    RolloutSetup,
    StepIndex,
    StepResult,
    Task,
)
from sfkd_jax.types import Control, Params, Scalar


def over_environments(task: Task, cvar: float = 1.0) -> Task:
    """Return a task whose environment holds several, each equally likely.

        J = mean of the ⌈cvar · P⌉ largest of the costs J_p of whole trajectories

    Every leaf of the environment, and of the predicted states, has a leading axis of P
    particles. Constraints must hold in all of them; the control shown is that of the
    first.

    Args:
        task: any task.
        cvar: 1 for the mean over the environments, near 0 for the worst of them.

    Raises:
        ValueError: `cvar` is not in (0, 1].
    """
    if not 0 < cvar <= 1:
        raise ValueError(f"cvar must lie in (0, 1], got {cvar}")
    several = _Several(task, cvar)
    return task._replace(
        prepare=several.prepare,
        step=several.step,
        check=several.check,
        constraint=task.constraint and several.constraint,
    )


class _Samples(NamedTuple):
    """One sample in every environment, and what it has cost there so far."""

    samples: Any
    costs: Float[Array, " particle"]


@dataclass(frozen=True, eq=False)
class _Several:
    """The functions of `over_environments`."""

    task: Task
    cvar: float

    def risk(self, costs: Float[Array, " particle"]) -> Scalar:
        """The mean of the largest costs."""
        largest = math.ceil(self.cvar * costs.shape[0])
        return jnp.mean(jax.lax.top_k(costs, largest)[0])

    def check(self, observation: Any, env: Any, reference: Any, horizon: int) -> Any:
        """Check the arguments in the first environment."""
        first = jax.tree.map(lambda leaf: leaf[0], env)
        return self.task.check(observation, first, reference, horizon)

    def prepare(
        self,
        params: Params,
        observation: Any,
        env: Any,
        reference: Any,
        start: PlanningStart,
    ) -> RolloutSetup:
        """Prepare the task in every environment."""
        each = jax.vmap(self.task.prepare, in_axes=(None, None, 0, None, None))
        context, samples, targets = each(params, observation, env, reference, start)
        # The scan of a rollout runs over the leading axis: the horizon first.
        targets = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), targets)
        nothing = jnp.zeros(jax.tree.leaves(env)[0].shape[0])
        return RolloutSetup(context, _Samples(samples, nothing), targets)

    def step(
        self,
        weights: Any,
        context: Any,
        before: _Samples,
        nu: Control,
        target: Any,
        at: StepIndex,
    ) -> StepResult:
        """Make a step in every environment."""
        each = jax.vmap(self.task.step, in_axes=(None, 0, 0, None, 0, None))
        after = each(weights, context, before.samples, nu, target, at)
        costs = before.costs + after.cost
        # The increases add up to the risk of whole trajectories.
        cost = self.risk(costs) - self.risk(before.costs)
        allowed = jnp.mean(after.perturbation, axis=0)
        samples = _Samples(after.sample, costs)
        return StepResult(samples, cost, after.control[0], allowed, after.state)

    def constraint(
        self, data: Any, state: Any, control: Control, target: Any, at: StepIndex
    ) -> Array:
        """The worst violation over the environments."""
        assert self.task.constraint is not None
        each = jax.vmap(self.task.constraint, in_axes=(None, 0, None, 0, None))
        return jnp.max(each(data, state, control, target, at), axis=0)
