"""The planning task of a system that follows its reference around a law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control import (
    PlanningStart,
    RolloutSetup,
    Sample,
    StepIndex,
    StepResult,
    Task,
    factory,
    size_of,
)
from sfkd_jax.geometry import entrywise, without_pose
from sfkd_jax.ranges import NonNegative
from sfkd_jax.rollout import fold
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.systems._law import SteadyState
from sfkd_jax.systems._tracking import Error, Inputs
from sfkd_jax.types import BODY, Control, Environment, Model, Params, Scalar


class Target(NamedTuple):
    """What all samples share of one step.

    Attributes:
        inputs: ρ.
        steady: of the law.
        fiber: of the model with this ρ; None if it is that of all steps.
    """

    inputs: Inputs
    steady: SteadyState
    fiber: Any


@dataclass(frozen=True, eq=False)
class TrackingTask:
    """The task of following a reference with a model of the closed loop.

        ξ_{k+1} = F(ξ_k, (ν_k, ρ_k); e),   u_k = clip(law(ξ_k; ρ_k, e) + ν_k)
        J = Σ_k Σ_i |y_i,k / s_i|² + w |(u_k − u_{k−1}) / h|²

    A plan is the perturbation ν of the law, and the reference of the task is ρ. |ν|
    stays within `law.perturbation`, as in the training data; h is half of the range of
    each control.

    Attributes:
        loop: the closed loop that the model is of.
        model: that is rolled out.
        scales: s_i of each output, in its unit.
        smoothness: w.
    """

    loop: ClosedLoop
    model: Model
    _: KW_ONLY
    scales: Mapping[str, float]
    smoothness: NonNegative = 0.05

    def task(self) -> Task:
        """Return the planning problem as functions."""
        low, high = map(jnp.asarray, self.loop.tracked.system.control_box)
        weights = {name: scale**-2 for name, scale in self.scales.items()}
        return Task(
            low=low,
            high=high,
            weights={**weights, "smoothness": self.smoothness},
            prepare=self.prepare,
            step=self.step,
            check=_check,
            cost=self.charge,
        )

    def prepare(
        self,
        params: Params,
        error: Error,
        env: Environment,
        inputs: Float[Array, "horizon inputs"],
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Return what is evaluated once per control step: fibre, start and targets."""
        model = self.model
        fiber = model.fiber(fold(model, params), env)
        steady = jax.vmap(self.loop.law.at, in_axes=(0, None))(inputs, env)
        first = jax.tree.map(lambda leaf: leaf[0], steady)
        law_control = self.loop.limited(first.feedback(error))
        before = jnp.where(previous.known, previous.control, law_control)
        latent = model.encode(fiber, without_pose(error))
        fibers = None
        if model.on_reference is not None:
            fibers = jax.vmap(partial(model.on_reference, fiber))(inputs)
        start = Sample(latent, error, before)
        return RolloutSetup(fiber, start, Target(inputs, steady, fibers))

    def step(
        self,
        weights: Any,
        fiber: Any,
        before: Sample,
        nu: Control,
        target: Target,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: law, perturbation, limits, model."""
        law_control = target.steady.feedback(before.state)
        largest = self.loop.law.perturbation
        nu = entrywise(jnp.clip, nu, -largest, largest)
        control = self.loop.limited(law_control + nu)
        # The model was learned on the perturbations that really acted.
        effective = control - law_control
        of_step = fiber if target.fiber is None else target.fiber
        given = jnp.concatenate([effective, target.inputs])
        latent = self.model.step(of_step, before.latent, given)
        error = self.model.decode(fiber, latent)[BODY]
        return StepResult(
            sample=Sample(latent, error, control),
            control=control,
            perturbation=effective,
            state=error,
        )

    def charge(
        self,
        weights: Mapping[str, Any],
        before: Sample,
        after: Sample,
        target: Target,
        at: StepIndex,
    ) -> Scalar:
        """Return the cost of one step."""
        low, high = map(jnp.asarray, self.loop.tracked.system.control_box)
        change = (after.control - before.control) / (0.5 * (high - low))
        cost = weights["smoothness"] * jnp.sum(change**2)
        for name, rows in self.loop.tracked.rows.items():
            cost = cost + weights[name] * size_of(after.state, rows) ** 2
        return cost


tracking_task = factory(TrackingTask, TrackingTask.task)
"""(closed loop, model, settings of `TrackingTask`) -> `Task`."""


def _check(observation: Any, env: Any, reference: Any, horizon: int) -> None:
    """Raise a ValueError for ρ of another length than the horizon."""
    del observation, env
    if reference.shape[:1] != (horizon,):
        raise ValueError(
            f"the reference must have {horizon} steps, got shape {reference.shape}"
        )
