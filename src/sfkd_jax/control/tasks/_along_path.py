"""Driving along a path: one projection a control step, and the task of following it.

A controller along a path is a `Controller` whose observation is ξ and whose reference
is a `Preview`. `along_reference` turns it into one that sees poses in the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._model_law import SteadyTurn
from sfkd_jax.control.laws._path_errors import PathErrors, curvature_between
from sfkd_jax.control.laws._path_law import PathLaw, turn_control
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._path_tracking import Cost, StageInputs, check_path
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
    path_state,
)
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Model,
    Params,
    Reference,
    Scalar,
    State,
)


class Preview(NamedTuple):
    """The road ahead, as controllers along a path see it.

    Attributes:
        road: κ [1/m] and v_ref [m/s] of the next steps; NaN if the reference is not
            finite.
        repeated: whether the observation is bit for bit the last one, as of a sensor
            that freezes.
    """

    road: Float[Array, "horizon 2"]
    repeated: Bool[Array, ""]


class AlongReferenceState(NamedTuple):
    """State of the wrapped controller, and the last observation in the world."""

    inner: Any
    observation: State


def curvature_ahead(reference: Reference) -> Float[Array, " horizon"]:
    """Return κ [1/m] over the step to each reference point.

    The first step begins at the vehicle, where there is no reference point: its
    curvature is extrapolated linearly from the next two.
    """
    turns = curvature_between(reference)
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


def along_reference(controller: Controller, *, coordinates: int) -> Controller:
    """Return a controller in the world from one along a path.

    The only place where a state is projected, once per control step. Predicted states
    are mapped back beside the reference points.

    Args:
        controller: `act` takes ξ and a `Preview` in place of observation and reference.
        coordinates: size of ξ.

    Returns:
        A `Controller` of poses in the world; `info` gains `path_state` (ξ, NaN where
        observation or reference are not finite) and `planned_path` (predicted ξ).
    """

    def init(key: Key) -> AlongReferenceState:
        # NaN equals nothing, so that the first observation is never a repetition.
        unknown = jnp.full(coordinates + 1, jnp.nan, dtype=float)
        return AlongReferenceState(controller.init(key), unknown)

    def act(
        params: Params,
        state: AlongReferenceState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, AlongReferenceState, ControllerInfo]:
        check_path(observation, env, reference, reference.shape[0])
        curvature = curvature_ahead(reference)
        xi = path_coordinates(observation, reference[0], curvature[0])
        road = jnp.stack([curvature, reference[:, 3]], axis=1)
        # A position that is not finite can leave κ finite (points "coincide"); what
        # cannot be trusted as a whole is NaN as a whole.
        readable = all_finite(reference)
        road = jnp.where(readable, road, jnp.nan)
        xi = jnp.where(readable & all_finite(observation), xi, jnp.nan)
        repeated = jnp.all(observation == state.observation)
        control, inner, info = controller.act(
            params, state.inner, xi, env, Preview(road, repeated)
        )
        planned = info["predicted_states"]
        info = info.copy()
        info["path_state"], info["planned_path"] = xi, planned
        info["predicted_states"] = jax.vmap(_in_world)(planned, reference)
        if "sample_states" in info:
            samples = jax.vmap(_in_world, in_axes=(0, None))
            info["sample_states"] = jax.vmap(samples)(info["sample_states"], reference)
        return control, AlongReferenceState(inner, observation), info

    return Controller(init, act)


def _in_world(coordinates: PathState, point: Float[Array, " 4"]) -> State:
    """The state beside a reference point, on the normal of the path there."""
    normal = jnp.stack([-jnp.sin(point[2]), jnp.cos(point[2])])
    position = point[:2] + coordinates[LATERAL] * normal
    yaw = point[2] + coordinates[HEADING]
    return jnp.concatenate([position, yaw[None], coordinates[PATH_SPEED:]])


class AlongSample(NamedTuple):
    """State of one rollout: latent, path coordinates, last control."""

    latent: Any
    coordinates: PathState
    control: Control


class AlongTarget(NamedTuple):
    """The road of one step, κ [1/m] and v_ref [m/s], and the steady turn of the law."""

    road: Float[Array, "*horizon 2"]
    turn: SteadyTurn


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

    A plan is the perturbation ν of the law. A planner of this task is a controller
    along a path, see `along_reference`; its predicted states are ξ. |ν| stays within
    `law.perturbation`, as it did in the training data.

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
    following = _Following(model, cost, law, limit, low, high, terminal_weight)
    return Task(low, high, cost.weights, following.prepare, following.step, _check)


@dataclass(frozen=True)
class _Following:
    """The functions of `following_law`."""

    model: Model
    cost: Cost
    law: PathLaw
    limit: Limiter
    low: Control
    high: Control
    terminal_weight: float

    def prepare(
        self,
        params: Params,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Evaluate fibre, encoder and law once per control step."""
        fiber = self.model.fiber(fold(self.model, params), env)
        turns = jax.vmap(self.law.turn, in_axes=(0, 0, None))(
            preview.road[:, 0], preview.road[:, 1], env
        )
        first = jax.tree.map(lambda leaf: leaf[0], turns)
        law_control = jnp.clip(turn_control(first, coordinates), self.low, self.high)
        # Before the first step no control was applied: slew limits count from the law.
        before = jnp.where(previous.known, previous.control, law_control)
        latent = self.model.encode(fiber, path_state(coordinates))
        start = AlongSample(latent, coordinates, before)
        return RolloutSetup(fiber, start, AlongTarget(preview.road, turns))

    def step(
        self,
        weights: Any,
        fiber: Any,
        before: AlongSample,
        nu: Control,
        target: AlongTarget,
        at: StepIndex,
    ) -> StepResult:
        """One step of one rollout: law plus perturbation, limits, model, cost."""
        speed = target.road[1]
        law_control = turn_control(target.turn, before.coordinates)
        nu = jnp.clip(nu, -self.law.perturbation, self.law.perturbation)
        control = self.limit(law_control + nu, before.control)
        # What the limits left of ν: the model was learned on what really acted.
        effective = control - law_control
        inputs = jnp.concatenate([effective, target.road])
        latent = self.model.step(fiber, before.latent, inputs)
        coordinates = self.model.decode(fiber, latent)[BODY]
        errors = _errors(coordinates, speed)
        errors_before = _errors(before.coordinates, speed)
        stage = StageInputs(errors, errors_before, control, before.control, speed)
        cost = self.cost.stage(weights, stage)
        cost = cost * (1.0 + self.terminal_weight * at.last)
        sample = AlongSample(latent, coordinates, control)
        return StepResult(sample, cost, control, effective, coordinates)


def _errors(coordinates: PathState, speed: Scalar) -> PathErrors:
    """Path coordinates as the errors that a stage cost takes."""
    return PathErrors(
        coordinates[LATERAL], coordinates[HEADING], coordinates[PATH_SPEED] - speed
    )


def _check(coordinates: Any, env: Any, preview: Any, horizon: int) -> None:
    """Raise a ValueError that names an argument of the wrong shape."""
    if not isinstance(preview, Preview):
        raise ValueError(
            "a planner along a path takes ξ and a `Preview`; "
            "`along_reference` makes them of poses in the world"
        )
    if coordinates.ndim != 1 or env.ndim not in (1, 2):
        raise ValueError(
            "ξ must have shape (coordinate,) and env (ne,), or (particle, ne), "
            f"got {coordinates.shape} and {env.shape}"
        )
    if preview.road.shape != (horizon, 2):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; "
            f"got {preview.road.shape[0]} steps"
        )
