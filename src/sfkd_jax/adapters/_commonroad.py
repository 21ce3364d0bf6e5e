"""CommonRoad's cars as plants; their equations run on the host in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.integrate import solve_ivp
from vehiclemodels.init_mb import init_mb
from vehiclemodels.init_std import init_std
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from sfkd_jax.driving.plants import Vehicle, dynamic, simulator
from sfkd_jax.ranges import check_choice

SLOWEST = 0.5
"""Lowest speed [m/s]: the multi-body car divides by the speed over ground at every
wheel.
"""
ACCURACY: dict[str, Any] = {"method": "RK23", "rtol": 1e-5, "atol": 1e-7}
"""An explicit method, although slip settles within I_w v / (R_w² K_x), 1 ms at 10 m/s:
implicit steps fail at a locked wheel.
"""
CARS = (1, 2, 3)
"""CommonRoad's numbers of the Ford Escort, the BMW 320i and the VW Vanagon."""
STEERING_LAG = 0.1
"""Time constant of the steering [s]."""
WIND_LEVER = 0.4
"""Distance at which the wind acts ahead of the centre of mass [m]."""
OBSERVED = 7
"""Number of leading states, in the order of `plants.dynamic`."""

_partial = cache(partial)
"""One function for equal settings, so that they share their workers."""
Numbers: TypeAlias = Sequence[float]
Car: TypeAlias = Any
"""CommonRoad's VehicleParameters, whose fields are all declared optional."""


class Equations(NamedTuple):
    """One of CommonRoad's models, x = (p_x, p_y, δ, |v| or v_x, yaw, yaw rate, …).

    Attributes:
        rates: (x, (steering rate, acceleration), car) -> dx/dt.
        settled: ((p_x, p_y, δ, |v|, yaw, yaw rate, slip angle), car) -> x with rolling
            wheels and springs at rest.
        velocity: x -> (v, v_y).
        hidden: indices of the entries of x that are no state of `plants.dynamic`.
        wheels: indices of wheel speeds.
        push: (x, side force [N], car) -> what a force at the centre of mass adds to
            dx/dt, by index.
    """

    rates: Callable[[list[float], list[float], Car], list[float]]
    settled: Callable[[list[float], Car], list[float]]
    velocity: Callable[[Numbers], tuple[float, float]]
    hidden: tuple[int, ...]
    wheels: tuple[int, ...]
    push: Callable[[Numbers, float, Car], dict[int, float]]


def _std_velocity(x: Any) -> tuple[float, float]:
    """Return (v, v_y) of the single track, whose state holds |v| and the slip angle."""
    return x[3] * math.cos(x[6]), x[3] * math.sin(x[6])


def _std_push(x: Any, force: float, car: Car) -> dict[int, float]:
    """Return what a side force adds to the rates of the single track.

    m d|v|/dt has F sin β, m |v| dβ/dt has F cos β.
    """
    return {
        3: force / car.m * math.sin(x[6]),
        6: force / (car.m * x[3]) * math.cos(x[6]),
    }


def _mb_velocity(x: Any) -> tuple[float, float]:
    """Return (v, v_y) of the multi-body car."""
    return x[3], x[10]


def _mb_push(x: Any, force: float, car: Car) -> dict[int, float]:
    """Return what a side force adds to the rates of the multi-body car.

    It acts on the sprung mass; the axles follow through their joints.
    """
    return {10: force / car.m_s}


MODELS = {
    "std": Equations(
        rates=vehicle_dynamics_std,
        settled=init_std,
        velocity=_std_velocity,
        hidden=(7, 8),
        wheels=(7, 8),
        push=_std_push,
    ),
    "mb": Equations(
        rates=vehicle_dynamics_mb,
        settled=init_mb,
        velocity=_mb_velocity,
        hidden=(*range(6, 10), *range(11, 29)),
        wheels=(23, 24, 25, 26),
        push=_mb_push,
    ),
}


def commonroad_vehicle(
    *, model: str = "std", car: int = 2, dt: float = 0.1, wind_force: float = 10.0
) -> Vehicle:
    """Return a car of CommonRoad as a plant, see `plants.simulator`.

    x = (p_x, p_y, yaw, v, v_y, yaw rate, δ | hidden), the first seven as in
    `plants.dynamic`, p at the centre of mass. Hidden states are wheel speeds, and of
    the multi-body car also roll, pitch, heave and the axles, relative to freely rolling
    wheels and springs at rest: a start with zeros there is in equilibrium.

        δ̇ = clip((δ_cmd − δ) / 0.1 s, ±δ̇_max), δ̇_max = 0.4 rad/s as in CommonRoad,
        F = c_w w|w| at 0.4 m ahead of the centre of mass

    The acceleration is applied directly. CommonRoad has no wind; F is added here. The
    tyres' lateral force peaks at friction × load (1.0489 in CommonRoad's tyre), the
    longitudinal one in proportion.

    The equations are not valid below a forward speed of 0.5 m/s or when a wheel of the
    multi-body car turns backwards in a spin; from there on the state is NaN.

    Args:
        model: "std", single track with drift (9 states), or "mb", multi-body (29
            states).
        car: 1 Ford Escort, 2 BMW 320i, 3 VW Vanagon.
        dt: sampling period [s].
        wind_force: c_w [N s²/m²].

    Source: Althoff and Würsching, CommonRoad: Vehicle Models.
    """
    check_choice("model", model, MODELS)
    if car not in CARS:
        raise ValueError(f"car must be one of {', '.join(map(str, CARS))}, got {car}")
    if not dt > 0:
        raise ValueError(f"dt must be positive, got {dt}")
    plant = simulator(_partial(_HostCar, model, car, dt, wind_force))
    return plant._replace(name=f"commonroad_{model}")


class _HostCar:
    """A car whose equations run on the host, as a simulator.

    Attributes:
        dry: its parameters on a dry road.
    """

    def __init__(self, model: str, car: int, dt: float, wind_force: float) -> None:
        self.equations = MODELS[model]
        self.dt = dt
        self.wind_force = wind_force
        self.dry: Car = setup_vehicle_parameters(car)
        ours = dynamic()
        self.control_low = ours.control_low
        self.control_high = ours.control_high
        self.wheelbase = self.dry.a + self.dry.b
        hidden = (f"hidden_{index}" for index in self.equations.hidden)
        self.state_names = (*ours.state_names, *hidden)

    def reset(self, state: Numbers) -> None:
        """Put the car into a state."""
        self.state = list(map(float, state))

    def flow(self, control: Numbers, env: Numbers) -> Callable[[Any], list[float]]:
        """Return x -> dx/dt in CommonRoad's coordinates."""
        equations = self.equations
        tire = self.dry.tire
        # Friction limits the forces of the tyres, at the same stiffness.
        p_dx1 = tire.p_dx1 * env[0] / tire.p_dy1
        car = replace(self.dry, tire=replace(tire, p_dy1=env[0], p_dx1=p_dx1))
        force = self.wind_force * env[1] * abs(env[1])

        def rates(moment: np.ndarray) -> list[float]:
            x = moment.tolist()
            inputs = [(control[0] - x[2]) / STEERING_LAG, control[1]]
            # A copy: CommonRoad stops locked wheels in the list that it is given.
            result = equations.rates(list(x), inputs, car)
            for index, change in equations.push(x, force, car).items():
                result[index] += change
            result[5] += WIND_LEVER * force / car.I_z
            return [float(change) for change in result]

        return rates

    def step(self, control: Numbers, env: Numbers) -> list[float]:
        """Return the state one sampling period later."""
        # In double precision: a wheel settles a hundred times faster than dt.
        flow = self.flow(control, env)

        def rates(time: float, x: Any) -> list[float]:
            return flow(x)

        def too_slow(time: float, x: Any) -> float:
            forward, _ = self.equations.velocity(x)
            return forward - SLOWEST

        too_slow.terminal = True  # type: ignore[attr-defined]
        ended = ValueError(f"the equations end at a forward speed of {SLOWEST} m/s")
        if self.state[3] <= SLOWEST:
            raise ended
        # The multi-body car divides by the speed of a wheel, which is held at 0 when it
        # rolls backwards: that is an ArithmeticError.
        solution = solve_ivp(
            rates,
            (0.0, self.dt),
            self.to_commonroad(self.state),
            events=too_slow,
            **ACCURACY,
        )
        if solution.status != 0:
            raise ended
        return self.from_commonroad(solution.y[:, -1])

    def to_commonroad(self, state: Numbers) -> np.ndarray:
        """Return CommonRoad's x, the settled one plus the hidden part of the state."""
        x = self.settled(state)
        for index, hidden in zip(self.equations.hidden, state[OBSERVED:], strict=True):
            x[index] += hidden
        # CommonRoad leaves a locked wheel with a speed just below 0, from which it
        # never turns again.
        for index in self.equations.wheels:
            x[index] = max(x[index], 0.0)
        return np.asarray(x)

    def from_commonroad(self, moment: np.ndarray) -> list[float]:
        """Return the state of CommonRoad's x."""
        x = moment.tolist()
        seven = [x[0], x[1], x[4], *self.equations.velocity(x), x[5], x[2]]
        settled = self.settled(seven)
        return [*seven, *(x[k] - settled[k] for k in self.equations.hidden)]

    def settled(self, state: Numbers) -> list[float]:
        """Return CommonRoad's x of the first seven states, with all others at rest."""
        x, y, yaw, along, across, yaw_rate, steering = state[:OBSERVED]
        speed = math.hypot(along, across)
        slip = math.atan2(across, along)
        core = [x, y, steering, speed, yaw, yaw_rate, slip]
        # CommonRoad writes some of them as integers.
        return list(map(float, self.equations.settled(core, self.dry)))
