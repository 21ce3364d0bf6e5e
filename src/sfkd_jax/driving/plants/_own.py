"""Vehicles of the user: a step function, any simulator, or a vehicle in logs alone."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.driving.plants._simulator import Make, pool_of
from sfkd_jax.driving.plants._variables import (
    ACCELERATION,
    SPEED_COMMAND,
    STEERING,
    body_size,
    states_of,
)
from sfkd_jax.driving.plants._vehicle import Vehicle, nominal_derivative, rk4
from sfkd_jax.ranges import Bounds, MayBeEmpty, Positive
from sfkd_jax.types import Control, Environment, State, Step

TRIES = 32
"""Vehicles on which `hidden_change` looks for states that nobody names."""
SETTLING = 5
"""Steps before it looks."""
FORGOTTEN = 0.01
"""Share of the change over a step from which on a difference is one."""


def own(
    *,
    dt: Positive = 0.1,
    state_names: tuple[str, ...] = ("p_x", "p_y", "yaw", "v"),
    hidden_names: Annotated[tuple[str, ...], MayBeEmpty()] = (),
    control_low: Bounds = (),
    control_high: Bounds = (),
    wheelbase: Positive = 2.7,
    wind_force: float = 0.0,
    speed_loop: bool = False,
    step: Step | None = None,
) -> Vehicle:
    """Return a plant from plain numbers and, optionally, its step.

    Without a step a model of the vehicle can be learned and planned with, but the
    vehicle cannot be simulated. Its nominal model is the textbook kinematic bicycle on
    (p_x, p_y, yaw, v), with the centre of mass in the middle. Further states are
    constant in that model. States of `KNOWN_STATES` have the unit and the sensor of
    that table; of others the unit is unknown, and they are observed exactly unless
    `evaluation.observation_noise` says otherwise.

    Args:
        dt: sampling period [s].
        state_names: pose first (p_x, p_y [m], yaw [rad]), then the speed [m/s].
        hidden_names: further states of the step that no sensor shows, as that of a
            servo. They begin at 0.
        control_low: lower limits of the actuators. They may be () without a step: the
            logs give them then.
        control_high: upper limits of the actuators, or ().
        wheelbase: of the nominal bicycle and of the path-following law [m].
        wind_force: c_w of `side_force` [N s²/m²]; 0 if e_2 is no wind.
        speed_loop: whether u_2 is a speed command [m/s] instead of an acceleration
            [m/s²].
        step: (x, u, e) -> x one sampling period later, pure and traceable by jax.

    Raises:
        ValueError: states or limits are missing.
    """
    if len(state_names) < 4:
        raise ValueError(
            "vehicle.state_names must be p_x, p_y, yaw, v, …, "
            f"got {', '.join(state_names) or 'none'}"
        )
    sizes = {len(control_low), len(control_high)}
    without_limits = sizes == {0} and step is None
    if sizes != {2} and not without_limits:
        raise ValueError(
            "vehicle.control_low and vehicle.control_high must be two numbers each, "
            "as in [-0.4,-3.0]"
        )
    controls = (STEERING, SPEED_COMMAND if speed_loop else ACCELERATION)
    if not without_limits:
        controls = tuple(
            control._replace(low=low, high=high)
            for control, low, high in zip(
                controls, control_low, control_high, strict=True
            )
        )
    # Logs do not tell where the centre of mass is. It is taken to be in the middle.
    bicycle = nominal_derivative(wheelbase, 0.5 * wheelbase, states=len(state_names))
    return Vehicle(
        name="own",
        dt=dt,
        wheelbase=wheelbase,
        states=states_of(state_names),
        controls=controls,
        # `_no_step` fails only when it is called. Learning and planning do not call it.
        step=_no_step if step is None else step,
        nominal=rk4(bicycle, dt=dt),
        nominal_derivative=bicycle,
        wind_force=wind_force,
        speed_loop=speed_loop,
        simulated=step is not None,
        size=body_size(wheelbase),
        hidden=len(hidden_names),
    )


def _no_step(state: State, control: Control, env: Environment) -> State:
    """Refuse to simulate a vehicle that is known from logs alone."""
    raise ValueError(
        "vehicle=own is known from logs alone, so it cannot be simulated: "
        "pass vehicle.step=module:function or vehicle.env=module:simulator"
    )


def simulator(make: Make) -> Vehicle:
    """Return a simulator that is not written in JAX, and runs on the host, as a plant.

    `make()` returns an object with

        state_names, dt           names of all states, pose first, and the period [s]
        reset(state)              to any state, which then decides all that follows
        step(control, environment) -> state one period later

    or an environment of gymnasium with `state_names` and `dt`. It is reset with
    `options={"state": …, "environment": …}` before every step, and its observation
    begins with the state. These attributes are optional:

        settings of `own`         as attributes of the same names; `hidden_names` are
                                  those of states that follow the others
        workers                   number of copies, each in a process of its own; by
                                  default as many as there are cores
        timeout_s                 for a worker's part of a batch
        environment_names         of the entries of e, with units
        environment_roles         what each of them is, see `roles_of`
        speed                     slowest and fastest reference speed [m/s]

    The step works under `jit`, `vmap` and `scan`, a batch at a time, and has no
    gradient. If the simulator fails, the state is NaN, and a warning says why.

    Args:
        make: package.module:function, or a function that can be pickled.

    Raises:
        ValueError: the simulator cannot be made; gives the reason.
    """
    return own(**described(make).arguments, step=on_host(make))


class Described(NamedTuple):
    """What a simulator states about its vehicle.

    Attributes:
        arguments: of `own`.
        environment_names: names of the entries of e; () if it states none.
        environment_roles: what each of them is; () if it states none.
        speed: range of the speeds that it is driven at [m/s]; None if it states none.
    """

    arguments: dict[str, Any]
    environment_names: tuple[str, ...]
    environment_roles: tuple[str, ...]
    speed: tuple[float, float] | None


def described(make: Make) -> Described:
    """Return what a simulator states about its vehicle.

    Raises:
        ValueError: the simulator cannot be made, or states no range of speeds; gives
            the reason.
    """
    stated = dict(pool_of(make).settings)
    environment_names = stated.pop("environment_names")
    environment_roles = stated.pop("environment_roles")
    speed = stated.pop("speed", None)
    if speed is not None and not (len(speed) == 2 and 0.0 < speed[0] < speed[1]):
        raise ValueError(
            f"vehicle.env={make}: its speed must be two rising numbers above 0 [m/s], "
            f"got {speed}"
        )
    return Described(stated, environment_names, environment_roles, speed)


def on_host(make: Make) -> Step:
    """Return the step of a simulator; its workers start at the first call."""

    def call(*inputs: Any) -> np.ndarray:
        batch = inputs[0].shape[:-1]
        # Simulators compute in double precision.
        columns = [
            np.asarray(array, float).reshape(-1, array.shape[-1]) for array in inputs
        ]
        after = pool_of(make).step(np.concatenate(columns, axis=1))
        return after.reshape(*batch, -1).astype(inputs[0].dtype)

    def step(state: State, control: Control, env: Environment) -> State:
        shape = jax.ShapeDtypeStruct(state.shape, state.dtype)
        # One call for a whole batch, which the workers divide among themselves.
        return jax.pure_callback(
            call, shape, state, control, env, vmap_method="broadcast_all"
        )

    return step


def hidden_change(
    make: Make,
    vehicle: Vehicle,
    *,
    speed: tuple[float, float],
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
) -> dict[str, float]:
    """Return how far states are off after two steps, where a reset forgets the rest.

    A simulator that was reset once is compared with one that was reset before either
    step. They agree if the state decides all that follows. Otherwise the simulator has
    states of its own, which start anew at every step of a run.

    Args:
        make: the simulator.
        vehicle: that it simulates.
        speed: range of speeds to try [m/s].
        env_low: lower corner of E.
        env_high: upper corner of E.

    Returns:
        The root mean square by name, of states for which it is more than `FORGOTTEN` of
        what they change in the second step; {} if the simulator always fails.
    """
    pool = pool_of(make)
    draw = np.random.default_rng(0).uniform
    # Half of the controls: beyond it many vehicles saturate.
    low = 0.5 * np.asarray(vehicle.control_low)
    high = 0.5 * np.asarray(vehicle.control_high)
    controls = draw(low, high, (TRIES, len(low)))
    envs = draw(env_low, env_high, (TRIES, len(env_low)))
    inputs = np.concatenate([controls, envs], axis=1)
    states = np.zeros((TRIES, len(vehicle.states) + vehicle.hidden))
    states[:, 3] = draw(*speed, TRIES)
    # Any state would do, and one that driving leads to is never beyond the simulator.
    for _ in range(SETTLING):
        states = pool.step(np.concatenate([states, inputs], axis=1))
    start = np.concatenate([states, inputs], axis=1)
    between = pool.step(start)
    twice = pool.step(np.concatenate([between, inputs], axis=1))
    once = pool.step(start, steps=2)
    tried = np.isfinite(twice).all(axis=1) & np.isfinite(once).all(axis=1)
    if not tried.any():
        return {}
    off = np.sqrt(np.mean((twice - once)[tried] ** 2, axis=0))
    change = np.sqrt(np.mean((once - between)[tried] ** 2, axis=0))
    return {
        name: float(distance)
        for name, distance, moved in zip(vehicle.state_names, off, change, strict=False)
        if distance > FORGOTTEN * moved
    }


def check_step(plant: Vehicle, environments: int = 2) -> None:
    """Refuse a plant whose step is missing, fails, or does not return a state.

    The step is traced with shapes alone; nothing is computed.

    Args:
        plant: to check.
        environments: number of entries of e.

    Raises:
        ValueError: gives the reason.
    """
    size = len(plant.state_names) + plant.hidden
    try:
        after = jax.eval_shape(plant.step, *map(jnp.zeros, (size, 2, environments)))
    except Exception as reason:  # The step is the user's and may raise anything.
        first_line = (str(reason).splitlines() or [type(reason).__name__])[0]
        raise ValueError(
            f"the step of vehicle {plant.name} fails on {size} states "
            f"(vehicle.state_names, hidden_names), 2 controls and {environments} "
            f"environments: {first_line}"
        ) from None
    shape = getattr(after, "shape", type(after).__name__)
    if shape != (size,):
        raise ValueError(
            f"the step of vehicle {plant.name} returns {shape}, "
            f"vehicle.state_names and hidden_names have {size} names"
        )
