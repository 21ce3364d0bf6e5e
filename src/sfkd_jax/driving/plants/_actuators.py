"""Loops around the actuators of a vehicle: of its speed, and of its steering."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.driving.plants._variables import KNOWN_STATES, SPEED_COMMAND
from sfkd_jax.driving.plants._vehicle import SPEED_RANGE, Vehicle
from sfkd_jax.ranges import Positive
from sfkd_jax.types import Control, Environment, Scalar, State, Step

SERVO_PARTS = 20
"""Parts of a sampling period in which a servo is integrated."""


def with_speed_loop(vehicle: Vehicle, *, gain: float = 1.0) -> Vehicle:
    """Return the vehicle with a speed command instead of an acceleration.

        a = clip(k_v (v_cmd − v)), held over dt

    Args:
        vehicle: whose second control is an acceleration, with limits.
        gain: k_v [1/s].

    Raises:
        ValueError: the vehicle has no limits, or takes speed commands already.
    """
    if vehicle.speed_loop or not vehicle.control_low:
        raise ValueError(
            "vehicle.inner_loop=speed needs limits of the acceleration; "
            "of speed commands: speed_loop=true"
        )
    low = vehicle.control_low[1]
    high = vehicle.control_high[1]

    def closed_loop_of(step: Step) -> Step:
        def closed(state: State, control: Control, env: Environment) -> State:
            # The loop demands no more than the actuator can give.
            acceleration = jnp.clip(gain * (control[1] - state[3]), low, high)
            return step(state, control.at[1].set(acceleration), env)

        return closed

    # `derivative` stays as it is: that of the plant before any wrapper.
    return vehicle._replace(
        step=closed_loop_of(vehicle.step),
        nominal=closed_loop_of(vehicle.nominal),
        nominal_derivative=closed_loop_of(vehicle.nominal_derivative),
        controls=(
            vehicle.controls[0],
            SPEED_COMMAND._replace(low=SPEED_RANGE[0], high=SPEED_RANGE[1]),
        ),
        speed_loop=True,
    )


def with_servo(vehicle: Vehicle, *, lag: Positive, rate: float = math.inf) -> Vehicle:
    """Return the vehicle with a servo that turns its wheels to the steering command.

        δ̇ = clip((δ_cmd − δ) / T, ±rate)

    The steering angle δ is a state more, the last one. Over a sampling period the
    vehicle is steered by its mean angle.

    Args:
        vehicle: that turns at once.
        lag: T [s].
        rate: largest |δ̇| [rad/s].

    Raises:
        ValueError: the vehicle has a state "steering", and with it a servo of its own.
    """
    steering = KNOWN_STATES["steering"]
    if steering.name in vehicle.state_names:
        raise ValueError(
            f"vehicle.servo_lag: vehicle {vehicle.name} has a state steering already, "
            "and turns it itself"
        )
    if vehicle.hidden:
        raise ValueError(
            f"vehicle.servo_lag: vehicle {vehicle.name} has hidden states, and its "
            "servo belongs among them"
        )
    part = vehicle.dt / SERVO_PARTS
    share = -jnp.expm1(-part / lag)

    def turned(angle: Scalar, command: Scalar) -> tuple[Scalar, Scalar]:
        """Return the angle after a period, and its mean."""
        total = jnp.zeros_like(angle)
        for _ in range(SERVO_PARTS):
            before = angle
            turn = share * (command - angle)
            angle = angle + jnp.clip(turn, -rate * part, rate * part)
            total = total + 0.5 * (before + angle)
        return angle, total / SERVO_PARTS

    def behind(step: Step) -> Step:
        def stepped(state: State, control: Control, env: Environment) -> State:
            angle, mean = turned(state[-1], control[0])
            after = step(state[:-1], control.at[0].set(mean), env)
            return jnp.append(after, angle)

        return stepped

    def nominal_derivative(state: State, control: Control, env: Environment) -> Array:
        turning = jnp.clip((control[0] - state[-1]) / lag, -rate, rate)
        steered = control.at[0].set(state[-1])
        rates = vehicle.nominal_derivative(state[:-1], steered, env)
        return jnp.append(rates, turning)

    return vehicle._replace(
        states=(*vehicle.states, steering),
        step=behind(vehicle.step),
        nominal=behind(vehicle.nominal),
        nominal_derivative=nominal_derivative,
        derivative=None,
    )
