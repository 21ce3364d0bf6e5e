"""CommonRoad's drift and multi-body cars in our coordinates, on lists of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

from vehiclemodels.init_mb import init_mb
from vehiclemodels.init_std import init_std
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

CARS = (1, 2, 3)
"""CommonRoad's numbers of the Ford Escort, the BMW 320i and the VW Vanagon."""
OBSERVED = 7
"""Number of leading states, in the order of `vehicle.dynamic`."""

Numbers: TypeAlias = Sequence[float]
Car: TypeAlias = Any
"""CommonRoad's VehicleParameters, whose fields are all declared optional."""


class Equations(NamedTuple):
    """One of CommonRoad's models, x = (p_x, p_y, δ, |v| or v_x, yaw, yaw rate, …).

    Attributes:
        rates: (x, (steering rate, acceleration), car) -> dx/dt.
        settled: ((p_x, p_y, δ, |v|, yaw, yaw rate, slip angle), car) -> x with rolling
            wheels and springs at rest.
        seven: x -> the states of `vehicle.dynamic`.
        rest: indices of the other entries of x.
        wheels: indices of wheel speeds.
        force_rates: (x, side force [N], car) -> what a force at the centre of mass adds
            to dx/dt, by index.
    """

    rates: Callable[[list[float], list[float], Car], list[float]]
    settled: Callable[[list[float], Car], list[float]]
    seven: Callable[[Numbers], list[float]]
    rest: tuple[int, ...]
    wheels: tuple[int, ...]
    force_rates: Callable[[Numbers, float, Car], dict[int, float]]


def _drift_seven(x: Numbers) -> list[float]:
    return [x[0], x[1], x[4], x[3] * math.cos(x[6]), x[3] * math.sin(x[6]), x[5], x[2]]


def _drift_force_rates(x: Numbers, force: float, car: Car) -> dict[int, float]:
    """m d|v|/dt has F sin β, m |v| dβ/dt has F cos β."""
    return {
        3: force / car.m * math.sin(x[6]),
        6: force / (car.m * x[3]) * math.cos(x[6]),
    }


def _body_seven(x: Numbers) -> list[float]:
    return [x[index] for index in (0, 1, 4, 3, 10, 5, 2)]


def _body_force_rates(x: Numbers, force: float, car: Car) -> dict[int, float]:
    """F acts on the sprung mass; the axles follow through their joints."""
    del x
    return {10: force / car.m_s}


MODELS = {
    "std": Equations(
        vehicle_dynamics_std, init_std, _drift_seven, (7, 8), (7, 8), _drift_force_rates
    ),
    "mb": Equations(
        vehicle_dynamics_mb,
        init_mb,
        _body_seven,
        (*range(6, 10), *range(11, 29)),
        (23, 24, 25, 26),
        _body_force_rates,
    ),
}


def car_numbered(number: int) -> Car:
    """Parameters of one of `CARS`."""
    return setup_vehicle_parameters(number)


def with_friction(car: Car, friction: float) -> Car:
    """Limit the lateral force of tyres to `friction` times the load, same stiffness."""
    tire = car.tire
    return replace(
        car,
        tire=replace(tire, p_dy1=friction, p_dx1=tire.p_dx1 * friction / tire.p_dy1),
    )


def rates(
    equations: Equations,
    x: Numbers,
    control: Numbers,
    car: Car,
    *,
    force: float,
    lever: float,
) -> list[float]:
    """Return dx/dt under controls and a side force.

    Args:
        equations: of the model.
        x: in CommonRoad's coordinates.
        control: steering rate [rad/s] and acceleration [m/s²].
        car: its parameters.
        force: to the side [N].
        lever: of the force, ahead of the centre of mass [m].
    """
    result = equations.rates(list(x), list(control), car)
    for index, change in equations.force_rates(x, force, car).items():
        result[index] += change
    result[5] += lever * force / car.I_z
    return [float(change) for change in result]


def to_commonroad(equations: Equations, state: Numbers, car: Car) -> list[float]:
    """Return CommonRoad's x of a state; hidden states are added to the settled x.

    CommonRoad leaves a locked wheel with a speed just below 0, from which it never
    turns again; here the speed becomes 0.
    """
    x = equations.settled(_core(state), car)
    for index, hidden in zip(equations.rest, state[OBSERVED:], strict=True):
        x[index] += hidden
    for index in equations.wheels:
        x[index] = max(x[index], 0.0)
    return x


def from_commonroad(equations: Equations, x: Numbers, car: Car) -> list[float]:
    """Return the state of CommonRoad's x."""
    seven = equations.seven(x)
    settled = equations.settled(_core(seven), car)
    return [*seven, *(x[index] - settled[index] for index in equations.rest)]


def _core(state: Numbers) -> list[float]:
    """(p_x, p_y, δ, |v|, yaw, yaw rate, slip angle)."""
    x, y, yaw, along, across, yaw_rate, steering = state[:OBSERVED]
    return [
        x,
        y,
        steering,
        math.hypot(along, across),
        yaw,
        yaw_rate,
        math.atan2(across, along),
    ]
