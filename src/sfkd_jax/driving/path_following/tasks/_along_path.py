"""Driving along a path: the projection of each step, and the task of following a law.

A controller along a path is a `Controller` whose observation is ξ and whose reference
is a `Preview`. `along_reference` turns it into one that sees poses in the world.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control import (
    AroundLaw,
    LawTarget,
    PlanningStart,
    RolloutSetup,
    Sample,
    Stateful,
    StepIndex,
    StepResult,
    Task,
    all_finite,
    factory,
)
from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_FRAME,
    PATH_SPEED,
    PathState,
    beside,
    curvature_ahead,
    followable,
    projected,
)
from sfkd_jax.driving.path_following.laws._feedback import PathErrors
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.driving.path_following.tasks._path_tracking import LawTask, check_path
from sfkd_jax.driving.path_following.tasks._preview import (
    YAW,
    Preview,
    check_preview,
    later,
    road_from,
)
from sfkd_jax.info import ControllerInfo, PathInfo, Reason, first, reported
from sfkd_jax.latency import ON_TIME, CommandDelay, delayed, pushed, rows_needed
from sfkd_jax.types import (
    Control,
    Controller,
    Environment,
    Fiber,
    Key,
    Params,
    Reference,
    Scalar,
    State,
)


class AlongReferenceState(NamedTuple):
    """What is kept from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        observations: the last ones in the world, newest last.
        sent: the last commands that may still act, newest last.
    """

    inner: Any
    observations: Float[Array, "time state"]
    sent: Float[Array, "step control"]


@dataclass(frozen=True, eq=False)
class AlongReference(Stateful):
    """A controller in the world from one along a path.

    This is the only place where a state is projected onto the path, once per control
    step. Predicted states are mapped back beside the points of the reference.

    `info` gains `path`, see `PathInfo`; its ξ and inputs are NaN if the observation or
    the reference is not finite.

    Attributes:
        inner: its `act` takes ξ and a `Preview` in place of observation and reference.
        coordinates: size of ξ.
        delay: of the commands after the oldest entry of an observation.
        hold_back: periods by which each entry of an observation is younger than the
            oldest one. It is used that much later, so that all are of one time.
    """

    inner: Controller
    _: KW_ONLY
    coordinates: int
    delay: CommandDelay = ON_TIME
    hold_back: tuple[float, ...] = ()

    def init(self, key: Key) -> AlongReferenceState:
        """Return the state before the first control step."""
        # NaN equals nothing, so the first observation is never a repetition.
        rows = rows_needed(self.hold_back)
        return AlongReferenceState(
            inner=self.inner.init(key),
            observations=jnp.full((rows, self.coordinates + 1), jnp.nan, dtype=float),
            sent=jnp.full((self.delay.steps, 2), jnp.nan, dtype=float),
        )

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
        repeated = jnp.all(observation == state.observations[-1])
        observations = pushed(state.observations, observation)
        observation = delayed(observations, self.hold_back)
        points, is_followable = followable(reference)
        curvature = curvature_ahead(points)
        xi, along = projected(observation, points, curvature)
        road = jnp.stack([curvature, points[:, 3]], axis=1)
        # κ can be finite where a position is not, because such points count as one.
        # A reference that cannot be trusted as a whole is NaN as a whole.
        readable = all_finite(points)
        road = jnp.where(readable, road, jnp.nan)
        xi = jnp.where(readable & all_finite(observation), xi, jnp.nan)
        preview = Preview(
            road=road,
            along=along,
            observation=observation,
            reference=reference,
            sent=state.sent,
            later=jnp.zeros(()),
            repeated=repeated,
            measured=jnp.isfinite(xi),
            on_time=jnp.asarray(True),
            reason=first(
                Reason.CERTIFIED,
                (~(readable & is_followable), Reason.BAD_REFERENCE),
                (~precise & all_finite(observation), Reason.IMPRECISE),
            ),
        )
        control, inner, info = self.inner.act(params, state.inner, xi, env, preview)
        info = reported(info)
        planned = info.plan.states
        if planned is not None:
            passing = self.delay.first
            if info.gate is not None:
                passing += info.gate.later
            ahead = later(points, passing, len(planned), angle=YAW)
            states = jax.vmap(beside)(planned, ahead)
        else:
            states = reported(info.planner).plan.states
        info = info._replace(plan=info.plan._replace(states=states))
        measured = preview.measured if info.gate is None else info.gate.measured
        seen = jnp.where(measured, xi, jnp.nan)
        inputs = road_from(preview, along)[0]
        info = info._replace(
            claim=info.claim.under(preview.reason),
            path=PathInfo(xi=seen, inputs=inputs, planned=planned),
        )
        sent = pushed(state.sent, control)
        return control, AlongReferenceState(inner, observations, sent), info


along_reference = factory(AlongReference, AlongReference.controller)
"""(controller along a path, coordinates=size of ξ) -> `Controller` in the world."""


@dataclass(frozen=True, eq=False)
class FollowingLaw(LawTask):
    """The task of following a path with a model of the closed loop.

        ξ_{k+1} = F(ξ_k, (ν_k, κ_k, v_k); e),   u_k = limit(law(ξ_k; κ_k, v_k, e) + ν_k)
        J = Σ_k ℓ(ξ_{k+1}, u_k) + w_T ℓ(ξ_T, u_{T-1})

    A plan is the perturbation ν of the law. A planner of this task is a controller
    along a path, see `along_reference`; its predicted states are ξ. |ν| stays within
    `law.perturbation`, as it did in the training data.

    Attributes:
        law: around which the model was learned. The other attributes are those of
            `LawTask`, with a model in path coordinates.
    """

    law: PathLaw

    def __post_init__(self) -> None:
        if self.model.frame is not PATH_FRAME:
            raise ValueError(
                "controller.sampling=law needs a model in path coordinates: "
                "model.frame=path"
            )
        super().__post_init__()

    @property
    def _around_law(self) -> AroundLaw:
        """Rollouts on roads (κ, v_ref).

        Not cached: its arrays belong to the program that is being traced.
        """

        def turn(road: Float[Array, " 2"], env: Environment) -> SteadyTurn:
            return self.law.turn(road[0], road[1], env)

        low, high = self.box()
        perturbation = jnp.asarray(self.law.perturbation)
        return AroundLaw(self.model, turn, perturbation, low, high, self.limit)

    def prepare(
        self,
        params: Params,
        xi: PathState,
        env: Environment,
        preview: Preview,
        previous: PlanningStart,
    ) -> RolloutSetup:
        """Return what is evaluated once per control step: fibre, start and targets."""
        return self._around_law.prepare(params, xi, env, preview.road, previous)

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
        return self._around_law.step(weights, fiber, before, nu, target, at)

    def errors(
        self, before: Sample, after: Sample, target: LawTarget
    ) -> tuple[PathErrors, PathErrors, Scalar]:
        """Return the errors before and after a step, and the speed of the reference."""
        speed = target.inputs[1]

        def errors_of(xi: PathState) -> PathErrors:
            return PathErrors(xi[LATERAL], xi[HEADING], xi[PATH_SPEED] - speed)

        return errors_of(before.state), errors_of(after.state), speed


def _task(settings: FollowingLaw) -> Task:
    """Return the task of following a law, which checks previews."""
    return settings.task(check_preview)


following_law = factory(FollowingLaw, _task)
"""(model, cost, law, settings of `FollowingLaw`) -> `Task`."""
