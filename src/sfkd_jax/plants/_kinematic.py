"""The paper's plant: a 4-state bicycle with tyre saturation and side wind."""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp

from sfkd_jax.plants._vehicle import (
    CONTROL_HIGH,
    CONTROL_LOW,
    GRAVITY,
    Vehicle,
    nominal_derivative,
    resistance,
    rk4,
    side_force,
)
from sfkd_jax.ranges import Positive, Real
from sfkd_jax.types import Control, Environment, Scalar, State


def _tanhc(x: Scalar) -> Scalar:
    """tanh(x) / x for x ≥ 0, finite at 0 with its gradient."""
    # Below 1e-3 the next term, x⁴, is under what float32 resolves beside 1.
    small = x < 1e-3
    # Both branches are differentiated: a division by 0 would give NaN in either.
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - x**2 / 3.0, jnp.tanh(safe) / safe)


def kinematic(
    *,
    dt: Positive = 0.1,
    substeps: int = 2,
    mass: Positive = 1500.0,
    front_length: Positive = 1.2,
    rear_length: Positive = 1.5,
    front_stiffness: Positive = 6.0e4,
    rear_stiffness: Positive = 7.0e4,
    wind_force: float = 10.0,
    wind_lever: Real = 0.4,
    drag: float = 0.4,
    rolling: float = 0.012,
    stiffness_by_friction: bool = True,
) -> Vehicle:
    """Bicycle with friction saturation and quasi-steady side wind.

    x = (p_x, p_y, yaw, v), p the centre of mass. With F = c_w w|w| and axle stiffnesses
    C = c μ, or C = c, the steady single track turns with curvature

        κ° = (tan δ + γ F) / (L + K v²),   K = m (l_r/C_f − l_f/C_r) / L,
        γ  = ((l_r + l_w)/C_f − (l_f − l_w)/C_r) / L,

    as long as the tyres do not saturate. The demand (a, v² κ°) is scaled into the
    friction circle of radius a_lim = μ g − |F|/m, which is what the wind leaves, at
    least 0.05 μ g, so that the equations stay finite in any wind:

        s = tanh(d/a_lim)/(d/a_lim),   d = |(a, v² κ°)|,
        κ = s κ°,   β = l_r κ − (l_f m v² κ − (l_f − l_w) F)/(L C_r)
        ẋ = (v cos(yaw + β), v sin(yaw + β), v κ, s a − ρ v²/(2m)·C_d A − c_rr g)

    Args:
        dt: sampling period [s].
        substeps: RK4 steps per period.
        mass: [kg].
        front_length: front axle to centre of mass [m].
        rear_length: rear axle to centre of mass [m].
        front_stiffness: cornering stiffness of the front axle per unit friction
            [N/rad].
        rear_stiffness: cornering stiffness of the rear axle per unit friction [N/rad].
        wind_force: side force per squared wind speed, c_w [N s²/m²] (an exposed,
            box-shaped body).
        wind_lever: l_w, how far ahead of the centre of mass the side force acts [m].
        drag: ρ C_d A / 2 [N s²/m²].
        rolling: rolling resistance coefficient [-].
        stiffness_by_friction: whether C = c μ; if not, friction enters by saturation
            alone.
    """
    length = front_length + rear_length
    bicycle = nominal_derivative(length, rear_length)

    def derivative(state: State, control: Control, env: Environment) -> State:
        yaw, speed = state[2], state[3]
        steering, acceleration = control[0], control[1]
        friction, wind = env[0], env[1]
        # At μ = 1 the stiffnesses are those given: friction then only limits forces.
        grip = friction if stiffness_by_friction else 1.0
        front, rear = front_stiffness * grip, rear_stiffness * grip
        force = side_force(wind, wind_force=wind_force)
        understeer = mass / length * (rear_length / front - front_length / rear)
        push = (
            (rear_length + wind_lever) / front - (front_length - wind_lever) / rear
        ) / length
        demand = (jnp.tan(steering) + push * force) / (length + understeer * speed**2)
        # At least a twentieth of the grip, or strong wind would make it negative.
        left = friction * GRAVITY - jnp.abs(force) / mass
        limit = jnp.maximum(left, 0.05 * friction * GRAVITY)
        # The root has no gradient at 0, where a car coasts straight on.
        norm = jnp.sqrt(acceleration**2 + (speed**2 * demand) ** 2 + 1e-12)
        scale = _tanhc(norm / limit)
        # One factor for steering and acceleration: the direction of the demand stays.
        curvature = scale * demand
        rear_force = (
            front_length * mass * speed**2 * curvature
            - (front_length - wind_lever) * force
        ) / length
        slip = rear_length * curvature - rear_force / rear
        x, y = speed * jnp.cos(yaw + slip), speed * jnp.sin(yaw + slip)
        slowed = resistance(speed, mass=mass, drag=drag, rolling=rolling)
        return jnp.stack([x, y, speed * curvature, scale * acceleration - slowed])

    return Vehicle(
        name="kinematic" if stiffness_by_friction else "kinematic_stiff",
        dt=dt,
        wheelbase=length,
        state_names=("p_x", "p_y", "yaw", "v"),
        step=rk4(derivative, dt=dt, substeps=substeps),
        derivative=derivative,
        nominal=rk4(bicycle, dt=dt),
        nominal_derivative=bicycle,
        control_low=CONTROL_LOW,
        control_high=CONTROL_HIGH,
        wind_force=wind_force,
    )


@functools.wraps(kinematic, assigned=("__annotations__",))
def kinematic_stiff(**settings: Any) -> Vehicle:
    """Return `kinematic` with stiffnesses that do not depend on friction.

    Friction then limits forces and does not scale the effect of the steering, which a
    model that is affine in (u, e) can represent below saturation.

    Args:
        settings: of `kinematic`, stiffnesses in N/rad.
    """
    # `wraps` hands on the annotations, so that settings keep the ranges of `kinematic`.
    return kinematic(**settings, stiffness_by_friction=False)
