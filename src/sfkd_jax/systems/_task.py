"""The planning task of a system that follows its reference around a law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import jax.numpy as jnp

from sfkd_jax.control import (
    AroundLaw,
    LawTarget,
    Sample,
    StepIndex,
    Task,
    factory,
    size_of,
)
from sfkd_jax.ranges import NonNegative
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.types import Control, Model, Scalar


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

        def limit(control: Control, before: Control) -> Control:
            del before
            return self.loop.limited(control)

        law = self.loop.law
        around_law = AroundLaw(self.model, law.at, law.perturbation, low, high, limit)
        weights = {name: scale**-2 for name, scale in self.scales.items()}
        return Task(
            low=low,
            high=high,
            weights={**weights, "smoothness": self.smoothness},
            prepare=around_law.prepare,
            step=around_law.step,
            check=_check,
            cost=self.charge,
        )

    def charge(
        self,
        weights: Mapping[str, Any],
        before: Sample,
        after: Sample,
        target: LawTarget,
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
