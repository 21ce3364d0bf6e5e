"""The task of tracking a path with a learned model, around a feedback law."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import (
    Limiter,
    PlanningStart,
    RolloutSetup,
    Sample,
    StepIndex,
    StepResult,
    Task,
    actuator_limits,
    factory,
)
from sfkd_jax.driving.path_coordinates import followable, reference_curvature
from sfkd_jax.driving.path_following.laws._feedback import (
    CREEP,
    SLOW_STEERING,
    FeedbackLaw,
    PathErrors,
    RecoveringFeedback,
    admitted,
    path_errors,
)
from sfkd_jax.geometry import entrywise, is_precise
from sfkd_jax.ranges import Positive
from sfkd_jax.rollout import fold
from sfkd_jax.types import Control, Environment, Model, Params, Reference, Scalar, State


class StageInputs(NamedTuple):
    """Arguments of a stage cost at one step of one rollout.

    Attributes:
        errors: path errors after the step.
        errors_before: path errors before the step.
        control: applied in the step.
        control_before: applied in the step before.
        speed: of the reference [m/s].
    """

    errors: PathErrors
    errors_before: PathErrors
    control: Control
    control_before: Control
    speed: Scalar


class Cost(NamedTuple):
    """A stage cost whose weights are data, so a change compiles nothing again.

    Attributes:
        weights: a pytree of numbers.
        stage: (weights, `StageInputs`) -> cost of one step.
    """

    weights: Any
    stage: Callable[[Any, StageInputs], Scalar]


def tracking_cost(
    *,
    dt: float,
    lateral: float = 200.0,
    course: float = 20.0,
    speed: float = 1.0,
    steering_rate: float = 5.0,
    effort: float = 0.02,
    speed_loop: bool = False,
) -> Cost:
    """Return the quadratic path-tracking cost, its weights under the argument names.

        ℓ = q_y e_y² + q_c (Δe_y / v dt)² + q_v (s e_v)² + q_δ̇ (Δδ / dt)² + q_a a²

    The course error Δe_y / (v dt) is the direction of travel relative to the path. A
    vehicle that slips sideways in wind or through a bend then aligns its direction of
    travel with the path, not its heading. s is 1, or 5 m/s / v_ref below 5 m/s.

    Args:
        dt: sampling period [s].
        lateral: q_y [1/m²].
        course: q_c [1/rad²].
        speed: q_v [s²/m²].
        steering_rate: q_δ̇ [s²/rad²].
        effort: q_a, on the acceleration [s⁴/m²]; ignored with a speed loop.
        speed_loop: whether the second control is a speed command.
    """
    weights = {
        "lateral": lateral,
        "course": course,
        "speed": speed,
        "steering_rate": steering_rate,
        "effort": effort,
    }

    def stage(weights: Mapping[str, Any], inputs: StageInputs) -> Scalar:
        errors = inputs.errors
        before = inputs.errors_before
        # The small length keeps the angle finite at standstill.
        travelled = jnp.maximum(inputs.speed, CREEP) * dt + 1e-3
        angle = (errors.lateral - before.lateral) / travelled
        rate = (inputs.control[0] - inputs.control_before[0]) / dt
        total = weights["lateral"] * errors.lateral**2 + weights["course"] * angle**2
        # A speed error counts relative to a low speed, or it would be cheap to stand
        # beside the path.
        scale = SLOW_STEERING / jnp.maximum(inputs.speed, CREEP)
        scale = jnp.where(inputs.speed > 0.0, jnp.maximum(scale, 1.0), 1.0)
        total = total + weights["speed"] * (scale * errors.speed) ** 2
        total = total + weights["steering_rate"] * rate**2
        if speed_loop:
            return total
        return total + weights["effort"] * inputs.control[1] ** 2

    return Cost(weights, stage)


class PathTarget(NamedTuple):
    """The reference of one step.

    Attributes:
        point: x [m], y [m], yaw [rad], speed [m/s].
        curvature: of the path there [1/m].
    """

    point: Float[Array, "*horizon 4"]
    curvature: Float[Array, "*horizon"]


class PathTargets(NamedTuple):
    """The references of a step and of the step before; for the first step the same."""

    before: PathTarget
    now: PathTarget


@dataclass(frozen=True, eq=False)
class LawTask:
    """A task of following a path around a feedback law; a subclass defines its steps.

    Attributes:
        model: rolled out; `fiber` and `encode` are evaluated once per control step,
            outside the scan over the horizon.
        cost: ℓ, see `tracking_cost`.
        law: what a plan perturbs.
        dt: sampling period [s].
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        terminal_weight: w_T, added to the weight of the last step.
    """

    model: Model
    cost: Cost
    law: Any
    _: KW_ONLY
    dt: float
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]
    control_rate: tuple[Positive, ...] | None = None
    terminal_weight: float = 1.0

    def __post_init__(self) -> None:
        _ = self.limit

    def task(self, check: Callable[..., Any]) -> Task:
        """Return the planning problem as functions, with `check` for its arguments."""
        # A subclass defines `prepare` and `step`.
        subclass: Any = self
        low, high = self.box()
        return Task(
            low=low,
            high=high,
            weights=self.cost.weights,
            prepare=subclass.prepare,
            step=subclass.step,
            check=check,
            cost=self.charge,
        )

    def errors(
        self, before: Sample, after: Sample, target: Any
    ) -> tuple[PathErrors, PathErrors, Scalar]:
        """Return the errors before and after a step, and the speed of the reference."""
        raise NotImplementedError

    def charge(
        self, weights: Any, before: Sample, after: Sample, target: Any, at: StepIndex
    ) -> Scalar:
        """Return the cost of one step."""
        errors_before, errors, speed = self.errors(before, after, target)
        inputs = StageInputs(
            errors=errors,
            errors_before=errors_before,
            control=after.control,
            control_before=before.control,
            speed=speed,
        )
        cost = self.cost.stage(weights, inputs)
        return cost * (1.0 + self.terminal_weight * at.last)

    def box(self) -> tuple[Control, Control]:
        """Return the lower and upper control limits."""
        low = jnp.asarray(self.control_low, dtype=float)
        high = jnp.asarray(self.control_high, dtype=float)
        return low, high

    @cached_property
    def limit(self) -> Limiter:
        """The projection onto the limits of the actuators."""
        return actuator_limits(
            self.control_low, self.control_high, self.control_rate, self.dt
        )


@dataclass(frozen=True, eq=False)
class PathTracking(LawTask):
    """The task of tracking a path around a feedback law on the predicted state.

        u_k = limit(clip(u_ff(κ_k) + K ξ_k) + ν_k)
        J = Σ_k ℓ(x_k, u_k) + w_T ℓ(x_T, u_T)

    Attributes:
        law: u_ff + K ξ; see `path_feedback` and `no_feedback`. The other attributes are
            those of `LawTask`.
    """

    law: FeedbackLaw

    def prepare(
        self,
        params: Params,
        observation: State,
        env: Environment,
        reference: Reference,
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Return what is evaluated once per control step: fibre, start and targets."""
        model = self.model
        reference, is_followable = followable(reference)
        # Many rollouts share this fibre; folding parameters that are folded is free.
        fiber = model.fiber(fold(model, params), env)
        curvature = reference_curvature(reference)
        now = PathTarget(reference, curvature)

        def one_step_before(leaf: Array) -> Array:
            return jnp.append(leaf[:1], leaf[:-1], 0)

        earlier = jax.tree.map(one_step_before, now)
        first = PathTarget(reference[0], curvature[0])
        law_control, _ = self._law_control(observation, first)
        # At the first step no control is known: assume that the law has driven.
        before = jnp.where(previous.known, previous.control, law_control)
        latent = model.encode(fiber, observation)
        # Few models are right at walking pace: there the law sees the measurement.
        slow = observation[3] < SLOW_STEERING
        state = jnp.where(slow, observation, model.decode(fiber, latent))
        return RolloutSetup(
            context=fiber,
            start=Sample(latent, state, before),
            targets=PathTargets(earlier, now),
            followable=is_followable,
        )

    def step(
        self,
        weights: Any,
        fiber: Any,
        before: Sample,
        nu: Control,
        target: PathTargets,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: law, perturbation, limits, model."""
        model = self.model
        speed = target.now.point[3]
        law_control, authority = self._law_control(before.state, target.now)
        nu = admitted(nu, before.state[3], speed, authority)
        control = self.limit(law_control + nu, before.control)
        latent = model.step(fiber, before.latent, control)
        after = model.decode(fiber, latent)
        return StepResult(
            sample=Sample(latent, after, control),
            control=control,
            perturbation=control - law_control,
            state=after,
        )

    def errors(
        self, before: Sample, after: Sample, target: PathTargets
    ) -> tuple[PathErrors, PathErrors, Scalar]:
        """Return the errors before and after a step, and the speed of the reference."""
        earlier, now = target
        errors_before = path_errors(before.state, earlier.point, earlier.curvature)
        errors = path_errors(after.state, now.point, now.curvature)
        return errors_before, errors, now.point[3]

    def _law_control(self, state: State, target: PathTarget) -> tuple[Control, Scalar]:
        """Return the clipped control of the law, and the share of ν that acts.

        Without the clip, a perturbation would compensate for what the law requests
        beyond the limits. After a far-off observation that is thousands of radians, and
        it would stay in the plan when the observations are right again.
        """
        speed = target.point[3]
        errors = path_errors(state, target.point, target.curvature)
        authority = jnp.ones(())
        control = self.law(errors, target.curvature, speed)
        if isinstance(self.law, RecoveringFeedback):
            authority = self.law.authority(errors, speed)
        low, high = self.box()
        return entrywise(jnp.clip, control, low, high), authority


def check_path(
    observation: State, env: Environment, reference: Any, horizon: int
) -> Bool[Array, ""]:
    """Return `is_precise`; a ValueError names an argument of the wrong shape."""
    if observation.ndim != 1 or observation.shape[0] < 4:
        raise ValueError(
            "observation must be (p_x, p_y, yaw, v, …), shape (nx,), "
            f"got {observation.shape}"
        )
    if env.ndim != 1:
        raise ValueError(f"env must have shape (ne,), got {env.shape}")
    if reference.shape != (horizon, 4):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; "
            f"got {reference.shape}"
        )
    return is_precise(observation, reference)


def _task(settings: PathTracking) -> Task:
    """Return the task of tracking a path, which checks its arguments."""
    return settings.task(check_path)


path_tracking = factory(PathTracking, _task)
"""(model, cost, law, settings of `PathTracking`) -> `Task`."""
