"""Unmeasured causes of a closed loop along a path, by the derivatives of its model."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.geometry import LATERAL, PATH_SPEED, PathState, path_state
from sfkd_jax.rollout import Offset
from sfkd_jax.types import BODY, Control, Environment, Model, Params, Scalar

FRICTION, WIND = 0, 1
"""Entries of e."""
FORCE, STEERING, DRIVE, TURN_STEERING, TURN_FORCE = range(5)
"""Entries of the causes: the last two are in proportion to κ."""
CAUSES = 5
FORCE_STEP = 0.25
"""Half the difference of relative side forces that a slope is taken over."""
TIGHTEST = 0.02
"""Curvature [1/m] at which the causes in proportion to κ have their full effect."""


class Loop(NamedTuple):
    """The learned closed loop and the box of its environments.

    Attributes:
        model: in path coordinates, without offset.
        law: around which it was learned.
        low: lower end of E.
        high: upper end of E; wind in [-high, high].
    """

    model: Model
    law: PathLaw
    low: Environment
    high: Environment


class Applied(NamedTuple):
    """What acts on the vehicle over one step.

    Attributes:
        control: u.
        road: κ [1/m] and v_ref [m/s].
        env: e, in its box.
    """

    control: Control
    road: Float[Array, " 2"]
    env: Environment


def relative_force(loop: Loop, env: Environment) -> Scalar:
    """Return the side force w|w| relative to the largest one in E."""
    return env[WIND] * jnp.abs(env[WIND]) / loop.high[WIND] ** 2


def with_force(loop: Loop, env: Environment, force: Scalar) -> Environment:
    """Return e with the wind of a relative side force."""
    # The root has no derivative at 0; nothing differentiates by the force.
    root = jnp.sign(force) * jnp.sqrt(jnp.abs(force))
    return env.at[WIND].set(loop.high[WIND] * root)


def split_force(
    loop: Loop, env: Environment, force: Scalar
) -> tuple[Environment, Scalar]:
    """Return the e in E with as much of a side force as fits, and the rest.

    Args:
        loop: with the box of e.
        env: e without the force.
        force: in addition to the wind, relative to the largest in E.
    """
    total = relative_force(loop, env) + force
    inside = jnp.clip(total, -1.0, 1.0)
    return with_force(loop, env, inside), total - inside


def next_coordinates(
    loop: Loop, params: Params, applied: Applied, coordinates: PathState
) -> PathState:
    """Return ξ one step later under a given control of the vehicle.

    The model takes ν = u − law(ξ; κ, v_ref, e).

    Args:
        loop: the model and its law.
        params: of the model.
        applied: u, κ, v_ref and e.
        coordinates: ξ.
    """
    road, env = applied.road, applied.env
    nu = applied.control - loop.law(coordinates, road[0], road[1], env)
    fiber = loop.model.fiber(params, env)
    latent = loop.model.encode(fiber, path_state(coordinates))
    after = loop.model.step(fiber, latent, jnp.concatenate([nu, road]))
    return loop.model.decode(fiber, after)[BODY]


def force_slope(
    loop: Loop, params: Params, applied: Applied, coordinates: PathState
) -> PathState:
    """Return ∂ξ⁺/∂(relative side force) at a given control.

    A difference over the forces near that of e; at an end of E, into E. Beyond E the
    model is continued along this slope.
    """
    force = relative_force(loop, applied.env)
    ends = jnp.clip(force + jnp.array([-FORCE_STEP, FORCE_STEP]), -1.0, 1.0)

    def at(end: Scalar) -> PathState:
        env = with_force(loop, applied.env, end)
        return next_coordinates(loop, params, applied._replace(env=env), coordinates)

    return (at(ends[1]) - at(ends[0])) / (ends[1] - ends[0])


def side_force(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Scalar:
    """Return the relative side force of the causes on a road, see `input_error`."""
    return causes[FORCE] + causes[TURN_FORCE] * road[0] / TIGHTEST


def input_error(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Control:
    """Return the difference between the control that acts and the one applied.

    Args:
        causes: (relative side force, steering [rad], drive [control unit], steering
            [rad] and relative side force in the tightest turn).
        road: κ [1/m] and v_ref [m/s].
    """
    steering = causes[STEERING] + causes[TURN_STEERING] * road[0] / TIGHTEST
    return jnp.stack([steering, causes[DRIVE]])


def predicted(
    loop: Loop,
    params: Params,
    applied: Applied,
    coordinates: PathState,
    causes: Float[Array, " cause"],
) -> tuple[PathState, Float[Array, "coordinate vector"]]:
    """Return ξ⁺ under unmeasured causes, and its Jacobian by (ξ, causes).

    The force acts as wind within E and along `force_slope` beyond it.

    Args:
        loop: the model and its law.
        params: of the model.
        applied: e is that without the causes.
        coordinates: ξ.
        causes: see `input_error`.
    """
    force = side_force(causes, applied.road)
    env, excess = split_force(loop, applied.env, force)
    applied = applied._replace(env=env)
    slope = force_slope(loop, params, applied, coordinates)

    def advance(vector: Float[Array, " vector"]) -> PathState:
        split = coordinates.shape[0]
        error = input_error(vector[split:], applied.road)
        actual = applied._replace(control=applied.control + error)
        return next_coordinates(loop, params, actual, vector[:split])

    vector = jnp.concatenate([coordinates, causes])
    jacobian = jax.jacfwd(advance)(vector)
    share = applied.road[0] / TIGHTEST
    at = coordinates.shape[0]
    jacobian = jacobian.at[:, at + FORCE].set(slope)
    jacobian = jacobian.at[:, at + TURN_FORCE].set(share * slope)
    return advance(vector) + excess * slope, jacobian


def compensation(
    loop: Loop,
    params: Params,
    env: Environment,
    road: Float[Array, " 2"],
    coordinates: PathState,
    excess: Scalar,
) -> Offset:
    """Return the model with a force beyond E and the steering that balances it.

        d = excess · ∂ξ⁺/∂force,   Δξ = A Δξ + B δ + d,   Δe_y = Δv = 0,
        z⁺ = F(z, w + δ; e) + ∂Φ/∂ξ d

    δ is the offset-free target of the closed loop (Pannocchia and Rawlings, 2003);
    only its steering is used. A and B are the derivatives of one step of the loop.

    Args:
        loop: the model and its law.
        params: of the model.
        env: e in E, with the force inside E.
        road: κ [1/m] and v_ref [m/s].
        coordinates: ξ.
        excess: force beyond E, relative to the largest in E.
    """
    model, size = loop.model, coordinates.shape[0]
    fiber = model.fiber(params, env)
    law_control = loop.law(coordinates, road[0], road[1], env)
    applied = Applied(law_control, road, env)
    shifted = excess * force_slope(loop, params, applied, coordinates)

    def advance(xi: PathState, nu: Control) -> PathState:
        latent = model.encode(fiber, path_state(xi))
        after = model.step(fiber, latent, jnp.concatenate([nu, road]))
        return model.decode(fiber, after)[BODY]

    A, B = jax.jacfwd(advance, (0, 1))(coordinates, jnp.zeros(2))
    equations = jnp.eye(size) - A
    equations = equations.at[:, LATERAL].set(-B[:, 0]).at[:, PATH_SPEED].set(-B[:, 1])
    steering = jnp.linalg.solve(equations, shifted)[LATERAL]
    most = 2.0 * loop.law.perturbation[0]
    steering = jnp.clip(jnp.nan_to_num(steering), -most, most)
    moved = path_state(shifted)
    _, latent = jax.jvp(
        lambda state: model.encode(fiber, state), (path_state(coordinates),), (moved,)
    )
    latent = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(leaf), leaf, 0.0), latent)
    return Offset(params, jnp.zeros(4).at[0].set(steering), latent)
