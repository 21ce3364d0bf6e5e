"""Driving along a path: one projection a control step, and the task of following it.

A controller along a path is a `Controller` whose observation is ξ and whose reference
is a `Preview`. `along_reference` turns it into one that sees poses in the world.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import Stateful, factory
from sfkd_jax.control._finite import all_finite
from sfkd_jax.control.laws._feedback import PathErrors, SteadyTurn
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.tasks._path_tracking import LawTask, check_path
from sfkd_jax.control.tasks._task import (
    PlanningStart,
    RolloutSetup,
    Sample,
    StepIndex,
    StepResult,
)
from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    beside,
    between,
    compose,
    curvature_ahead,
    entrywise,
    followable,
    path_coordinates,
    path_state,
)
from sfkd_jax.rollout import Offset, fold
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Params,
    Reference,
    Scalar,
    State,
)


class Preview(NamedTuple):
    """The road ahead, as controllers along a path see it."""

    # κ [1/m] and v_ref [m/s] of the next steps; NaN if the reference is not finite.
    road: Float[Array, "horizon 2"]
    # Distance of the observed position from the first point of the reference, along the
    # path [m]; behind a `Gate` of the last one that was believed.
    along: Scalar
    # Whether the observation is bit for bit the last one, as of a sensor that freezes.
    repeated: Bool[Array, ""]
    # Which entries of ξ are measured; behind a `Gate` the others are predicted.
    measured: Bool[Array, " coordinate"]
    on_time: Bool[Array, ""]  # whether the last call was one period ago
    trusted: Bool[Array, ""]  # whether the certificate may be claimed, see `Gate`


class AlongReferenceState(NamedTuple):
    """State of the wrapped controller, and the last observation in the world."""

    inner: Any
    observation: State


@dataclass(frozen=True, eq=False)
class AlongReference(Stateful):
    """A controller in the world from one along a path.

    The only place where a state is projected, once per control step. Predicted states
    are mapped back beside the reference points.

    Attributes:
        inner: `act` takes ξ and a `Preview` in place of observation and reference.
        coordinates: size of ξ.

    `info` gains `path_state` (ξ, NaN where observation or reference are not finite),
        `road` (κ and v_ref of this step, likewise) and `planned_path` (predicted ξ).
    """

    inner: Controller
    _: KW_ONLY
    coordinates: int

    def init(self, key: Key) -> AlongReferenceState:
        """Return the state before the first control step."""
        # NaN equals nothing, so that the first observation is never a repetition.
        unknown = jnp.full(self.coordinates + 1, jnp.nan, dtype=float)
        return AlongReferenceState(self.inner.init(key), unknown)

    def act(
        self,
        params: Params,
        state: AlongReferenceState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, AlongReferenceState, ControllerInfo]:
        """Take one control step."""
        precise = check_path(observation, env, reference, reference.shape[0])
        reference, known = followable(reference)
        curvature = curvature_ahead(reference)
        xi = path_coordinates(observation, reference[0], curvature[0])
        road = jnp.stack([curvature, reference[:, 3]], axis=1)
        # A position that is not finite can leave κ finite (points "coincide"); what
        # cannot be trusted as a whole is NaN as a whole.
        readable = all_finite(reference)
        road = jnp.where(readable, road, jnp.nan)
        xi = jnp.where(readable & all_finite(observation), xi, jnp.nan)
        repeated = jnp.all(observation == state.observation)
        preview = Preview(
            road=road,
            along=between(reference[0, POSE], observation[POSE])[0],
            repeated=repeated,
            measured=jnp.isfinite(xi),
            on_time=jnp.asarray(True),
            trusted=precise & known,
        )
        control, inner, info = self.inner.act(params, state.inner, xi, env, preview)
        planned = info["predicted_states"]
        # A gate has already said which of ξ is believed.
        info: Any = {"path_state": xi, **info, "planned_path": planned}
        info |= {"precision": precise, "road": road[0]}
        if "healthy" in info:
            info["healthy"] &= precise & known
        info["predicted_states"] = jax.vmap(beside)(planned, reference)
        return control, AlongReferenceState(inner, observation), info


along_reference = factory(AlongReference, AlongReference.controller)
"""(controller along a path, coordinates=size of ξ) -> `Controller` in the world."""


class AlongTarget(NamedTuple):
    """What all samples share of one step."""

    road: Float[Array, "*horizon 2"]  # κ [1/m] and v_ref [m/s]
    turn: SteadyTurn  # of the law
    fiber: Any  # of the model on this road; None: that of all steps


@dataclass(frozen=True, eq=False)
class FollowingLaw(LawTask):
    """The task of following a path with a model of the closed loop.

        ξ_{k+1} = F(ξ_k, (ν_k, κ_k, v_k); e),   u_k = limit(law(ξ_k; κ_k, v_k, e) + ν_k)
        J = Σ_k ℓ(ξ_{k+1}, u_k) + w_T ℓ(ξ_T, u_{T-1})

    A plan is the perturbation ν of the law. A planner of this task is a controller
    along a path, see `along_reference`; its predicted states are ξ. |ν| stays within
    `law.perturbation`, as it did in the training data.

    Attributes:
        law: the one that the model was learned around. All others are those of
            `LawTask`, the model in path coordinates.
    """

    law: PathLaw

    def __post_init__(self) -> None:
        if not self.model.along_path:
            raise ValueError(
                "controller.sampling=law needs a model in path coordinates: "
                "model.frame=path"
            )
        super().__post_init__()

    def prepare(
        self,
        params: Params,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Return fibre, start, law and targets, evaluated once per control step."""
        fiber = self.model.fiber(fold(self.model, params), env)
        turns = jax.vmap(self.law.turn, in_axes=(0, 0, None))(
            preview.road[:, 0], preview.road[:, 1], env
        )
        first = jax.tree.map(lambda leaf: leaf[0], turns)
        law_control = jnp.clip(first.feedback(coordinates), *self.box())
        # Before the first step no control was applied: slew limits count from the law.
        before = jnp.where(previous.known, previous.control, law_control)
        latent = self.model.encode(fiber, path_state(coordinates))
        start = Sample(latent, coordinates, before)
        on_road = self.model.on_road
        fibers = on_road and jax.vmap(partial(on_road, fiber))(preview.road)
        return RolloutSetup(fiber, start, AlongTarget(preview.road, turns, fibers))

    def step(
        self,
        weights: Any,
        fiber: Any,
        before: Sample,
        nu: Control,
        target: AlongTarget,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: law, perturbation, limits, model."""
        law_control = target.turn.feedback(before.state)
        most = jnp.asarray(self.law.perturbation)
        nu = entrywise(jnp.clip, nu, -most, most)
        control = self.limit(law_control + nu, before.control)
        # What the limits left of ν: the model was learned on what really acted.
        effective = control - law_control
        inputs = jnp.concatenate([effective, target.road])
        here = fiber if target.fiber is None else target.fiber
        latent = self.model.step(here, before.latent, inputs)
        coordinates = self.model.decode(fiber, latent)[BODY]
        sample = Sample(latent, coordinates, control)
        return StepResult(sample, control, effective, coordinates)

    def errors(
        self, before: Sample, after: Sample, target: AlongTarget
    ) -> tuple[PathErrors, PathErrors, Scalar]:
        """Return the errors before and after a step, and the speed of the reference."""
        speed = target.road[1]
        errors_before, errors = (
            PathErrors(xi[LATERAL], xi[HEADING], xi[PATH_SPEED] - speed)
            for xi in (before.state, after.state)
        )
        return errors_before, errors, speed


following_law = factory(FollowingLaw, lambda around: around.task(check_preview))
"""(model, cost, law, settings of `FollowingLaw`) -> `Task`."""


def check_preview(coordinates: Any, env: Any, preview: Any, horizon: int) -> None:
    """Raise a ValueError if there is no preview of this horizon."""
    if not isinstance(preview, Preview):
        raise ValueError(
            "a planner along a path takes ξ and a `Preview`; "
            "`along_reference` makes them of poses in the world"
        )
    if preview.road.shape != (horizon, 2):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; "
            f"got {preview.road.shape[0]} steps"
        )


class Request(NamedTuple):
    """State of a planner in the world, and what the world around it is."""

    inner: Any
    observation: State
    reference: Reference


PLANNED = ("cost", "mean_cost", "effective_samples", "predicted_states")
"""Entries of `info` that a planner alone can give."""
ABOUT = "about"
"""Entry of `info` that holds the planner's own on its way out of the guard."""


def requesting(planner: Controller, horizon: int, coordinates: int) -> Controller:
    """Return a planner in the world as one along a path, see `behind`.

    It observes what the caller does, bit for bit, where all of ξ is measured, and
    elsewhere the state that a gate believes.

    Args:
        planner: any.
        horizon: number of steps of the reference.
        coordinates: size of ξ.
    """

    def init(key: Key) -> Request:
        nothing = jnp.zeros(coordinates + 1), jnp.zeros((horizon, 4))
        return Request(planner.init(key), *nothing)

    def act(
        params: Params, state: Request, xi: PathState, env: Any, preview: Preview
    ) -> tuple[Control, Request, ControllerInfo]:
        bend = preview.road[0, 0]
        along = preview.along
        left = xi[LATERAL] + 0.5 * bend * along**2
        motion = jnp.stack([along, left, xi[HEADING] + bend * along])
        pose = compose(state.reference[0, POSE], motion)
        believed = jnp.concatenate([pose, xi[PATH_SPEED:]])
        seen = jnp.where(jnp.all(preview.measured), state.observation, believed)
        # What an adaptation adds to the model is not that of another planner.
        own = params.params if isinstance(params, Offset) else params
        planned, memory, about = planner.act(
            own, state.inner, seen, env, state.reference
        )
        planned = jnp.asarray(planned, dtype=float)
        if planned.shape != (2,):
            raise ValueError(f"a planner's control has shape (2,), got {planned.shape}")
        unknown = jnp.asarray(jnp.nan, dtype=float)
        info: Any = {
            **dict.fromkeys(PLANNED, unknown),
            "healthy": all_finite(planned) & about.get("healthy", True),
            "env_inside": jnp.asarray(True),
            "predicted_states": jnp.full((horizon, coordinates), unknown),
            ABOUT: about,
        }
        return planned, state._replace(inner=memory), info

    return Controller(init, act)


def behind(guard: Controller) -> Controller:
    """Return a guard in the world around a planner that is `requesting`, at any depth.

    What the projection loses travels in the state, past whatever wrapper is between;
    entries of the planner's `info` appear in that of the guard.
    """

    def act(
        params: Params, state: Any, observation: Any, env: Any, reference: Any
    ) -> tuple[Control, Any, ControllerInfo]:
        world = {"observation": observation, "reference": reference}
        shown = jax.tree.map(
            lambda node: node._replace(**world) if _is_request(node) else node,
            state,
            is_leaf=_is_request,
        )
        info: Any
        control, after, info = guard.act(params, shown, observation, env, reference)
        about = info.pop(ABOUT)
        known = {name: about[name] for name in PLANNED if name in about}
        merged: Any = {**about, **info, **known}
        return control, after, merged

    return Controller(guard.init, act)


def _is_request(node: Any) -> bool:
    return isinstance(node, Request)
