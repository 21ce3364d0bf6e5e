"""The second benchmark car: a single track on brush tyres, with load transfer."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp

from sfkd_jax.driving.plants._kinematic import CarParameters
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
from sfkd_jax.types import GRAVITY, Control, Environment, Scalar, State, Step

BRAKING_SHARE = 0.95
"""Largest braking or driving acceleration in μ g: the tyres keep some lateral grip."""


def dynamic(
    *,
    dt: Positive = 0.1,
    substeps: int = 5,
    mass: Positive = 1500.0,
    yaw_inertia: Positive = 2500.0,
    front_length: Positive = 1.2,
    rear_length: Positive = 1.5,
    height: float = 0.55,
    front_stiffness: Positive = 9.0e4,
    rear_stiffness: Positive = 1.05e5,
    steering_lag: Positive = 0.1,
    steering_rate: Positive = 0.5,
    wind_force: float = 10.0,
    wind_lever: Real = 0.4,
    drag: float = 0.4,
    rolling: float = 0.012,
    creep_speed: Positive = 3.0,
) -> Vehicle:
    """Single track on brush tyres, x = (p_x, p_y, yaw, v, v_y, yaw rate ω, δ).

        a_x = 0.95 μ g tanh(a / (0.95 μ g)); braking fades like tanh(v / 0.2 m/s),
        N_f, N_r = m (g l_r ∓ a_x h)/L,  m (g l_f ± a_x h)/L,
        Y_i = −C_i t_i for small t_i, at most √((μ N_i)² − (N_i a_x/g)²), see `_brush`,
        m (v̇ − v_y ω) = a_x (N_f cos δ + N_r)/g − Y_f sin δ − resistance,
        m (v̇_y + v ω) = (N_f a_x/g) sin δ + Y_f cos δ + Y_r + F,
        I ω̇ = l_f ((N_f a_x/g) sin δ + Y_f cos δ) − l_r Y_r + l_w F,
        δ̇ = δ̇_max tanh((δ_cmd − δ)/(τ δ̇_max)),

    p is the centre of mass, F = c_w w|w|, and t_i the slip, the lateral over the
    longitudinal speed in the frame of wheel i. Drive and brakes act on both axles in
    proportion to load, so that both axles use the same share of their friction circle.
    The cornering stiffness does not depend on μ, only the limit does. (In `kinematic`
    the stiffness is linear in μ.)

    Below creep_speed the slip is relative to a speed that stays above creep_speed / 2.
    The tyre is then a strong damper of side slip, as in the kinematic bicycle, and the
    equations stay finite and are not stiff. The wind fades out with v there, because a
    tyre that does not roll holds the car. A car that spins past 90° stops at v = 0 and
    does not roll backwards. The default stiffnesses need dt / substeps ≤ 0.02 s, and
    the equations need μ > 0.

    Args:
        dt: sampling period [s].
        substeps: RK4 steps per period.
        mass: [kg].
        yaw_inertia: [kg m²].
        front_length: front axle to centre of mass [m].
        rear_length: rear axle to centre of mass [m].
        height: of the centre of mass [m].
        front_stiffness: cornering stiffness of the front axle [N/rad].
        rear_stiffness: cornering stiffness of the rear axle [N/rad].
        steering_lag: τ [s].
        steering_rate: δ̇_max [rad/s].
        wind_force: side force per squared wind speed, c_w [N s²/m²].
        wind_lever: l_w, how far ahead of the centre of mass the side force acts [m].
        drag: ρ C_d A / 2 [N s²/m²].
        rolling: rolling resistance coefficient [-].
        creep_speed: v_0, below which the tyres are regularised [m/s].
    """
    car = _DynamicCar(
        shared=CarParameters(
            mass=mass,
            front_length=front_length,
            rear_length=rear_length,
            front_stiffness=front_stiffness,
            rear_stiffness=rear_stiffness,
            wind_force=wind_force,
            wind_lever=wind_lever,
            drag=drag,
            rolling=rolling,
        ),
        yaw_inertia=yaw_inertia,
        height=height,
        steering_lag=steering_lag,
        steering_rate=steering_rate,
        creep_speed=creep_speed,
    )
    length = car.shared.length
    derivative = partial(_dynamic_derivative, car)
    bicycle = nominal_derivative(length, rear_length, states=7)
    return Vehicle(
        name="dynamic",
        dt=dt,
        wheelbase=length,
        states=states_of(("p_x", "p_y", "yaw", "v", "v_y", "yaw_rate", "steering")),
        controls=CAR_CONTROLS,
        step=rk4(derivative, dt=dt, substeps=substeps),
        derivative=derivative,
        nominal=_quasi_steady(rk4(bicycle, dt=dt), length, rear_length),
        nominal_derivative=bicycle,
        wind_force=wind_force,
    )


class _DynamicCar(NamedTuple):
    """Parameters of `dynamic`, which says what they are."""

    shared: CarParameters
    yaw_inertia: float
    height: float
    steering_lag: float
    steering_rate: float
    creep_speed: float


class _TyreForces(NamedTuple):
    """Forces of the tyres on the car, in the frame of the car [N]."""

    forward: Scalar  # of both axles
    front_side: Scalar  # of the front axle, to the left
    rear_side: Scalar  # of the rear axle, to the left


def _dynamic_derivative(
    car: _DynamicCar, state: State, control: Control, env: Environment
) -> State:
    """Return dx/dt of `dynamic`."""
    mass = car.shared.mass
    # In the order of `states` of `dynamic`.
    yaw, speed, side_speed, yaw_rate, steering = (state[k] for k in range(2, 7))
    grip = env[0] * GRAVITY
    drive = _acceleration(control, speed, grip)
    tyres = _tyre_forces(car, state, drive, grip)
    force = side_force(env[1], wind_force=car.shared.wind_force)
    wind = _rolling(speed, car.creep_speed) * force
    slowing = resistance(
        speed, mass=mass, drag=car.shared.drag, rolling=car.shared.rolling
    )
    steering_error = (control[0] - steering) / (car.steering_lag * car.steering_rate)
    # The frame rotates with the car, so that v̇ has the term + v_y ω and v̇_y − v ω.
    speed_rate = tyres.forward / mass + side_speed * yaw_rate - slowing
    side_total = tyres.front_side + tyres.rear_side + wind
    yaw_moment = (
        car.shared.front_length * tyres.front_side
        - car.shared.rear_length * tyres.rear_side
        + car.shared.wind_lever * wind
    )
    return jnp.stack(
        [
            speed * jnp.cos(yaw) - side_speed * jnp.sin(yaw),
            speed * jnp.sin(yaw) + side_speed * jnp.cos(yaw),
            yaw_rate,
            speed_rate,
            side_total / mass - speed * yaw_rate,
            yaw_moment / car.yaw_inertia,
            # tanh limits the rate of the actuator; a clip would have no gradient.
            car.steering_rate * jnp.tanh(steering_error),
        ]
    )


def _tyre_forces(
    car: _DynamicCar, state: State, drive: Scalar, grip: Scalar
) -> _TyreForces:
    """Return the forces of both axles.

    Args:
        car: its parameters.
        state: of the car.
        drive: a_x [m/s²].
        grip: μ g [m/s²].
    """
    mass = car.shared.mass
    front_length = car.shared.front_length
    rear_length = car.shared.rear_length
    speed, side_speed, yaw_rate, steering = (state[k] for k in range(3, 7))
    cos = jnp.cos(steering)
    sin = jnp.sin(steering)
    # Load moves to the front under braking, which turns a sliding car in.
    front_mass = mass * (rear_length - car.height * drive / GRAVITY) / car.shared.length
    rear_mass = mass - front_mass
    # Driving and braking use a part of the friction circle, and turning can use the
    # rest. The root is real, because `BRAKING_SHARE` keeps |a_x| below μ g.
    lateral_grip = jnp.sqrt(grip**2 - drive**2)
    front_side_speed = side_speed + front_length * yaw_rate
    # The velocity of the front axle, in the frame of the steered wheel.
    front_slip = _slip(
        speed * cos + front_side_speed * sin,
        front_side_speed * cos - speed * sin,
        car.creep_speed,
    )
    rear_slip = _slip(speed, side_speed - rear_length * yaw_rate, car.creep_speed)
    front = _brush(front_slip, car.shared.front_stiffness, front_mass * lateral_grip)
    rear = _brush(rear_slip, car.shared.rear_stiffness, rear_mass * lateral_grip)
    return _TyreForces(
        forward=front_mass * drive * cos + rear_mass * drive - front * sin,
        front_side=front_mass * drive * sin + front * cos,
        rear_side=rear,
    )


def _acceleration(control: Control, speed: Scalar, grip: Scalar) -> Scalar:
    """Return a_x [m/s²]: the commanded acceleration, limited by the grip μ g."""
    # tanh instead of a clip: a planner has a gradient beyond the limit of grip.
    drive = BRAKING_SHARE * grip * jnp.tanh(control[1] / (BRAKING_SHARE * grip))
    # Braking fades out at standstill. Driving does not: a car at rest must be able to
    # start.
    return jnp.maximum(drive, 0.0) + jnp.minimum(drive, 0.0) * jnp.tanh(speed / 0.2)


def _rolling(speed: Scalar, creep_speed: float) -> Scalar:
    """Return the share of the wind force that moves the car.

    It is 0 at standstill and 1 above creep_speed.
    """
    share = jnp.clip(jnp.abs(speed) / creep_speed, 0.0, 1.0)
    # Smoothstep: its slope is 0 at both ends, so that the wind fades without a kink.
    return share**2 * (3.0 - 2.0 * share)


def _slip(along: Scalar, across: Scalar, creep_speed: float) -> Scalar:
    """Return the tangent of the slip angle, v_across / |v_along|.

    Below v_0 the denominator is (v² + v_0²)/(2 v_0) ≥ v_0/2 instead of |v|. It is
    continuously differentiable.
    """
    # min and max join two formulas whose values and slopes agree at v_0.
    below = jnp.minimum(jnp.abs(along), creep_speed)
    beyond = jnp.maximum(jnp.abs(along), creep_speed) - creep_speed
    return across / ((below**2 + creep_speed**2) / (2.0 * creep_speed) + beyond)


def _brush(slip: Scalar, stiffness: float, limit: Scalar) -> Scalar:
    """Return the side force of a brush (Fiala) tyre [N].

        Y = −F_max (3θ − 3θ|θ| + θ³),   θ = C t / (3 F_max), clipped to [-1, 1]

    Args:
        slip: t, tangent of the slip angle.
        stiffness: C [N/rad].
        limit: F_max [N].
    """
    # At ±1 the cubic has slope 0: a sliding tyre gives the limit, whatever its slip.
    bristle = jnp.clip(stiffness * slip / (3.0 * limit), -1.0, 1.0)
    return -limit * bristle * (3.0 - 3.0 * jnp.abs(bristle) + bristle**2)


def _quasi_steady(bicycle: Step, length: float, rear_length: float) -> Step:
    """Return the step of a bicycle on the seven states of `dynamic`.

    A bicycle has no tyres, so that steering, yaw rate and lateral speed follow the
    command at once: δ = δ_cmd, ω = v κ, v_y = l_r ω.
    """

    def step(state: State, control: Control, env: Environment) -> State:
        after = bicycle(state, control, env)
        # From the new speed: all states are those at the end of the period.
        yaw_rate = after[3] * jnp.tan(control[0]) / length
        following = jnp.stack([rear_length * yaw_rate, yaw_rate, control[0]])
        return after.at[4:].set(following)

    return step
