"""The `Vehicle` record, what all plants share, the speed loop and the path loop."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sfkd_jax.geometry import PathFeedback, closed_loop
from sfkd_jax.rollout import runge_kutta
from sfkd_jax.types import Control, Environment, Scalar, State, Step

GRAVITY = 9.81  # m/s²
CONTROL_LOW, CONTROL_HIGH = (-0.5, -6.0), (0.5, 3.0)
"""Limits of the steering [rad] and of the acceleration [m/s²]."""
SPEED_RANGE = (0.0, 25.0)  # m/s
STEEPEST = 0.2
"""Largest curvature of a path [1/m]: more than any car can turn."""


class Vehicle(NamedTuple):
    """A plant sampled at dt.

    Attributes:
        name: of the plant.
        dt: sampling period [s].
        wheelbase: [m].
        state_names: pose first, then the body state.
        step: (x, u, e) -> x one sampling period later.
        nominal: the textbook kinematic bicycle without friction or wind, as a step on
            the same state.
        nominal_derivative: dx/dt of that bicycle, for models that add to it.
        control_low: lower actuator limits.
        control_high: upper actuator limits.
        wind_force: c_w of `side_force` [N s²/m²].
        speed_loop: whether u_2 is a speed command [m/s] instead of an acceleration
            [m/s²].
        simulated: whether there is a step; False for a vehicle that is known from logs
            alone.
        derivative: dx/dt of the plant before any wrapper; None where only its step is
            known.
    """

    name: str
    dt: float
    wheelbase: float
    state_names: tuple[str, ...]
    step: Step
    nominal: Step
    nominal_derivative: Step
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]
    wind_force: float
    speed_loop: bool = False
    simulated: bool = True
    derivative: Step | None = None


def side_force(wind: Scalar, *, wind_force: float) -> Scalar:
    """Return the lateral force of a side wind on the body, F = c_w w|w| [N]."""
    # w|w|, not w²: wind from the other side pushes the other way.
    return wind_force * wind * jnp.abs(wind)


def equivalent_wind(wind: Scalar, force: Scalar, *, wind_force: float) -> Scalar:
    """Return the wind w' [m/s] with c_w w'|w'| = c_w w|w| + F.

    Args:
        wind: w [m/s].
        force: F [N].
        wind_force: c_w [N s²/m²].
    """
    # Forces add, winds do not: the law is a signed square.
    total = side_force(wind, wind_force=wind_force) + force
    # Exactly the same wind without a force, so that not a bit of an episode changes.
    return jnp.where(
        force == 0.0, wind, jnp.sign(total) * jnp.sqrt(jnp.abs(total) / wind_force)
    )


def resistance(speed: Scalar, *, mass: float, drag: float, rolling: float) -> Scalar:
    """Return the deceleration by air drag and rolling [m/s²]; 0 at rest.

    ρ C_d A v²/(2m) + c_rr g tanh(v / 0.2 m/s)
    """
    # The tanh makes rolling resistance vanish smoothly at rest.
    return drag * speed**2 / mass + rolling * GRAVITY * jnp.tanh(speed / 0.2)


def nominal_derivative(length: float, rear_length: float, *, states: int = 4) -> Step:
    """Return dx/dt of the kinematic bicycle without friction or wind.

    κ = tan δ / L,   β = l_r κ,   x = (p_x, p_y, yaw, v); further states are constant.
    """

    def derivative(state: State, control: Control, env: Environment) -> State:
        yaw = state[2]
        speed = state[3]
        # Without slip both wheels turn about one centre: κ = tan δ / L.
        curvature = jnp.tan(control[0]) / length
        # β ≈ l_r κ for small angles: the centre of mass moves at this angle to the car.
        course = yaw + rear_length * curvature
        x = speed * jnp.cos(course)
        y = speed * jnp.sin(course)
        moved = jnp.stack([x, y, speed * curvature, control[1]])
        return jnp.concatenate([moved, jnp.zeros(states - 4)])

    return derivative


def rk4(derivative: Step, *, dt: float, substeps: int = 1) -> Step:
    """Return RK4 steps of a car that brakes cannot reverse: v ≥ 0 after every step.

    The derivative is evaluated at max(v, 0), so that a car whose v falls below 0 within
    a step stands: neither its position nor its yaw moves backwards.

    Args:
        derivative: (x, u, e) -> dx/dt.
        dt: sampling period [s].
        substeps: integration steps per sampling period.
    """
    h = dt / substeps

    def forwards(state: State) -> State:
        # Brakes stop a car; they do not reverse it.
        # Entry 3 is the speed of every plant; v_y and others may be negative.
        return jnp.where((jnp.arange(state.shape[0]) == 3) & (state < 0.0), 0.0, state)

    def step(state: State, control: Control, env: Environment) -> State:
        def held(x: State) -> State:
            # Also in the stages: one at v < 0 would drive the position backwards.
            return derivative(forwards(x), control, env)

        def substep(x: State, _: None) -> tuple[State, None]:
            return runge_kutta(held, x, h), None

        # Unrolled: a loop of a few substeps would cost more than it computes.
        state = jnp.asarray(state)
        after, _ = jax.lax.scan(substep, state, None, length=substeps, unroll=True)
        return forwards(after)

    return step


def with_speed_loop(vehicle: Vehicle, *, gain: float = 1.0) -> Vehicle:
    """Return the vehicle with a speed command instead of an acceleration.

    a = clip(k_v (v_cmd − v)), held over dt, with the gain k_v [1/s].
    """
    if vehicle.speed_loop or not vehicle.control_low:
        raise ValueError(
            "vehicle.inner_loop=speed needs limits of the acceleration; "
            "of speed commands: speed_loop=true"
        )
    # Limits of the acceleration, before the entries become those of a speed.
    low = vehicle.control_low[1]
    high = vehicle.control_high[1]

    def close(step: Step) -> Step:
        def closed(state: State, control: Control, env: Environment) -> State:
            # Within the limits of the actuator: the loop asks for what it can give.
            acceleration = jnp.clip(gain * (control[1] - state[3]), low, high)
            return step(state, control.at[1].set(acceleration), env)

        return closed

    # `derivative` stays: it is the plant before any wrapper, for its own model.
    return vehicle._replace(
        step=close(vehicle.step),
        nominal=close(vehicle.nominal),
        nominal_derivative=close(vehicle.nominal_derivative),
        control_low=(vehicle.control_low[0], SPEED_RANGE[0]),
        control_high=(vehicle.control_high[0], SPEED_RANGE[1]),
        speed_loop=True,
    )


def along_path(
    vehicle: Vehicle,
    law: PathFeedback,
    *,
    perturbation: Iterable[float | Scalar] = (0.03, 1.0),
) -> Vehicle:
    """Return the closed loop as a plant with states (0, 0, 0, ξ) and controls w.

    w = (ν, κ, v_ref), see `sfkd_jax.geometry`. One step is exact on a circle of
    curvature κ for any step of the vehicle. Where 1 − κ e_y ≤ 0.2 the result is finite
    but not meaningful; `path_frame.is_valid` tests for it.

    Args:
        vehicle: with limits of its controls.
        law: (ξ, κ, v_ref, e) -> u.
        perturbation: largest |ν| [rad, control unit], the limits of w; steps do not
            enforce them.
    """
    if not vehicle.control_low:
        raise ValueError(
            "a path-following loop needs vehicle.control_low and vehicle.control_high"
        )
    # The loop clips what the law and ν ask for together, as the car does.
    limits = (vehicle.control_low, vehicle.control_high)
    nominal = closed_loop(vehicle.nominal, law, *limits)
    largest = tuple(map(float, perturbation))

    def nominal_derivative(state: State, control: Control, env: Environment) -> State:
        # A difference quotient: the loop is defined by its step, with the control held.
        return (nominal(state, control, env) - state) / vehicle.dt

    return vehicle._replace(
        state_names=("p_x", "p_y", "yaw", "e_y", "e_psi", *vehicle.state_names[3:]),
        step=closed_loop(vehicle.step, law, *limits),
        derivative=None,
        nominal=nominal,
        nominal_derivative=nominal_derivative,
        # Limits of w as boxes to draw from; the loop itself clips only the control.
        control_low=(*(-most for most in largest), -STEEPEST, SPEED_RANGE[0]),
        control_high=(*largest, STEEPEST, SPEED_RANGE[1]),
    )
