"""A vehicle with a path-following law around it, in path coordinates."""

from __future__ import annotations

from collections.abc import Iterable

import jax.numpy as jnp

from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    PERTURBATION,
    REFERENCE_SPEED,
    PathFeedback,
    path_step,
)
from sfkd_jax.driving.plants._vehicle import SPEED_RANGE, Vehicle
from sfkd_jax.geometry import without_pose
from sfkd_jax.types import BODY, Control, Environment, Scalar, State, Step
from sfkd_jax.variables import ControlVariable, StateVariable

LARGEST_CURVATURE = 0.2
"""Limit of the curvature of a path [1/m]; no car can turn as tightly."""


def step_with_law(
    step: Step, law: PathFeedback, low: tuple[float, ...], high: tuple[float, ...]
) -> Step:
    """Return the step of a vehicle that a law drives along a path.

    It maps (path state, w, e) to the path state one sampling period later:

        ξ⁺ = F(ξ, clip(law(ξ; κ, v_ref, e) + ν); κ, e)

    Args:
        step: of the vehicle in the world frame, (x, u, e) -> x⁺.
        law: (ξ, κ, v_ref, e) -> u.
        low: lower limits of the vehicle's controls.
        high: upper limits of the vehicle's controls.
    """
    along = path_step(step)
    bottom = jnp.asarray(low)
    top = jnp.asarray(high)

    def closed(state: State, inputs: Control, env: Environment) -> State:
        curvature = inputs[CURVATURE]
        wanted = law(state[BODY], curvature, inputs[REFERENCE_SPEED], env)
        # The actuator limits the sum, so the clip comes after the perturbation.
        control = jnp.clip(wanted + inputs[PERTURBATION], bottom, top)
        return without_pose(along(state[BODY], control, curvature, env))

    return closed


def along_path(
    vehicle: Vehicle,
    law: PathFeedback,
    *,
    perturbation: Iterable[float | Scalar] = (0.03, 1.0),
) -> Vehicle:
    """Return the closed loop as a plant with states (0, 0, 0, ξ) and controls w.

    w = (ν, κ, v_ref), see `path_coordinates`. One step is exact on a circle of
    curvature κ, whatever the step of the vehicle is. Where 1 − κ e_y ≤ 0.2 the result
    is finite but not meaningful; `path_coordinates.is_valid` tests for it.

    Args:
        vehicle: with limits of its controls.
        law: (ξ, κ, v_ref, e) -> u.
        perturbation: largest |ν_1| [rad] and |ν_2| [unit of the second control]. They
            are limits of w to draw from; steps do not enforce them.

    Raises:
        ValueError: the vehicle has no limits.
    """
    if not vehicle.control_low:
        raise ValueError(
            "a path-following loop needs vehicle.control_low and vehicle.control_high"
        )
    # Law and ν together are clipped, as the actuators of the car do.
    limits = (vehicle.control_low, vehicle.control_high)
    coordinates = len(vehicle.states) - 1

    def seen_by_law(
        xi: State, curvature: Scalar, speed: Scalar, env: Environment
    ) -> Control:
        return law(xi[:coordinates], curvature, speed, env)

    nominal = step_with_law(vehicle.nominal, law, *limits)
    largest = tuple(map(float, perturbation))

    def nominal_derivative(state: State, control: Control, env: Environment) -> State:
        # The loop is defined by its step, during which the control is held. Its
        # derivative is therefore the difference quotient over a step.
        return (nominal(state, control, env) - state) / vehicle.dt

    controls = path_controls(vehicle)
    perturbations = (
        control._replace(low=-limit, high=limit)
        for control, limit in zip(controls[:2], largest, strict=True)
    )
    return vehicle._replace(
        states=path_states(vehicle),
        # Limits of w to draw from. The loop itself clips only the control u.
        controls=(*perturbations, *controls[2:]),
        step=step_with_law(vehicle.step, seen_by_law, *limits),
        derivative=None,
        nominal=nominal,
        nominal_derivative=nominal_derivative,
    )


def path_states(vehicle: Vehicle) -> tuple[StateVariable, ...]:
    """Return the states of a vehicle with a path-following law around it.

    e_y has the deviation of a position, e_ψ that of the yaw.
    """
    pose = vehicle.states[:3]
    position, _, yaw = pose
    errors = (position._replace(name="e_y"), yaw._replace(name="e_psi"))
    return (*pose, *errors, *vehicle.states[3:])


def path_controls(vehicle: Vehicle) -> tuple[ControlVariable, ...]:
    """Return the inputs w of a vehicle with a path-following law; ν has no limits."""
    added = (
        ControlVariable(f"{control.name} added", control.unit)
        for control in vehicle.controls
    )
    curvature = ControlVariable(
        "curvature", "1/m", -LARGEST_CURVATURE, LARGEST_CURVATURE
    )
    return (*added, curvature, ControlVariable("v_ref", "m/s", *SPEED_RANGE))


def axes(vehicle: Vehicle, *, along_path: bool) -> dict[str, list[str]]:
    """Return names with units of what a model of the vehicle reads.

    Args:
        vehicle: without a law around it.
        along_path: whether the model is about path coordinates.

    Returns:
        The axes of the body "state", of the "control" and of "env".
    """
    states = path_states(vehicle) if along_path else vehicle.states
    controls = path_controls(vehicle) if along_path else vehicle.controls
    return {
        "state": [state.label for state in states[3:]],
        "control": [control.label for control in controls],
        "env": [entry.label for entry in vehicle.environment],
    }
