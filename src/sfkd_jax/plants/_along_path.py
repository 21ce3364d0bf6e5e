"""Any vehicle in closed loop with a law, as a vehicle in path coordinates."""

from __future__ import annotations

from sfkd_jax.geometry import PathFeedback, closed_loop
from sfkd_jax.plants._vehicle import SPEED_RANGE, Vehicle
from sfkd_jax.types import Control, Environment, State

STEEPEST = 0.2
"""Largest curvature of a path [1/m]: more than any car can turn."""


def along_path(
    vehicle: Vehicle,
    law: PathFeedback,
    *,
    perturbation: tuple[float, float] = (0.03, 1.0),
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

    Raises:
        ValueError: the vehicle has no limits.
    """
    if not vehicle.control_low:
        raise ValueError(
            "a path-following loop needs vehicle.control_low and vehicle.control_high"
        )
    limits = (vehicle.control_low, vehicle.control_high)
    step = closed_loop(vehicle.step, law, *limits)

    def derivative(state: State, control: Control, env: Environment) -> State:
        return (step(state, control, env) - state) / vehicle.dt

    nominal = closed_loop(vehicle.nominal, law, *limits)

    def nominal_derivative(state: State, control: Control, env: Environment) -> State:
        return (nominal(state, control, env) - state) / vehicle.dt

    return vehicle._replace(
        state_names=("p_x", "p_y", "yaw", "e_y", "e_psi", *vehicle.state_names[3:]),
        step=step,
        derivative=derivative,
        nominal=nominal,
        nominal_derivative=nominal_derivative,
        control_low=(
            *(-largest for largest in perturbation),
            -STEEPEST,
            SPEED_RANGE[0],
        ),
        control_high=(*perturbation, STEEPEST, SPEED_RANGE[1]),
    )
