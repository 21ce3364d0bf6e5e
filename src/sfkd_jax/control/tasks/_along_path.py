"""The task of following a path in path coordinates, with curvature preview."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._model_law import SteadyTurn
from sfkd_jax.control.laws._path_errors import PathErrors
from sfkd_jax.control.laws._path_law import PathLaw, turn_control
from sfkd_jax.control.tasks._costs import Cost, StageInputs
from sfkd_jax.control.tasks._path_tracking import check_path
from sfkd_jax.control.tasks._task import (
    Limiter,
    PlanningStart,
    RolloutSetup,
    StepIndex,
    StepResult,
    Task,
    actuator_limits,
)
from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    between,
    circle_errors,
    compose,
    path_state,
    wrap_angle,
)
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Model,
    Params,
    Reference,
    Scalar,
    State,
)


class AlongSample(NamedTuple):
    """State of one rollout: latent, path coordinates, last control."""

    latent: Any
    coordinates: PathState
    control: Control


class AlongTarget(NamedTuple):
    """The reference of one step.

    Attributes:
        point: x, y, yaw, speed.
        normal: unit vector to the left of the path.
        curvature: of the path over the step [1/m].
        turn: steady turn of the law.
    """

    point: Float[Array, "*horizon 4"]
    normal: Float[Array, "*horizon 2"]
    curvature: Float[Array, "*horizon"]
    turn: SteadyTurn


class _Problem(NamedTuple):
    """Settings of `following_law` as its functions need them."""

    model: Model
    cost: Cost
    law: PathLaw
    limit: Limiter
    low: Control
    high: Control
    terminal_weight: float


def curvature_ahead(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] over the step to each reference point; 0 where points coincide.

    Between points it is the change of yaw over the distance. The first step begins at
    the vehicle, where there is no reference point: its curvature is extrapolated
    linearly from the next two.
    """
    steps = jnp.diff(reference, axis=0)
    distance = jnp.hypot(steps[:, 0], steps[:, 1])
    moved = distance > 1e-3
    turns = jnp.where(
        moved, wrap_angle(steps[:, 2]) / jnp.where(moved, distance, 1.0), 0.0
    )
    first = 2.0 * turns[0] - turns[min(1, turns.shape[0] - 1)]
    return jnp.concatenate([first[None], turns])


def path_coordinates(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathState:
    """Return ξ of a world state, relative to the circle through a reference point.

    Args:
        state: pose and body state.
        point: x, y, yaw, speed of the reference.
        curvature: of the circle [1/m].
    """
    lateral, heading = circle_errors(between(point[POSE], state[POSE]), curvature)
    return jnp.concatenate([jnp.stack([lateral, heading]), state[BODY]])


def world_state(coordinates: PathState, reference: Reference) -> State:
    """Return the state at path coordinates beside the present point of a reference.

    That point is one step back from the first one, along the circle through the first
    two: the point where the vehicle should be now.

    Args:
        coordinates: ξ.
        reference: poses and speeds from the next step on.
    """
    now = compose(reference[0, POSE], between(reference[1, POSE], reference[0, POSE]))
    beside = jnp.stack([jnp.zeros(()), coordinates[LATERAL], coordinates[HEADING]])
    return jnp.concatenate([compose(now, beside), coordinates[PATH_SPEED:]])


def following_law(
    model: Model,
    cost: Cost,
    law: PathLaw,
    *,
    dt: float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    control_rate: tuple[float, ...] | None = None,
    terminal_weight: float = 1.0,
) -> Task:
    """Return the task of following a path with a model of the closed loop.

        ξ_{k+1} = F(ξ_k, (ν_k, κ_k, v_k); e),   u_k = limit(law(ξ_k; κ_k, v_k, e) + ν_k)
        J = Σ_k ℓ(ξ_{k+1}, u_k) + w_T ℓ(ξ_T, u_{T-1})

    A plan is the perturbation ν of the law. Observation and reference are poses in the
    world, as for every controller, and are projected once per control step. Rollouts
    use ξ and the previewed curvature only; predicted states are mapped back to the
    world beside the reference points. |ν| stays within `law.perturbation`, as it did
    in the training data.

    Args:
        model: of the closed loop, with `along_path`.
        cost: ℓ, see `tracking_cost`.
        law: the one that the model was learned around.
        dt: sampling period [s].
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        terminal_weight: w_T, added to the weight of the last step.

    Raises:
        ValueError: the model is not in path coordinates, or the limits are
            inconsistent, see `actuator_limits`.
    """
    if not model.along_path:
        raise ValueError(
            "controller.sampling=law needs a model in path coordinates: "
            "model.frame=path"
        )
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )
    problem = _Problem(model, cost, law, limit, low, high, terminal_weight)
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
    """Project the observation and evaluate fibre and law once per control step."""
    model, law = problem.model, problem.law
    fiber = model.fiber(fold(model, params), env)
    curvatures = curvature_ahead(reference)
    coordinates = path_coordinates(observation, reference[0], curvatures[0])
    turns = jax.vmap(law.turn, in_axes=(0, 0, None))(curvatures, reference[:, 3], env)
    first = jax.tree.map(lambda leaf: leaf[0], turns)
    law_control = jnp.clip(turn_control(first, coordinates), problem.low, problem.high)
    before = jnp.where(previous.known, previous.control, law_control)
    latent = model.encode(fiber, path_state(coordinates))
    start = AlongSample(latent, coordinates, before)
    yaw = reference[:, 2]
    normal = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)], axis=1)
    return RolloutSetup(fiber, start, AlongTarget(reference, normal, curvatures, turns))


def _step(
    problem: _Problem,
    weights: Any,
    fiber: Any,
    before: AlongSample,
    nu: Control,
    target: AlongTarget,
    at: StepIndex,
) -> StepResult:
    """One step of one rollout: law plus perturbation, limits, model, cost."""
    point, law = target.point, problem.law
    law_control = turn_control(target.turn, before.coordinates)
    nu = jnp.clip(nu, -law.perturbation, law.perturbation)
    control = problem.limit(law_control + nu, before.control)
    effective = control - law_control
    inputs = jnp.concatenate([effective, jnp.stack([target.curvature, point[3]])])
    latent = problem.model.step(fiber, before.latent, inputs)
    coordinates = problem.model.decode(fiber, latent)[BODY]
    errors = _errors(coordinates, point[3])
    errors_before = _errors(before.coordinates, point[3])
    stage = StageInputs(errors, errors_before, control, before.control, point[3])
    cost = problem.cost.stage(weights, stage)
    cost = cost * (1.0 + problem.terminal_weight * at.last)
    position = point[:2] + coordinates[LATERAL] * target.normal
    yaw = point[2] + coordinates[HEADING]
    state = jnp.concatenate([position, yaw[None], coordinates[PATH_SPEED:]])
    sample = AlongSample(latent, coordinates, control)
    return StepResult(sample, cost, control, effective, state)


def _errors(coordinates: PathState, speed: Scalar) -> PathErrors:
    """Path coordinates as the errors that a stage cost takes."""
    return PathErrors(
        coordinates[LATERAL], coordinates[HEADING], coordinates[PATH_SPEED] - speed
    )
