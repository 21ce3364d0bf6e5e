"""CommonRoad's cars as plants; their equations run on the host in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from vehiclemodels.init_mb import init_mb
from vehiclemodels.init_std import init_std
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from sfkd_jax.plants import Vehicle, dynamic
from sfkd_jax.ranges import check_choice
from sfkd_jax.types import Control, Controller, Environment, State, Step

SLOWEST = 0.5  # m/s; the multi-body car divides by the speed over ground at every wheel
ACCURACY: dict[str, Any] = {"method": "RK23", "rtol": 1e-5, "atol": 1e-7}
"""An explicit method, although slip settles within I_w v / (R_w² K_x), 1 ms at 10 m/s:
implicit steps fail at a locked wheel.
"""
CARS = (1, 2, 3)
"""CommonRoad's numbers of the Ford Escort, the BMW 320i and the VW Vanagon."""
STEERING_LAG, WIND_LEVER = 0.1, 0.4
"""τ of the steering [s]; of the wind ahead of the centre of mass [m]."""
OBSERVED = 7
"""Number of leading states, in the order of `plants.dynamic`."""

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


MODELS = {
    "std": Equations(
        vehicle_dynamics_std,
        init_std,
        lambda x: (x[3] * math.cos(x[6]), x[3] * math.sin(x[6])),
        (7, 8),
        (7, 8),
        # m d|v|/dt has F sin β, m |v| dβ/dt has F cos β.
        lambda x, force, car: {
            3: force / car.m * math.sin(x[6]),
            6: force / (car.m * x[3]) * math.cos(x[6]),
        },
    ),
    "mb": Equations(
        vehicle_dynamics_mb,
        init_mb,
        lambda x: (x[3], x[10]),
        (*range(6, 10), *range(11, 29)),
        (23, 24, 25, 26),
        # On the sprung mass; the axles follow through their joints.
        lambda x, force, car: {10: force / car.m_s},
    ),
}


def commonroad_vehicle(
    *, model: str = "std", car: int = 2, dt: float = 0.1, wind_force: float = 10.0
) -> Vehicle:
    """Return a car of CommonRoad as a plant.

    x = (p_x, p_y, yaw, v, v_y, yaw rate, δ | hidden), the first seven as in
    `plants.dynamic`, p at the centre of mass. Hidden states are wheel speeds, and of
    the multi-body car also roll, pitch, heave and the axles, relative to freely rolling
    wheels and springs at rest: a start with zeros there is in equilibrium.

        δ̇ = clip((δ_cmd − δ) / 0.1 s, ±δ̇_max), δ̇_max = 0.4 rad/s as in CommonRoad,
        F = c_w w|w| at 0.4 m ahead of the centre of mass

    The acceleration is applied directly. CommonRoad has no wind; F is added here. The
    tyres' lateral force peaks at friction × load (1.0489 in CommonRoad's tyre), the
    longitudinal one in proportion.

    A step is a host callback: it works under `jit`, `vmap` and `scan`, one car after
    the other, without a gradient. The equations are not valid below a forward speed of
    0.5 m/s or when a wheel of the multi-body car turns backwards in a spin; from there
    on the state is NaN.

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
    dry: Car = setup_vehicle_parameters(car)
    host = _HostCar(MODELS[model], dry, dt, wind_force)
    # The nominal model is that of our dynamic car with these axle distances.
    bicycle = dynamic(
        dt=dt, wind_force=wind_force, front_length=dry.a, rear_length=dry.b
    )
    hidden = (f"hidden_{index}" for index in host.equations.hidden)
    return bicycle._replace(
        name=f"commonroad_{model}",
        state_names=(*bicycle.state_names, *hidden),
        step=_on_host(host.step),
        derivative=_on_host(host.derivative),
        nominal=_seven(bicycle.nominal),
        nominal_derivative=_seven(bicycle.nominal_derivative),
    )


def commonroad_controller(controller: Controller) -> Controller:
    """Return a controller of `plants.dynamic`, 7 states, for such a car."""

    def act(params: Any, memory: Any, state: State, *rest: Any) -> Any:
        return controller.act(params, memory, state[..., :OBSERVED], *rest)

    return controller._replace(act=act)


@dataclass(frozen=True)
class _HostCar:
    """A car whose equations run on the host; `dry` are its parameters on a dry road."""

    equations: Equations
    dry: Car
    dt: float
    wind_force: float

    def flow(self, control: Numbers, env: Numbers) -> Callable[[Any], list[float]]:
        """Return x -> dx/dt in CommonRoad's coordinates."""
        equations, tire = self.equations, self.dry.tire
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

    def step(self, state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        """Return the state one sampling period later, NaN where equations end."""
        lost = [math.nan] * len(state)
        if not (all(map(math.isfinite, state)) and state[3] > SLOWEST):
            return lost
        # In double precision: a wheel settles a hundred times faster than dt.
        flow, velocity = self.flow(control, env), self.equations.velocity

        def too_slow(time: float, x: Any) -> float:
            del time
            return velocity(x)[0] - SLOWEST

        too_slow.terminal = True  # type: ignore[attr-defined]
        try:
            solution = solve_ivp(
                lambda time, x: flow(x),
                (0.0, self.dt),
                self.to_commonroad(state),
                events=too_slow,
                **ACCURACY,
            )
        # The multi-body car divides by the speed of a wheel, which is held at 0 when it
        # rolls backwards.
        except ArithmeticError:
            return lost
        return lost if solution.status != 0 else self.from_commonroad(solution.y[:, -1])

    def derivative(self, state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        """Return dx/dt by a central difference along the flow."""
        x = self.to_commonroad(state)
        little = 1e-6 * np.asarray(self.flow(control, env)(x))
        ahead, behind = map(self.from_commonroad, (x + little, x - little))
        return ((np.asarray(ahead) - np.asarray(behind)) / 2e-6).tolist()

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
        """CommonRoad's x of the first seven states, with all others at rest."""
        x, y, yaw, along, across, yaw_rate, steering = state[:OBSERVED]
        speed, slip = math.hypot(along, across), math.atan2(across, along)
        core = [x, y, steering, speed, yaw, yaw_rate, slip]
        # CommonRoad writes some of them as integers.
        return list(map(float, self.equations.settled(core, self.dry)))


def _on_host(function: Callable[[Numbers, Numbers, Numbers], list[float]]) -> Step:
    """A function of lists as a step of arrays."""

    def call(*inputs: Any) -> np.ndarray:
        lists = (np.asarray(each).tolist() for each in inputs)
        return np.asarray(function(*lists), dtype=inputs[0].dtype)

    def step(state: State, control: Control, env: Environment) -> State:
        # One car after the other: the equations take lists of numbers.
        shape = jax.ShapeDtypeStruct(state.shape, state.dtype)
        return jax.pure_callback(
            call, shape, state, control, env, vmap_method="sequential"
        )

    return step


def _seven(step: Step) -> Step:
    """A step of the first seven states; hidden ones stay at 0."""

    def wider(state: State, control: Control, env: Environment) -> State:
        after = step(state[:OBSERVED], control, env)
        return jnp.zeros_like(state).at[:OBSERVED].set(after)

    return wider
