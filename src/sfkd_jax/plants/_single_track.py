"""The two benchmark cars: the paper's bicycle, and a single track on brush tyres."""

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
from sfkd_jax.types import Control, Environment, Scalar, State, Step

BRAKING_SHARE = 0.95  # of μ g, so that the tyres keep some lateral grip


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
        yaw = state[2]
        speed = state[3]
        steering = control[0]
        acceleration = control[1]
        friction = env[0]
        wind = env[1]
        # At μ = 1 the stiffnesses are those given: friction then only limits forces.
        grip = friction if stiffness_by_friction else 1.0
        front = front_stiffness * grip
        rear = rear_stiffness * grip
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
        x = speed * jnp.cos(yaw + slip)
        y = speed * jnp.sin(yaw + slip)
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

        a_x = 0.95 μ g tanh(a / (0.95 μ g)), braking fades like tanh(v / 0.2 m/s),
        N_f, N_r = m (g l_r ∓ a_x h)/L,  m (g l_f ± a_x h)/L,
        Y_i = −C_i t_i if small, at most √((μ N_i)² − (N_i a_x/g)²), see `_brush`,
        m (v̇ − v_y ω) = a_x (N_f cos δ + N_r)/g − Y_f sin δ − resistance,
        m (v̇_y + v ω) = (N_f a_x/g) sin δ + Y_f cos δ + Y_r + F,
        I ω̇ = l_f ((N_f a_x/g) sin δ + Y_f cos δ) − l_r Y_r + l_w F,
        δ̇ = δ̇_max tanh((δ_cmd − δ)/(τ δ̇_max)),

    p is the centre of mass, F = c_w w|w|, and t_i the slip (lateral over longitudinal
    speed in the frame of wheel i). Drive and brakes act on both axles in proportion to
    load, so both use the same share of their friction circle. The cornering stiffness
    does not depend on μ (only the limit does), unlike that of `kinematic`, which is
    linear in μ.

    Below creep_speed the slip is relative to a speed that stays above creep_speed / 2.
    The tyre is then a strong damper of side slip, as in the kinematic bicycle, and the
    equations stay finite and non-stiff; the wind fades out with v, because a tyre that
    does not roll holds the car. Needs dt / substeps ≤ 0.02 s with the given stiffness,
    and μ > 0. A car that spins past 90° stops at v = 0 instead of rolling backwards.

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
        creep_speed: v_0, below it the tyres are regularised [m/s].
    """
    length = front_length + rear_length
    bicycle = nominal_derivative(length, rear_length, states=7)

    def derivative(state: State, control: Control, env: Environment) -> State:
        # In the order of `state_names` below.
        yaw, speed, side_speed, yaw_rate, steering = (state[k] for k in range(2, 7))
        grip = env[0] * GRAVITY
        cos = jnp.cos(steering)
        sin = jnp.sin(steering)
        drive = _acceleration(control, speed, grip)
        # Load moves to the front under braking, which turns a sliding car in.
        front_mass = mass * (rear_length - height * drive / GRAVITY) / length
        # What driving and braking use of the friction circle is missing for turning.
        # Real because `BRAKING_SHARE` is below 1: |drive| never reaches the grip.
        lateral_grip = jnp.sqrt(grip**2 - drive**2)
        wind = _rolling(speed, creep_speed) * side_force(env[1], wind_force=wind_force)

        front_side = side_speed + front_length * yaw_rate
        # Velocity of the front axle in the frame of the steered wheel.
        front_slip = _slip(
            speed * cos + front_side * sin, front_side * cos - speed * sin, creep_speed
        )
        rear_slip = _slip(speed, side_speed - rear_length * yaw_rate, creep_speed)
        front = _brush(front_slip, front_stiffness, front_mass * lateral_grip)
        # What the front axle carries the rear one does not: the total is m g.
        rear = _brush(rear_slip, rear_stiffness, (mass - front_mass) * lateral_grip)
        forward = front_mass * drive * cos + (mass - front_mass) * drive - front * sin
        sideways = front_mass * drive * sin + front * cos

        slowed = resistance(speed, mass=mass, drag=drag, rolling=rolling)
        lag = (control[0] - steering) / (steering_lag * steering_rate)
        return jnp.stack(
            [
                speed * jnp.cos(yaw) - side_speed * jnp.sin(yaw),
                speed * jnp.sin(yaw) + side_speed * jnp.cos(yaw),
                yaw_rate,
                # Rotating frame: v̇ has the term + v_y ω, and v̇_y below − v ω.
                forward / mass + side_speed * yaw_rate - slowed,
                (sideways + rear + wind) / mass - speed * yaw_rate,
                (front_length * sideways - rear_length * rear + wind_lever * wind)
                / yaw_inertia,
                # tanh limits the rate of the actuator; a clip would have no gradient.
                steering_rate * jnp.tanh(lag),
            ]
        )

    return Vehicle(
        name="dynamic",
        dt=dt,
        wheelbase=length,
        state_names=("p_x", "p_y", "yaw", "v", "v_y", "yaw_rate", "steering"),
        step=rk4(derivative, dt=dt, substeps=substeps),
        derivative=derivative,
        nominal=_quasi_steady(rk4(bicycle, dt=dt), length, rear_length),
        nominal_derivative=bicycle,
        control_low=CONTROL_LOW,
        control_high=CONTROL_HIGH,
        wind_force=wind_force,
    )


def _acceleration(control: Control, speed: Scalar, grip: Scalar) -> Scalar:
    """a_x [m/s²]: the commanded one within the grip; braking fades at standstill."""
    # tanh instead of a clip: a planner has a gradient beyond the limit of grip.
    drive = BRAKING_SHARE * grip * jnp.tanh(control[1] / (BRAKING_SHARE * grip))
    # Only braking fades: a car at rest must be able to start.
    return jnp.maximum(drive, 0.0) + jnp.minimum(drive, 0.0) * jnp.tanh(speed / 0.2)


def _rolling(speed: Scalar, creep_speed: float) -> Scalar:
    """Share of the wind that moves the car: 0 at standstill, 1 above creep_speed."""
    share = jnp.clip(jnp.abs(speed) / creep_speed, 0.0, 1.0)
    # Smoothstep: its slope is 0 at both ends, so that the wind fades without a kink.
    return share**2 * (3.0 - 2.0 * share)


def _slip(along: Scalar, across: Scalar, creep_speed: float) -> Scalar:
    """Tangent of the slip angle, v_across / |v_along|.

    Below v_0, |v| becomes (v² + v_0²)/(2 v_0) ≥ v_0/2, continuously differentiable.
    """
    # min and max join two formulas whose values and slopes agree at v_0.
    below = jnp.minimum(jnp.abs(along), creep_speed)
    beyond = jnp.maximum(jnp.abs(along), creep_speed) - creep_speed
    return across / ((below**2 + creep_speed**2) / (2.0 * creep_speed) + beyond)


def _brush(slip: Scalar, stiffness: float, limit: Scalar) -> Scalar:
    """Side force of a brush (Fiala) tyre, −F_max (3θ − 3θ|θ| + θ³).

    θ = C t / (3 F_max), clipped to [-1, 1].
    """
    # At ±1 the cubic has slope 0: sliding tyres give the limit, whatever the slip.
    bristle = jnp.clip(stiffness * slip / (3.0 * limit), -1.0, 1.0)
    return -limit * bristle * (3.0 - 3.0 * jnp.abs(bristle) + bristle**2)


def _quasi_steady(bicycle: Step, length: float, rear_length: float) -> Step:
    """The bicycle knows no tyres: δ = δ_cmd, ω = v κ, v_y = l_r ω at once."""

    def step(state: State, control: Control, env: Environment) -> State:
        after = bicycle(state, control, env)
        # Of the new speed: the states are those at the end of the period.
        yaw_rate = after[3] * jnp.tan(control[0]) / length
        hidden = jnp.stack([rear_length * yaw_rate, yaw_rate, control[0]])
        return after.at[4:].set(hidden)

    return step
