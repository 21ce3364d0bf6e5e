"""The task of following a path in path coordinates: the law inside, the curvature previewed, no pose."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._path_errors import PathErrors
from sfkd_jax.control.laws._path_law import PathLaw, at_turn
from sfkd_jax.control.tasks._costs import Cost, Stage
from sfkd_jax.control.tasks._path_tracking import check_path
from sfkd_jax.control.tasks._task import Advanced, Applied, Began, Task, actuator_limits
from sfkd_jax.core.path_frame import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    on_circle,
    path_state,
)
from sfkd_jax.core.se2 import between, wrap_angle
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
    """A sample on its way: latent, path coordinates, last control."""

    latent: Any
    coordinates: PathState
    control: Control


def curvature_ahead(reference: Reference) -> Float[Array, " horizon"]:
    """κ over each step that leads to a reference point [1/m]; 0 where points coincide.

    Between points it is the turn over the distance. The step to the first point begins
    where the car is, for which there is no point: its curvature continues the next two
    as a straight line.
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
    """ξ of a state in the world, against the circle of curvature κ through a reference point (x, y, yaw, …)."""
    lateral, heading = on_circle(between(point[POSE], state[POSE]), curvature)
    return jnp.concatenate([jnp.stack([lateral, heading]), state[BODY]])


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
    """Follow a path with a model of the closed loop; a plan is what is added to the law.

        ξ_{k+1} = F(ξ_k, (ν_k, κ_k, v_k); e),   u_k = limit(law(ξ_k; κ_k, v_k, e) + ν_k),
        J = Σ_k ℓ(ξ_{k+1}, u_k) + w_T ℓ(ξ_T, u_{T-1})

    The observation and the reference are those of any other controller, poses in the
    world. They are projected once a step; rollouts know ξ and the curvature ahead, and
    predicted states are put beside the reference points at the end. |ν| stays within
    `law.perturbation`, as it did in the data.

    Args:
        model: of path states, `along_path`.
        cost: ℓ, see `tracking_cost`.
        law: the one that the model was learned around.
        dt: [s].
        control_low, control_high: actuator limits.
        control_rate: per second, or None.
        terminal_weight: w_T, on top of the last step's ℓ.

    Raises:
        ValueError: a model of another frame, or limits that cannot be meant.
    """
    if not model.along_path:
        raise ValueError(
            "controller.sampling=law needs a model in path coordinates: model.frame=path"
        )
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )

    def begin(
        params: Params,
        observation: State,
        env: Environment,
        reference: Reference,
        applied: Applied,
    ) -> Began:
        fiber = model.fiber(model.fold(params), env)  # of many rollouts
        curvatures = curvature_ahead(reference)
        coordinates = path_coordinates(observation, reference[0], curvatures[0])
        turns = jax.vmap(law.turn, in_axes=(0, 0, None))(
            curvatures, reference[:, 3], env
        )
        lawful = jnp.clip(
            at_turn(jax.tree.map(lambda leaf: leaf[0], turns), coordinates), low, high
        )
        before = jnp.where(applied.known, applied.control, lawful)
        start = AlongSample(
            model.encode(fiber, path_state(coordinates)), coordinates, before
        )
        sideways = jnp.stack(
            [-jnp.sin(reference[:, 2]), jnp.cos(reference[:, 2])], axis=1
        )
        return Began(fiber, start, (reference, sideways, curvatures, turns))

    def advance(
        weights: Any,
        fiber: Any,
        before: AlongSample,
        nu: Control,
        target: Any,
        last: Scalar,
    ) -> Advanced:
        point, sideways, curvature, turn = target
        lawful = at_turn(turn, before.coordinates)
        control = limit(
            lawful + jnp.clip(nu, -law.perturbation, law.perturbation), before.control
        )
        effective = control - lawful
        inputs = jnp.concatenate([effective, jnp.stack([curvature, point[3]])])
        latent = model.step(fiber, before.latent, inputs)
        coordinates = model.decode(fiber, latent)[BODY]
        here, there = (
            _errors(coordinates, point[3]),
            _errors(before.coordinates, point[3]),
        )
        charge = cost.stage(
            weights, Stage(here, there, control, before.control, point[3])
        )
        charge = charge * (1.0 + terminal_weight * last)
        position = point[:2] + coordinates[LATERAL] * sideways
        yaw = point[2] + coordinates[HEADING]
        state = jnp.concatenate([position, yaw[None], coordinates[PATH_SPEED:]])
        return Advanced(
            AlongSample(latent, coordinates, control), charge, control, effective, state
        )

    return Task(low, high, cost.weights, begin, advance, check_path)


def _errors(coordinates: PathState, speed: Scalar) -> PathErrors:
    """As a stage cost wants them."""
    return PathErrors(
        coordinates[LATERAL], coordinates[HEADING], coordinates[PATH_SPEED] - speed
    )
