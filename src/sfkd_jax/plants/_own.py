"""A vehicle of the user's own, given by a step function or by logs alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sfkd_jax.plants._vehicle import Vehicle, nominal_derivative, rk4
from sfkd_jax.ranges import Bounds, Positive
from sfkd_jax.types import Control, Environment, State, Step


def own(
    *,
    dt: Positive = 0.1,
    state_names: tuple[str, ...] = ("p_x", "p_y", "yaw", "v"),
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
    (p_x, p_y, yaw, v), with the centre of mass in the middle; further states are
    constant.

    Args:
        dt: sampling period [s].
        state_names: pose first (p_x, p_y [m], yaw [rad]), then the speed [m/s].
        control_low: lower limits of the actuators; () without a step, where the logs
            give them.
        control_high: upper limits of the actuators.
        wheelbase: [m], for the nominal bicycle and the path-following law.
        wind_force: c_w of `side_force` [N s²/m²]; 0 if e_2 is no wind.
        speed_loop: whether u_2 is a speed command [m/s] instead of an acceleration
            [m/s²].
        step: (x, u, e) -> x one sampling period later, pure and traceable by jax.
    """
    if len(state_names) < 4:
        raise ValueError(
            "vehicle.state_names must be p_x, p_y, yaw, v, …, "
            f"got {', '.join(state_names) or 'none'}"
        )
    sizes = {len(control_low), len(control_high)}
    # Without a step the limits may come later, from the logs.
    if sizes != {2} and (sizes != {0} or step is not None):
        raise ValueError(
            "vehicle.control_low and vehicle.control_high must be two numbers each, "
            "as in [-0.4,-3.0]"
        )
    # The centre of mass in the middle: logs do not tell where it is.
    bicycle = nominal_derivative(wheelbase, 0.5 * wheelbase, states=len(state_names))
    return Vehicle(
        name="own",
        dt=dt,
        wheelbase=wheelbase,
        state_names=tuple(state_names),
        # Fails when it is called: learning and planning do not simulate.
        step=_no_step if step is None else step,
        nominal=rk4(bicycle, dt=dt),
        nominal_derivative=bicycle,
        control_low=tuple(control_low),
        control_high=tuple(control_high),
        wind_force=wind_force,
        speed_loop=speed_loop,
        simulated=step is not None,
    )


def _no_step(state: State, control: Control, env: Environment) -> State:
    """The step of a vehicle that is known from logs alone."""
    raise ValueError(
        "vehicle=own is known from logs alone, so it cannot be simulated: "
        "pass vehicle.step=module:function"
    )


def check_step(plant: Vehicle) -> None:
    """Refuse a step that is missing, fails or returns no state, from shapes only."""
    size = len(plant.state_names)
    given = f"{size} states (vehicle.state_names), 2 controls and 2 environments"
    try:
        after = jax.eval_shape(plant.step, *map(jnp.zeros, (size, 2, 2)))
    except Exception as reason:  # a function of the user raises anything
        first = (str(reason).splitlines() or [type(reason).__name__])[0]
        raise ValueError(
            f"the step of vehicle {plant.name} fails on {given}: {first}"
        ) from None
    shape = getattr(after, "shape", type(after).__name__)
    if shape != (size,):
        raise ValueError(
            f"the step of vehicle {plant.name} returns {shape}, "
            f"vehicle.state_names has {size} names"
        )
