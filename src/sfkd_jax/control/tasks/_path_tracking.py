"""The task of following a path with a learned model, around a feedback law."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._model_law import ModelLaw
from sfkd_jax.control.laws._path_errors import Law, path_errors, reference_curvature
from sfkd_jax.control.tasks._costs import Cost, Stage
from sfkd_jax.control.tasks._task import (
    Actuator,
    Advanced,
    Applied,
    Began,
    Environments,
    Task,
    actuator_limits,
)
from sfkd_jax.types import Control, Environment, Model, Params, Reference, Scalar, State


class PathSample(NamedTuple):
    """A sample on its way along a path: latent, last path errors, last control."""

    latent: Any
    errors: Any
    control: Control


def path_tracking(
    model: Model,
    cost: Cost,
    law: Law | ModelLaw,
    *,
    dt: float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    control_rate: tuple[float, ...] | None = None,
    terminal_weight: float = 1.0,
    latent_weight: float = 0.0,
    actuator: Actuator | None = None,
    ancillary: ModelLaw | None = None,
) -> Task:
    """Follow a path with a learned model, around a feedback law on the *predicted* state.

        u_k = limit(clip(u_ff(κ_k) + K ξ_k) + ν_k),   J = Σ_k ℓ(x_k, u_k) + λ_z |z_k − z_k^ref|² + w_T ℓ(x_T, u_T)

    Args:
        model: rolled out; `fiber` and `encode` are evaluated once a step, outside the
            scan.
        cost: ℓ, see `tracking_cost`.
        law: u_ff + K ξ; see `path_feedback`, `ModelLaw`, `no_feedback`.
        dt: [s].
        control_low, control_high: actuator limits, in control units.
        control_rate: per second, or None.
        terminal_weight: w_T, on top of the last step's ℓ.
        latent_weight: λ_z.
        actuator: where the actuators stand, from the observation; else rates count from
            the control applied last.
        ancillary: a second law; what it would do along the whole horizon is one more
            sample.

    Raises:
        ValueError: limits that cannot be meant.
    """
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )

    def asked(state: State, target: Any) -> Control:
        """What the law wants at a state, as far as the actuators can give it."""
        point, curvature, _, turn = target
        if isinstance(law, ModelLaw):
            wanted = law.control(turn, state, point, curvature)
        else:
            wanted = law(path_errors(state, point, curvature), curvature, point[3])
        # Else a perturbation would also make up for what the law asks in vain: of a
        # reading far off, thousands of radians, which stay in the plan when the
        # readings are right again.
        return jnp.clip(wanted, low, high)

    def begin(
        params: Params,
        observation: State,
        env: Environment,
        reference: Reference,
        applied: Applied,
    ) -> Began:
        fiber = model.fiber(
            model.fold(params), env
        )  # of many rollouts; nothing is left to fold if that was done ahead
        curvature = reference_curvature(reference)
        goals = jax.vmap(
            lambda point: model.encode(fiber, _on_path(observation, point))
        )(reference)
        errors = path_errors(observation, reference[0], curvature[0])
        turns = None
        if isinstance(law, ModelLaw):
            turns = law.prepare(model, fiber, observation, reference, curvature)
        targets = (reference, curvature, goals, turns)
        lawful = asked(observation, jax.tree.map(lambda leaf: leaf[0], targets))
        before = jnp.where(applied.known, applied.control, lawful)
        if actuator is not None:
            before = actuator(observation)
        start = PathSample(model.encode(fiber, observation), errors, before)
        proposals = None
        if ancillary is not None:
            turns = ancillary.prepare(model, fiber, observation, reference, curvature)
            proposals = followed(ancillary, turns, fiber, start, targets)
        return Began(fiber, start, targets, proposals)

    def followed(
        other: ModelLaw, turns: Any, fiber: Any, start: PathSample, targets: Any
    ) -> Array:
        """What another law does along the horizon, as a perturbation of the law: (1, horizon, control)."""

        def step(before: PathSample, inputs: Any) -> tuple[PathSample, Control]:
            target, turn = inputs
            point, curvature, _, _ = target
            state = model.decode(fiber, before.latent)
            nu = other.control(turn, state, point, curvature) - asked(state, target)
            after = advance(cost.weights, fiber, before, nu, target, jnp.zeros(()))
            return after.sample, after.perturbation

        return jax.lax.scan(step, start, (targets, turns))[1][None]

    def advance(
        weights: Any,
        fiber: Any,
        before: PathSample,
        nu: Control,
        target: Any,
        last: Scalar,
    ) -> Advanced:
        point, curvature, goal, _ = target
        lawful = asked(model.decode(fiber, before.latent), target)
        control = limit(lawful + nu, before.control)
        latent = model.step(fiber, before.latent, control)
        after = model.decode(fiber, latent)
        errors = path_errors(after, point, curvature)
        charge = cost.stage(
            weights, Stage(errors, before.errors, control, before.control, point[3])
        )
        if latent_weight:
            charge = charge + latent_weight * jnp.sum(
                (model.vector(latent) - model.vector(goal)) ** 2
            )
        charge = charge * (1.0 + terminal_weight * last)
        return Advanced(
            PathSample(latent, errors, control),
            charge,
            control,
            control - lawful,
            after,
        )

    return Task(low, high, cost.weights, begin, advance, check_path)


def _on_path(state: State, point: Float[Array, " 4"]) -> State:
    """The state of driving along the reference: its pose and speed, all else zero."""
    return jnp.zeros_like(state).at[:4].set(point)


def check_path(
    observation: State, env: Environments, reference: Any, horizon: int
) -> None:
    """Name the argument that has the wrong shape."""
    if observation.ndim != 1 or observation.shape[0] < 4:
        raise ValueError(
            f"observation must be (p_x, p_y, yaw, v, …), shape (nx,), got {observation.shape}"
        )
    if env.ndim not in (1, 2):
        raise ValueError(
            f"env must have shape (ne,), or (particle, ne), got {env.shape}"
        )
    if reference.shape != (horizon, 4):
        raise ValueError(
            f"reference must have shape ({horizon}, 4): x, y, yaw, speed; got {reference.shape}"
        )
