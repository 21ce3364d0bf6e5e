"""CommonRoad's cars as plants; their equations run on the host in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

from sfkd_jax.adapters._commonroad_equations import (
    CARS,
    MODELS,
    OBSERVED,
    Equations,
    Numbers,
    car_numbered,
    from_commonroad,
    rates,
    to_commonroad,
    with_friction,
)
from sfkd_jax.plants import Vehicle, dynamic
from sfkd_jax.types import Control, Controller, Environment, State, Step

SLOWEST = 0.5  # m/s; the multi-body car divides by the speed over ground at every wheel
ACCURACY: dict[str, Any] = {"method": "RK23", "rtol": 1e-5, "atol": 1e-7}
"""An explicit method, although slip settles within I_w v / (R_w² K_x), 1 ms at 10 m/s:
implicit steps fail at a locked wheel.
"""

HostStep: TypeAlias = Callable[[Numbers, Numbers, Numbers], list[float]]
Rates: TypeAlias = Callable[[list[float]], list[float]]


def commonroad_vehicle(
    *,
    model: str = "std",
    car: int = 2,
    dt: float = 0.1,
    steering_lag: float = 0.1,
    wind_force: float = 10.0,
    wind_lever: float = 0.4,
) -> Vehicle:
    """Return a car of CommonRoad as a plant.

    x = (p_x, p_y, yaw, v, v_y, yaw rate, δ | hidden), the first seven as in
    `vehicle.dynamic`, p at the centre of mass. Hidden states are wheel speeds, and of
    the multi-body car also roll, pitch, heave and the axles, relative to freely rolling
    wheels and springs at rest: a start with zeros there is in equilibrium.

        δ̇ = clip((δ_cmd − δ)/τ, ±δ̇_max), δ̇_max = 0.4 rad/s as in CommonRoad,
        F = c_w w|w| at l_w ahead of the centre of mass

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
        steering_lag: τ [s].
        wind_force: c_w [N s²/m²].
        wind_lever: l_w [m].

    Raises:
        ValueError: an unknown model or car, a period or lag that is not positive.

    Source: Althoff and Würsching, CommonRoad: Vehicle Models.
    """
    _check(model, car, dt, steering_lag)
    dry = car_numbered(car)
    host = _HostCar(MODELS[model], dry, dt, steering_lag, wind_force, wind_lever)
    bicycle = dynamic(
        dt=dt, wind_force=wind_force, front_length=dry.a, rear_length=dry.b
    )
    return bicycle._replace(
        name=f"commonroad_{model}",
        state_names=(
            *bicycle.state_names,
            *(f"hidden_{index}" for index in host.equations.rest),
        ),
        step=_on_host(host.step),
        derivative=_on_host(host.derivative),
        nominal=_settled(bicycle.nominal),
        nominal_derivative=_settled(bicycle.nominal_derivative),
    )


class _HostCar(NamedTuple):
    """A car whose equations run on the host.

    Attributes:
        equations: of CommonRoad.
        car: parameters on a dry road.
        dt: sampling period [s].
        steering_lag: [s].
        wind_force: c_w [N s²/m²].
        wind_lever: l_w [m].
    """

    equations: Equations
    car: Any
    dt: float
    steering_lag: float
    wind_force: float
    wind_lever: float

    def rates(self, control: Numbers, env: Numbers) -> Rates:
        """Return x -> dx/dt in CommonRoad's coordinates."""
        car = with_friction(self.car, env[0])
        force = self.wind_force * env[1] * abs(env[1])
        return lambda x: rates(
            self.equations,
            x,
            [(control[0] - x[2]) / self.steering_lag, control[1]],
            car,
            force=force,
            lever=self.wind_lever,
        )

    def step(self, state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        """Return the state one sampling period later, NaN where equations end."""
        lost = [math.nan] * len(state)
        if not (all(map(math.isfinite, state)) and state[3] > SLOWEST):
            return lost
        # In double precision: a wheel settles a hundred times faster than dt.
        flow = self.rates(control, env)
        start = np.asarray(to_commonroad(self.equations, state, self.car))

        def too_slow(time: float, x: Any) -> float:
            del time
            return self.equations.seven(x.tolist())[3] - SLOWEST

        too_slow.terminal = True  # type: ignore[attr-defined]
        try:
            solution = solve_ivp(
                lambda time, x: flow(x.tolist()),
                (0.0, self.dt),
                start,
                events=too_slow,
                **ACCURACY,
            )
        # The multi-body car divides by the speed of a wheel, which is held at 0 when it
        # rolls backwards.
        except ArithmeticError:
            return lost
        if solution.status != 0:
            return lost
        return from_commonroad(self.equations, solution.y[:, -1].tolist(), self.car)

    def derivative(self, state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        """Return dx/dt by a central difference along the flow."""
        x = np.asarray(to_commonroad(self.equations, state, self.car))
        little = 1e-6 * np.asarray(self.rates(control, env)(x.tolist()))
        ahead, behind = (
            np.asarray(from_commonroad(self.equations, y.tolist(), self.car))
            for y in (x + little, x - little)
        )
        return ((ahead - behind) / 2e-6).tolist()


def commonroad_observation(
    state: Float[Array, "*batch state"], *, states: int = OBSERVED
) -> Float[Array, "*batch observed"]:
    """Return the states that a model of `dynamic` (7) or `kinematic` (4) has.

    The speed of `kinematic` is that along the course, √(v² + v_y²).

    Args:
        state: of `commonroad_vehicle`.
        states: 7 or 4.

    Raises:
        ValueError: another number of states.
    """
    if states == OBSERVED:
        return state[..., :OBSERVED]
    if states != 4:
        raise ValueError(
            "states must be 7, as of the dynamic vehicle, or 4, as of the kinematic "
            f"one, got {states}"
        )
    return jnp.concatenate(
        [state[..., :3], jnp.linalg.norm(state[..., 3:5], axis=-1, keepdims=True)],
        axis=-1,
    )


def commonroad_controller(
    controller: Controller, *, states: int = OBSERVED
) -> Controller:
    """Return a controller of `dynamic` (7 states) or `kinematic` (4) for such a car."""

    def act(params: Any, memory: Any, state: State, *rest: Any) -> Any:
        return controller.act(
            params, memory, commonroad_observation(state, states=states), *rest
        )

    return controller._replace(act=act)


def _check(model: str, car: int, dt: float, steering_lag: float) -> None:
    """Check model, car and times."""
    if model not in MODELS:
        raise ValueError(f"unknown model {model!r}; choose one of {', '.join(MODELS)}")
    if car not in CARS:
        raise ValueError(f"car must be one of {', '.join(map(str, CARS))}, got {car}")
    if not (dt > 0 and steering_lag > 0):
        raise ValueError(
            f"dt and steering_lag must be positive, got {dt} and {steering_lag}"
        )


def _on_host(function: HostStep) -> Step:
    """A function of lists as a step of arrays."""

    def call(*inputs: Any) -> np.ndarray:
        return np.asarray(
            function(*(np.asarray(each).tolist() for each in inputs)),
            dtype=inputs[0].dtype,
        )

    def step(state: State, control: Control, env: Environment) -> State:
        shape = jax.ShapeDtypeStruct(state.shape, state.dtype)
        return jax.pure_callback(
            call, shape, state, control, env, vmap_method="sequential"
        )

    return step


def _settled(step: Step) -> Step:
    """A step of the first seven states; hidden ones stay at 0."""

    def wider(state: State, control: Control, env: Environment) -> State:
        return (
            jnp.zeros_like(state)
            .at[:OBSERVED]
            .set(step(state[:OBSERVED], control, env))
        )

    return wider
