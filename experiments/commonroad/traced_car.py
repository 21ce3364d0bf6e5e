"""CommonRoad's single-track drift car (STD) as a step that jax traces, with the numbers of the package.

Althoff and Würsching, "CommonRoad: Vehicle Models", `vehicle_dynamics_std` of
commonroad-vehicle-models 3.0.2 above the speeds at which it blends into a kinematic
model. `adapters.commonroad_vehicle` runs the package's own function on the host,
milliseconds a step; this one is for what needs a million steps. `disagreement` says how
far the two are apart.
"""

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import adapters
from sfkd_jax.adapters._commonroad_equations import car_numbered

CAR = car_numbered(2)
DT, STEERING_LAG, WIND_FORCE, WIND_LEVER = 0.1, 0.1, 10.0, 0.4
"""As `adapters.commonroad_vehicle` has them."""
SUBSTEPS = 50
"""Of Runge-Kutta's method: slip settles at I_w v / (R_w² K_x), 1.2 ms at 10 m/s, so 2
ms are stable above 6 m/s.
"""
SLOWEST = 0.5
"""Speeds are held here where they divide [m/s]; below it the car of the package ends."""
GRAVITY = 9.81


def _bent(slip, stiffness, curvature):
    """The argument of the magic formula behind its shape factor: atan(Bs − E (Bs − atan
    Bs)).
    """
    scaled = stiffness * slip
    return jnp.arctan(scaled - curvature * (scaled - jnp.arctan(scaled)))


def _longitudinal(slip, angle, load, friction):
    """Force of a tyre along its wheel [N], pure slip weakened by the slip angle."""
    tire = CAR.tire
    peak = tire.p_dx1 * friction / tire.p_dy1 * load
    bent = _bent(
        -slip + tire.p_hx1, load * tire.p_kx1 / (tire.p_cx1 * peak), tire.p_ex1
    )
    pure = peak * jnp.sin(tire.p_cx1 * bent + load * tire.p_vx1)
    width = tire.r_bx1 * jnp.cos(jnp.arctan(tire.r_bx2 * slip))
    both = [
        jnp.cos(tire.r_cx1 * _bent(each, width, tire.r_ex1))
        for each in (angle + tire.r_hx1, tire.r_hx1)
    ]
    return pure * both[0] / both[1]


def _lateral(slip, angle, load, friction):
    """Force of a tyre across its wheel [N], pure slip weakened by the longitudinal
    slip; no camber.
    """
    tire = CAR.tire
    peak = friction * load
    pure = peak * jnp.sin(
        tire.p_cy1 * _bent(angle, load * tire.p_ky1 / (tire.p_cy1 * peak), tire.p_ey1)
    )
    width = tire.r_by1 * jnp.cos(jnp.arctan(tire.r_by2 * (angle - tire.r_by3)))
    both = [
        jnp.cos(tire.r_cy1 * _bent(each, width, tire.r_ey1))
        for each in (slip + tire.r_hy1, tire.r_hy1)
    ]
    turned = peak * tire.r_vy1 * jnp.cos(jnp.arctan(tire.r_vy4 * angle))
    return pure * both[0] / both[1] + turned * jnp.sin(
        tire.r_vy5 * jnp.arctan(tire.r_vy6 * slip)
    )


def _derivative(state, control, env):
    """dx/dt of x = (p_x, p_y, yaw, v, v_y, yaw rate, δ, front wheel's speed, rear
    wheel's [rad/s]).
    """
    _, _, yaw, along, across, turning, steering, front, rear = state
    friction, push = env[0], WIND_FORCE * env[1] * jnp.abs(env[1])
    forward = jnp.maximum(along, SLOWEST)
    length, height = CAR.a + CAR.b, control[1] * CAR.h_s
    loads = [
        CAR.m * (-height + GRAVITY * CAR.b) / length,
        CAR.m * (height + GRAVITY * CAR.a) / length,
    ]
    angles = [jnp.arctan((across + turning * CAR.a) / forward) - steering]
    angles += [jnp.arctan((across - turning * CAR.b) / forward)]
    rolling = forward * jnp.cos(steering) + (across + CAR.a * turning) * jnp.sin(
        steering
    )
    slips = [
        1.0 - CAR.R_w * front / jnp.maximum(rolling, SLOWEST),
        1.0 - CAR.R_w * rear / forward,
    ]
    pull, drive = (
        _longitudinal(*each, friction)
        for each in zip(slips, angles, loads, strict=True)
    )
    side, hold = (
        _lateral(*each, friction) for each in zip(slips, angles, loads, strict=True)
    )
    torque = CAR.m * CAR.R_w * control[1]
    brake, engine = jnp.minimum(torque, 0.0), jnp.maximum(torque, 0.0)
    sine, cosine = jnp.sin(steering), jnp.cos(steering)
    ahead, sideways = (
        pull * cosine - side * sine + drive,
        side * cosine + pull * sine + hold + push,
    )
    moment = (side * cosine + pull * sine) * CAR.a - hold * CAR.b + WIND_LEVER * push
    fastest = CAR.steering.v_max
    parts = (
        along * jnp.cos(yaw) - across * jnp.sin(yaw),
        along * jnp.sin(yaw) + across * jnp.cos(yaw),
        turning,
        ahead / CAR.m + turning * across,
        sideways / CAR.m - turning * along,
        moment / CAR.I_z,
        jnp.clip((control[0] - steering) / STEERING_LAG, -fastest, fastest),
        (CAR.T_sb * brake + CAR.T_se * engine - CAR.R_w * pull) / CAR.I_y_w,
        ((1 - CAR.T_sb) * brake + (1 - CAR.T_se) * engine - CAR.R_w * drive)
        / CAR.I_y_w,
    )
    return jnp.stack(parts)


def _rolling(state):
    """Speeds of wheels that roll freely [rad/s], as CommonRoad starts them."""
    return jnp.stack([state[3] * jnp.cos(state[6]), state[3]]) / CAR.R_w


def step(state, control, env):
    """One period, for `vehicle=own vehicle.step=commonroad_traced:step`; states as `adapters.commonroad_vehicle`.

    Controls within -6 to 3 m/s² meet none of CommonRoad's limits of the acceleration,
    which are left out.
    """
    h = DT / SUBSTEPS

    def substep(x, _):
        k1 = _derivative(x, control, env)
        k2 = _derivative(x + 0.5 * h * k1, control, env)
        k3 = _derivative(x + 0.5 * h * k2, control, env)
        k4 = _derivative(x + h * k3, control, env)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x.at[7:].set(jnp.maximum(x[7:], 0.0)), None

    start = state.at[7:].set(jnp.maximum(state[7:] + _rolling(state), 0.0))
    after = jax.lax.scan(substep, start, None, length=SUBSTEPS)[0]
    return after.at[7:].add(-_rolling(after))


def disagreement(states, controls, envs):
    """Largest difference of one step from that of the package, by entry of the state.

    Args:
        states: (case, 9).
        controls: (case, 2).
        envs: (case, 2).
    """
    package = adapters.commonroad_vehicle(model="std")
    ours, theirs = (
        jax.jit(jax.vmap(each))(states, controls, envs) for each in (step, package.step)
    )
    return dict(
        zip(
            package.state_names, np.abs(ours - theirs).max(axis=0).tolist(), strict=True
        )
    )
