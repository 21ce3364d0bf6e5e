"""The benchmark car of the paper: a bicycle with friction saturation."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp

from sfkd_jax.driving.plants._variables import states_of
from sfkd_jax.driving.plants._vehicle import (
    CAR_CONTROLS,
    Vehicle,
    nominal_derivative,
    resistance,
    rk4,
    side_force,
)
from sfkd_jax.ranges import Positive, Real
from sfkd_jax.types import GRAVITY, Control, Environment, Scalar, State


def _tanhc(x: Scalar) -> Scalar:
    """Return tanh(x) / x for x ≥ 0; value and gradient are finite at 0."""
    # Below 1e-3 the next term of the series, x⁴, is less than float32 resolves.
    small = x < 1e-3
    # The gradient of `where` evaluates both branches: a division by 0 in the one that
    # is not taken would make it NaN.
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - x**2 / 3.0, jnp.tanh(safe) / safe)


class CarParameters(NamedTuple):
    """Parameters of `kinematic` and `dynamic`, whose docstrings say what they are."""

    mass: float
    front_length: float
    rear_length: float
    front_stiffness: float
    rear_stiffness: float
    wind_force: float
    wind_lever: float
    drag: float
    rolling: float

    @property
    def length(self) -> float:
        """Wheelbase [m]."""
        return self.front_length + self.rear_length


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
    friction circle. Its radius a_lim = μ g − |F|/m is the grip that the wind leaves,
    but at least 0.05 μ g, so that the equations stay finite in any wind:

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
        wind_force: side force per squared wind speed, c_w [N s²/m²]. The default is
            that of an exposed, box-shaped body.
        wind_lever: l_w, how far ahead of the centre of mass the side force acts [m].
        drag: ρ C_d A / 2 [N s²/m²].
        rolling: c_rr, rolling resistance coefficient [-].
        stiffness_by_friction: whether C = c μ. If not, friction enters by saturation
            alone.
    """
    car = CarParameters(
        mass=mass,
        front_length=front_length,
        rear_length=rear_length,
        front_stiffness=front_stiffness,
        rear_stiffness=rear_stiffness,
        wind_force=wind_force,
        wind_lever=wind_lever,
        drag=drag,
        rolling=rolling,
    )
    derivative = functools.partial(_kinematic_derivative, car, stiffness_by_friction)
    bicycle = nominal_derivative(car.length, rear_length)
    return Vehicle(
        name="kinematic" if stiffness_by_friction else "kinematic_stiff",
        dt=dt,
        wheelbase=car.length,
        states=states_of(("p_x", "p_y", "yaw", "v")),
        controls=CAR_CONTROLS,
        step=rk4(derivative, dt=dt, substeps=substeps),
        derivative=derivative,
        nominal=rk4(bicycle, dt=dt),
        nominal_derivative=bicycle,
        wind_force=wind_force,
    )


def _kinematic_derivative(
    car: CarParameters,
    stiffness_by_friction: bool,
    state: State,
    control: Control,
    env: Environment,
) -> State:
    """Return dx/dt of `kinematic`."""
    yaw = state[2]
    speed = state[3]
    steering = control[0]
    acceleration = control[1]
    friction = env[0]
    stiffness_scale = friction if stiffness_by_friction else 1.0
    front_stiffness = car.front_stiffness * stiffness_scale
    rear_stiffness = car.rear_stiffness * stiffness_scale
    force = side_force(env[1], wind_force=car.wind_force)
    # κ°, the curvature of tyres that do not saturate.
    demand = _steady_curvature(
        car, steering, speed, force, (front_stiffness, rear_stiffness)
    )
    # At least a twentieth of the grip: strong wind would make the remainder negative.
    remaining_grip = friction * GRAVITY - jnp.abs(force) / car.mass
    limit = jnp.maximum(remaining_grip, 0.05 * friction * GRAVITY)
    # 1e-12, because the root has no gradient at 0, where a car coasts straight on.
    norm = jnp.sqrt(acceleration**2 + (speed**2 * demand) ** 2 + 1e-12)
    # Turning and accelerating are scaled alike, so that the demand keeps its direction.
    scale = _tanhc(norm / limit)
    curvature = scale * demand
    rear_force = (
        car.front_length * car.mass * speed**2 * curvature
        - (car.front_length - car.wind_lever) * force
    ) / car.length
    slip = car.rear_length * curvature - rear_force / rear_stiffness
    x_rate = speed * jnp.cos(yaw + slip)
    y_rate = speed * jnp.sin(yaw + slip)
    slowing = resistance(speed, mass=car.mass, drag=car.drag, rolling=car.rolling)
    speed_rate = scale * acceleration - slowing
    return jnp.stack([x_rate, y_rate, speed * curvature, speed_rate])


def _steady_curvature(
    car: CarParameters,
    steering: Scalar,
    speed: Scalar,
    force: Scalar,
    stiffnesses: tuple[float | Scalar, float | Scalar],
) -> Scalar:
    """Return κ° [1/m] of a car whose tyres do not saturate.

    Args:
        car: its parameters.
        steering: δ [rad].
        speed: v [m/s].
        force: F, of the wind [N].
        stiffnesses: C of the front and of the rear axle [N/rad].
    """
    front, rear = stiffnesses
    understeer = (
        car.mass / car.length * (car.rear_length / front - car.front_length / rear)
    )
    push = (
        (car.rear_length + car.wind_lever) / front
        - (car.front_length - car.wind_lever) / rear
    ) / car.length
    return (jnp.tan(steering) + push * force) / (car.length + understeer * speed**2)


@functools.wraps(kinematic, assigned=("__annotations__",))
def kinematic_stiff(**settings: Any) -> Vehicle:
    """Return `kinematic` with stiffnesses that do not depend on friction.

    Friction then limits forces and does not scale the effect of the steering. A model
    that is affine in (u, e) can represent this car as long as it does not saturate.

    Args:
        settings: of `kinematic`, stiffnesses in N/rad.
    """
    # `wraps` copies the annotations, so that the settings have the ranges of
    # `kinematic`.
    return kinematic(**settings, stiffness_by_friction=False)
