"""Rollouts of a model that was learned around a feedback law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control._task import (
    Limiter,
    PlanningStart,
    RolloutSetup,
    Sample,
    StepIndex,
    StepResult,
)
from sfkd_jax.geometry import entrywise, without_pose
from sfkd_jax.rollout import fold
from sfkd_jax.types import BODY, Control, Environment, Fiber, Model, Params


class Feedback(Protocol):
    """A law at one ρ and e."""

    def feedback(self, state: Any, /) -> Control:
        """Return the control of the law at ξ, without any limit."""
        ...


class LawTarget(NamedTuple):
    """What all samples share of one step.

    Attributes:
        inputs: ρ.
        steady: the law at this ρ.
        fiber: of the model with this ρ; None if it is that of all steps.
    """

    inputs: Float[Array, "*horizon inputs"]
    steady: Any
    fiber: Fiber | None


@dataclass(frozen=True, eq=False)
class AroundLaw:
    """The functions of a `Task` whose plan is the perturbation ν of a law.

        ξ_{k+1} = F(ξ_k, (ν_k, ρ_k); e),   u_k = limit(law(ξ_k; ρ_k, e) + ν_k)

    |ν| stays within `perturbation`, as in the training data.

    Attributes:
        model: of the closed loop, rolled out.
        law: (ρ, e) -> `Feedback`, a pytree.
        perturbation: largest |ν|, (control,).
        low: lower limits of u.
        high: upper limits of u.
        limit: of the actuators.
    """

    model: Model
    law: Callable[[Float[Array, " inputs"], Environment], Feedback]
    perturbation: Control
    low: Control
    high: Control
    limit: Limiter

    def prepare(
        self,
        params: Params,
        state: Float[Array, " state"],
        env: Environment,
        inputs: Float[Array, "horizon inputs"],
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Return what is evaluated once per control step: fibre, start and targets."""
        model = self.model
        fiber = model.fiber(fold(model, params), env)
        steady = jax.vmap(self.law, in_axes=(0, None))(inputs, env)
        first: Any = jax.tree.map(lambda leaf: leaf[0], steady)
        law_control = jnp.clip(first.feedback(state), self.low, self.high)
        # Before the first step no control was applied: slew limits count from the law.
        before = jnp.where(previous.known, previous.control, law_control)
        latent = model.encode(fiber, without_pose(state))
        start = Sample(latent, state, before)
        fibers = None
        if model.on_reference is not None:
            fibers = jax.vmap(partial(model.on_reference, fiber))(inputs)
        return RolloutSetup(fiber, start, LawTarget(inputs, steady, fibers))

    def step(
        self,
        weights: Any,
        fiber: Fiber,
        before: Sample,
        nu: Control,
        target: LawTarget,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: law, perturbation, limits, model."""
        del weights, at
        law_control = target.steady.feedback(before.state)
        nu = entrywise(jnp.clip, nu, -self.perturbation, self.perturbation)
        control = self.limit(law_control + nu, before.control)
        # The model was learned on the perturbations that really acted.
        effective = control - law_control
        of_step = fiber if target.fiber is None else target.fiber
        inputs = jnp.concatenate([effective, target.inputs])
        latent = self.model.step(of_step, before.latent, inputs)
        state = self.model.decode(fiber, latent)[BODY]
        return StepResult(
            sample=Sample(latent, state, control),
            control=control,
            perturbation=effective,
            state=state,
        )
