"""CommonRoad's cars as plants of this project: their equations run on the host, in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

from sfkd_jax.adapters._commonroad_equations import (
    CARS,
    MODELS,
    OBSERVED,
    Numbers,
    car_numbered,
    from_commonroad,
    rates,
    to_commonroad,
    with_friction,
)
from sfkd_jax.types import Control, Controller, Environment, State, Step
from sfkd_jax.vehicle import Vehicle, dynamic

SLOWEST = 0.5  # m/s; the multi-body car divides by the speed over ground at every wheel
ACCURACY: dict[str, Any] = {"method": "RK23", "rtol": 1e-5, "atol": 1e-7}
"""Explicit, though slip settles within I_w v / (R_w² K_x), 1 ms at 10 m/s: implicit
steps fail at a locked wheel.
"""

HostStep: TypeAlias = Callable[[Numbers, Numbers, Numbers], list[float]]


def commonroad_vehicle(
    *,
    model: str = "std",
    car: int = 2,
    dt: float = 0.1,
    steering_lag: float = 0.1,
    wind_force: float = 10.0,
    wind_lever: float = 0.4,
) -> Vehicle:
    """A car of Althoff and Würsching, "CommonRoad: Vehicle Models", as a plant that this project drives.

    x = (p_x, p_y, yaw, v, v_y, yaw rate, δ | hidden), the first seven as in
    `vehicle.dynamic`, p at the centre of mass. Hidden are wheel speeds, and of the
    multi-body car also roll, pitch, heave and the axles. They are told relative to
    freely rolling wheels and springs at rest, so a start with zeros there is settled.

        δ̇ = clip((δ_cmd − δ)/τ, ±δ̇_max), δ̇_max = 0.4 rad/s as CommonRoad has it; the acceleration goes through,
        F = c_w w|w| at l_w ahead of the centre of mass, added here: CommonRoad has no wind.
    The tyres' lateral force peaks at friction x load (1.0489 in CommonRoad's tyre), the longitudinal one in proportion.

    A step is a host callback: it works under `jit`, `vmap` and `scan`, one car after
    the other, without a gradient. Where the equations end, because the car's forward
    speed falls below 0.5 m/s or a wheel of the multi-body car is turned backwards in a
    spin, the state is NaN from then on.

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
    """
    _check(model, car, dt, steering_lag)
    equations, dry = MODELS[model], car_numbered(car)
    bicycle = dynamic(
        dt=dt, wind_force=wind_force, front_length=dry.a, rear_length=dry.b
    )

    def flow(control: Numbers, env: Numbers) -> Callable[[list[float]], list[float]]:
        met, push = (
            with_friction(dry, env[0]),
            {"force": wind_force * env[1] * abs(env[1]), "lever": wind_lever},
        )
        return lambda x: rates(
            equations, x, [(control[0] - x[2]) / steering_lag, control[1]], met, **push
        )

    def ends(time: float, x: Any) -> float:
        del time
        return equations.seven(x.tolist())[3] - SLOWEST

    ends.terminal = True  # type: ignore[attr-defined]

    def advance(state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        lost = [math.nan] * len(state)
        if not (all(map(math.isfinite, state)) and state[3] > SLOWEST):
            return lost
        moving, start = (
            flow(control, env),
            np.asarray(to_commonroad(equations, state, dry)),
        )
        try:
            found = solve_ivp(
                lambda time, x: moving(x.tolist()),
                (0.0, dt),
                start,
                events=ends,
                **ACCURACY,
            )
        # A wheel that rolls backwards: the multi-body car divides by its speed, held at
        # 0.
        except ArithmeticError:
            return lost
        return (
            from_commonroad(equations, found.y[:, -1].tolist(), dry)
            if found.status == 0
            else lost
        )

    def derivative(state: Numbers, control: Numbers, env: Numbers) -> list[float]:
        x = np.asarray(to_commonroad(equations, state, dry))
        little = 1e-6 * np.asarray(flow(control, env)(x.tolist()))
        ahead, behind = (
            np.asarray(from_commonroad(equations, y.tolist(), dry))
            for y in (x + little, x - little)
        )
        return ((ahead - behind) / 2e-6).tolist()

    return bicycle._replace(
        name=f"commonroad_{model}",
        state_names=(
            *bicycle.state_names,
            *(f"hidden_{index}" for index in equations.rest),
        ),
        step=_on_host(advance),
        derivative=_on_host(derivative),
        nominal=_settled(bicycle.nominal),
        nominal_derivative=_settled(bicycle.nominal_derivative),
    )


def commonroad_observation(
    state: Float[Array, "*batch state"], *, states: int = OBSERVED
) -> Float[Array, "*batch observed"]:
    """What a model of `vehicle.dynamic` (7 states) or of `vehicle.kinematic` (4 states) is to know of such a car.

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
            f"states must be 7, as of the dynamic vehicle, or 4, as of the kinematic one, got {states}"
        )
    return jnp.concatenate(
        [state[..., :3], jnp.linalg.norm(state[..., 3:5], axis=-1, keepdims=True)],
        axis=-1,
    )


def commonroad_controller(
    controller: Controller, *, states: int = OBSERVED
) -> Controller:
    """A controller made for `vehicle.dynamic` (7 states) or `vehicle.kinematic` (4), at the wheel of such a car."""

    def act(params: Any, memory: Any, state: State, *rest: Any) -> Any:
        return controller.act(
            params, memory, commonroad_observation(state, states=states), *rest
        )

    return controller._replace(act=act)


def _check(model: str, car: int, dt: float, steering_lag: float) -> None:
    """Refuse what names no car, or no time."""
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
    """A step of seven states that leaves what is hidden at 0."""

    def wider(state: State, control: Control, env: Environment) -> State:
        return (
            jnp.zeros_like(state)
            .at[:OBSERVED]
            .set(step(state[:OBSERVED], control, env))
        )

    return wider
