"""A robot of one's own: known by a step function, or from logs alone."""

from __future__ import annotations

from importlib import import_module

import jax
import jax.numpy as jnp

from sfkd_jax.types import Control, Environment, State, Step
from sfkd_jax.vehicle._vehicle import Vehicle, forward_rk4, nominal_derivative


class _NoStep(ValueError):
    """There is no step to try; the message names the setting."""


def own(
    *,
    dt: float = 0.1,
    state_names: tuple[str, ...] = ("p_x", "p_y", "yaw", "v"),
    control_low: tuple[float, ...] = (),
    control_high: tuple[float, ...] = (),
    wheelbase: float = 2.7,
    wind_force: float = 0.0,
    speed_loop: bool = False,
    step: Step | None = None,
) -> Vehicle:
    """A plant from plain numbers and, if there is one, its step (x, u, e) -> x one sampling period later.

    Without a step it may be learned and planned for, but nothing drives it here. Its
    nominal model is the textbook kinematic bicycle on (p_x, p_y, yaw, v), centre of
    mass in the middle; further states are left as they are.

    Args:
        dt: sampling period [s].
        state_names: pose first (p_x, p_y [m], yaw [rad]), then the speed [m/s].
        control_low, control_high: limits of the actuators; may be empty without a step:
            logs then tell.
        wheelbase: [m], for the nominal bicycle and the path-following law.
        wind_force: c_w of `side_force` [N s²/m²]; 0 if e_2 is no wind.
        speed_loop: whether u_2 is a speed command [m/s] instead of an acceleration
            [m/s²].
        step: pure and traceable by jax.

    Raises:
        ValueError: fewer than four states, or limits that are missing or not two
            numbers each.
    """
    if len(state_names) < 4:
        raise ValueError(
            f"vehicle.state_names must be p_x, p_y, yaw, v, …, got {', '.join(state_names) or 'none'}"
        )
    sizes = {len(control_low), len(control_high)}
    if sizes != {2} and (sizes != {0} or step is not None):
        raise ValueError(
            "vehicle.control_low and vehicle.control_high must be two numbers each, as in [-0.4,-3.0]"
        )
    bicycle = nominal_derivative(wheelbase, 0.5 * wheelbase)
    drives = _undriven if step is None else step

    def derivative(state: State, control: Control, env: Environment) -> State:
        return (drives(state, control, env) - state) / dt

    def unmoved(state: State, control: Control, env: Environment) -> State:
        return jnp.concatenate(
            [bicycle(state[:4], control, env), jnp.zeros(len(state_names) - 4)]
        )

    return Vehicle(
        name="own",
        dt=dt,
        wheelbase=wheelbase,
        state_names=tuple(state_names),
        step=drives,
        derivative=derivative,
        nominal=forward_rk4(unmoved, dt=dt),
        nominal_derivative=unmoved,
        control_low=tuple(control_low),
        control_high=tuple(control_high),
        wind_force=wind_force,
        speed_loop=speed_loop,
        simulated=step is not None,
    )


def _undriven(state: State, control: Control, env: Environment) -> State:
    """The step of a robot that is known from logs alone."""
    raise _NoStep(
        "vehicle=own is known from logs alone, so nothing can drive it: pass vehicle.step=module:function"
    )


def step_named(name: str) -> Step:
    """The step "package.module:function", imported when it is first called: what never drives does without it.

    Args:
        name: as in `vehicle.step`. What it names takes (x, u, e) and returns x one
            sampling period later; calling it raises ValueError where there is no such
            function.
    """

    def step(state: State, control: Control, env: Environment) -> State:
        module, _, function = name.partition(":")
        try:
            found = getattr(import_module(module), function)
        except (ImportError, AttributeError, ValueError) as reason:
            raise _NoStep(
                f"vehicle.step={name}: {reason}; name it as package.module:function"
            ) from None
        return found(state, control, env)

    return step


def check_step(plant: Vehicle) -> None:
    """Try a plant's step on shapes alone.

    Raises:
        ValueError: there is no step, it fails, or what it returns is no state.
    """
    sizes = (len(plant.state_names), 2, 2)
    try:
        after = jax.eval_shape(plant.step, *(jnp.zeros(size) for size in sizes))
    except _NoStep:
        raise
    except (TypeError, ValueError, IndexError) as reason:
        given = (
            f"{sizes[0]} states (vehicle.state_names), 2 controls and 2 environments"
        )
        raise ValueError(
            f"the step of vehicle {plant.name} fails on {given}: {reason}"
        ) from None
    if getattr(after, "shape", None) != (sizes[0],):
        shape = getattr(after, "shape", type(after).__name__)
        raise ValueError(
            f"the step of vehicle {plant.name} returns {shape}, vehicle.state_names has {sizes[0]} names"
        )
