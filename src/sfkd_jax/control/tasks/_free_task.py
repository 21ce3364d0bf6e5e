"""The task of any state equation and any cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.control._factory import factory
from sfkd_jax.control.tasks._task import (
    Limit,
    Limiter,
    PlanningStart,
    RolloutSetup,
    StepIndex,
    StepResult,
    Task,
    actuator_limits,
)
from sfkd_jax.types import Control, Params, Scalar


class FreeSample(NamedTuple):
    """State of one rollout of a plain state equation: state and last control."""

    state: Any
    control: Control


@dataclass(frozen=True, eq=False)
class FreeTask:
    """The task of minimising any cost under any state equation.

        x⁺ = f(params, x, u, e),   J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ

    State, environment and reference may be arrays, any other pytrees, or None; every
    leaf of the reference has the horizon as its leading axis.

    Attributes:
        dynamics: f.
        stage: ℓ, evaluated at the state after the control.
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        dt: sampling period [s], which `control_rate` needs.
        terminal: φ(weights, x_T, ref_T).
        weights: a pytree of numbers that both costs read, see `Tuning.cost`.
    """

    dynamics: Callable[[Params, Any, Control, Any], Any]
    stage: Callable[[Any, Any, Control, Control, Any], Scalar]
    _: KW_ONLY
    control_low: Limit = -np.inf
    control_high: Limit = np.inf
    control_rate: Limit | None = None
    dt: float | None = None
    terminal: Callable[[Any, Any, Any], Scalar] | None = None
    weights: Any = ()

    def __post_init__(self) -> None:
        if self.control_rate is not None and self.dt is None:
            raise ValueError("control_rate needs dt, the sampling period in seconds")
        _ = self.limit

    @cached_property
    def limit(self) -> Limiter:
        """The projection onto the limits of the actuators."""
        rate = np.inf if self.control_rate is None else self.control_rate
        low, high, rate = np.broadcast_arrays(self.control_low, self.control_high, rate)
        return actuator_limits(low, high, rate, self.dt or 1.0)

    def task(self) -> Task:
        """Return the planning problem as functions."""
        box = np.broadcast_arrays(self.control_low, self.control_high)
        low, high = (jnp.asarray(end, dtype=float) for end in box)
        steps = self.prepare, self.step, _check_reference
        return Task(low, high, self.weights, *steps)

    def prepare(
        self,
        params: Params,
        observation: Any,
        env: Any,
        reference: Any,
        start: PlanningStart,
    ) -> RolloutSetup:
        """Return the first sample and what all samples share."""
        # Before the first control, slew limits count from rest.
        rest = self.limit(jnp.zeros_like(start.control), start.control)
        before = jnp.where(start.known, start.control, rest)
        # Integers become real if the dynamics make them so: a scan keeps types.
        after = jax.eval_shape(self.dynamics, params, observation, before, env)
        state = jax.tree.map(
            lambda leaf, like: jnp.asarray(leaf, like.dtype), observation, after
        )
        return RolloutSetup((params, env), FreeSample(state, before), reference)

    def step(
        self,
        weights: Any,
        context: tuple[Params, Any],
        before: FreeSample,
        nu: Control,
        goal: Any,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: limits, state equation, cost."""
        params, env = context
        control = self.limit(nu, before.control)
        state = self.dynamics(params, before.state, control, env)
        cost = self.stage(weights, state, control, before.control, goal)
        if self.terminal is not None:
            cost = cost + at.last * self.terminal(weights, state, goal)
        return StepResult(FreeSample(state, control), cost, control, control, state)


free_task = factory(FreeTask, FreeTask.task)
"""(dynamics, stage, settings of `FreeTask`) -> `Task`."""


def _check_reference(observation: Any, env: Any, reference: Any, horizon: int) -> None:
    """Raise a ValueError for a reference of another length than the horizon."""
    del observation, env
    for shape in map(jnp.shape, jax.tree.leaves(reference)):
        if shape[:1] != (horizon,):
            raise ValueError(
                f"reference must have {horizon} steps as its leading axis, "
                f"got shape {shape}"
            )
