"""The task of tracking a path with a learned model, around a feedback law."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._model_law import ModelLaw, SteadyTurn
from sfkd_jax.control.laws._path_errors import (
    FeedbackLaw,
    PathErrors,
    path_errors,
    reference_curvature,
)
from sfkd_jax.control.tasks._costs import Cost, StageInputs
from sfkd_jax.control.tasks._task import (
    Actuator,
    Environments,
    Limiter,
    PlanningStart,
    RolloutSetup,
    StepIndex,
    StepResult,
    Task,
    actuator_limits,
)
from sfkd_jax.ranges import Positive
from sfkd_jax.rollout import fold
from sfkd_jax.types import Control, Environment, Model, Params, Reference, State


class PathSample(NamedTuple):
    """State of one rollout along a path.

    Attributes:
        latent: of the model.
        state: decoded from it; kept, because the law of the next step needs it again.
        errors: of the last step from the path.
        control: of the last step.
    """

    latent: Any
    state: State
    errors: PathErrors
    control: Control


class PathTarget(NamedTuple):
    """The reference of one step.

    Attributes:
        point: x, y, yaw, speed.
        curvature: of the path there [1/m].
        goal: latent of driving exactly along the path.
        turn: `SteadyTurn` of the law, or None if it is not a `ModelLaw`.
    """

    point: Float[Array, "*horizon 4"]
    curvature: Float[Array, "*horizon"]
    goal: Any
    turn: Any


class _Problem(NamedTuple):
    """Settings of `path_tracking` as its functions need them."""

    model: Model
    cost: Cost
    law: FeedbackLaw | ModelLaw
    limit: Limiter
    low: Control
    high: Control
    terminal_weight: float
    latent_weight: float
    actuator: Actuator | None
    ancillary: ModelLaw | None


def path_tracking(
    model: Model,
    cost: Cost,
    law: FeedbackLaw | ModelLaw,
    *,
    dt: float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    control_rate: tuple[Positive, ...] | None = None,
    terminal_weight: float = 1.0,
    latent_weight: float = 0.0,
    actuator: Actuator | None = None,
    ancillary: ModelLaw | None = None,
) -> Task:
    """Return the task of tracking a path around a feedback law on the predicted state.

        u_k = limit(clip(u_ff(κ_k) + K ξ_k) + ν_k)
        J = Σ_k ℓ(x_k, u_k) + λ_z |z_k − z_k^ref|² + w_T ℓ(x_T, u_T)

    Args:
        model: rolled out; `fiber` and `encode` are evaluated once per control step,
            outside the scan over the horizon.
        cost: ℓ, see `tracking_cost`.
        law: u_ff + K ξ; see `path_feedback`, `ModelLaw` and `no_feedback`.
        dt: sampling period [s].
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        terminal_weight: w_T, added to the weight of the last step.
        latent_weight: λ_z.
        actuator: reads the actuator positions from the observation; without it, slew
            limits count from the control applied last.
        ancillary: a second law, whose plan along the horizon is evaluated as one more
            sample.

    Raises:
        ValueError: the limits are inconsistent, see `actuator_limits`.

    Source: for the ancillary law, Trevisan and Alonso-Mora (2024), Biased-MPPI.
    """
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )
    problem = _Problem(
        model=model,
        cost=cost,
        law=law,
        limit=limit,
        low=low,
        high=high,
        terminal_weight=terminal_weight,
        latent_weight=latent_weight,
        actuator=actuator,
        ancillary=ancillary,
    )
    prepare, step = partial(_prepare, problem), partial(_step, problem)
    return Task(low, high, cost.weights, prepare, step, check_path)


def _prepare(
    problem: _Problem,
    params: Params,
    observation: State,
    env: Environment,
    reference: Reference,
    previous: PlanningStart,
) -> RolloutSetup:
    """Evaluate fibre, encoder, law and targets once per control step."""
    model, law = problem.model, problem.law
    # Many rollouts share this fibre; folding parameters that are folded is free.
    fiber = model.fiber(fold(model, params), env)
    curvature = reference_curvature(reference)
    goals = jax.vmap(lambda point: model.encode(fiber, _on_path(observation, point)))(
        reference
    )
    errors = path_errors(observation, reference[0], curvature[0])
    turns = None
    if isinstance(law, ModelLaw):
        turns = law.prepare(model, fiber, observation, reference, curvature)
    targets = PathTarget(reference, curvature, goals, turns)
    first = jax.tree.map(lambda leaf: leaf[0], targets)
    law_control = _law_control(problem, observation, first)
    before = jnp.where(previous.known, previous.control, law_control)
    if problem.actuator is not None:
        before = problem.actuator(observation)
    latent = model.encode(fiber, observation)
    start = PathSample(latent, model.decode(fiber, latent), errors, before)
    proposals = None
    if (ancillary := problem.ancillary) is not None:
        turns = ancillary.prepare(model, fiber, observation, reference, curvature)
        proposals = _ancillary_plan(problem, ancillary, fiber, start, targets, turns)
    return RolloutSetup(fiber, start, targets, proposals)


def _step(
    problem: _Problem,
    weights: Any,
    fiber: Any,
    before: PathSample,
    nu: Control,
    target: PathTarget,
    at: StepIndex,
) -> StepResult:
    """One step of one rollout: law plus perturbation, limits, model, cost."""
    model, point = problem.model, target.point
    law_control = _law_control(problem, before.state, target)
    control = problem.limit(law_control + nu, before.control)
    latent = model.step(fiber, before.latent, control)
    after = model.decode(fiber, latent)
    errors = path_errors(after, point, target.curvature)
    inputs = StageInputs(errors, before.errors, control, before.control, point[3])
    cost = problem.cost.stage(weights, inputs)
    if problem.latent_weight:
        cost = cost + problem.latent_weight * jnp.sum(
            (model.vector(latent) - model.vector(target.goal)) ** 2
        )
    cost = cost * (1.0 + problem.terminal_weight * at.last)
    sample = PathSample(latent, after, errors, control)
    return StepResult(sample, cost, control, control - law_control, after)


def _law_control(problem: _Problem, state: State, target: PathTarget) -> Control:
    """The control of the law, clipped to the limits.

    Without the clip, a perturbation would compensate for what the law requests beyond
    the limits. After a far-off observation that is thousands of radians, and it would
    stay in the plan when the observations are right again.
    """
    point, curvature, law = target.point, target.curvature, problem.law
    if isinstance(law, ModelLaw):
        control = law.control(target.turn, state, point, curvature)
    else:
        control = law(path_errors(state, point, curvature), curvature, point[3])
    return jnp.clip(control, problem.low, problem.high)


def _ancillary_plan(
    problem: _Problem,
    ancillary: ModelLaw,
    fiber: Any,
    start: PathSample,
    targets: PathTarget,
    turns: SteadyTurn,
) -> Float[Array, "1 horizon control"]:
    """What the ancillary law does along the horizon, as perturbations of the law."""
    weights = problem.cost.weights

    def follow(before: PathSample, inputs: Any) -> tuple[PathSample, Control]:
        target, turn = inputs
        control = ancillary.control(turn, before.state, target.point, target.curvature)
        nu = control - _law_control(problem, before.state, target)
        anywhere = StepIndex(jnp.zeros((), int), jnp.zeros(()))
        after = _step(problem, weights, fiber, before, nu, target, anywhere)
        return after.sample, after.perturbation

    return jax.lax.scan(follow, start, (targets, turns))[1][None]


def _on_path(state: State, point: Float[Array, " 4"]) -> State:
    """The state of driving along the reference: its pose and speed, all else zero."""
    return jnp.zeros_like(state).at[:4].set(point)


def check_path(
    observation: State, env: Environments, reference: Any, horizon: int
) -> None:
    """Raise a ValueError that names an argument of the wrong shape."""
    if observation.ndim != 1 or observation.shape[0] < 4:
        raise ValueError(
            "observation must be (p_x, p_y, yaw, v, …), shape (nx,), "
            f"got {observation.shape}"
        )
    if env.ndim not in (1, 2):
        raise ValueError(
            f"env must have shape (ne,), or (particle, ne), got {env.shape}"
        )
    if reference.shape != (horizon, 4):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; "
            f"got {reference.shape}"
        )
