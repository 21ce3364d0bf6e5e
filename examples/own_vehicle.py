"""Your own vehicle is the model that the planner rolls out.

A delivery robot with two driven wheels follows an S3 path, on which grip and wind
switch every 3 s. It takes a step function of the vehicle and a feedback law that the
planner samples around. The program prints the RMS distance from the path.

    python examples/own_vehicle.py
"""

import jax
import jax.numpy as jnp

from sfkd_jax import control, models
from sfkd_jax.driving import path_following, scenarios, simulation

DT = 0.1  # control period [s]
TRACK = 0.6  # distance of the wheels [m]
HORIZON = 15


def step(state, action, env):
    """Return the state one step later.

    Args:
        state: x, y [m], yaw [rad], speed [m/s], yaw rate [rad/s].
        action: speed difference of the wheels [m/s], acceleration [m/s²].
        env: grip [-], side wind [m/s].
    """
    x, y, yaw, v, rate = state
    grip, wind = env
    v = v + DT * grip * action[1]
    rate = rate + DT * 5.0 * grip * (action[0] / TRACK - rate)
    yaw_between = yaw + 0.5 * DT * rate
    drift = 0.002 * wind * jnp.abs(wind)
    x = x + DT * (v * jnp.cos(yaw_between) - drift * jnp.sin(yaw_between))
    y = y + DT * (v * jnp.sin(yaw_between) + drift * jnp.cos(yaw_between))
    return jnp.stack([x, y, yaw + DT * rate, v, rate])


def law(errors, curvature, speed):
    """A path-following law for this robot: the planner samples around it."""
    turn = speed * curvature - 0.4 * errors.lateral - 1.2 * errors.heading
    return jnp.stack([TRACK * turn, -errors.speed])


def main(samples: int = 256, seconds: float = 15.0) -> float:
    """Return the RMS distance from the path over an episode [m]."""
    task = path_following.path_tracking(
        models.physics(step),
        path_following.tracking_cost(dt=DT, steering_rate=0.1),
        law,
        dt=DT,
        control_low=(-1.0, -2.0),
        control_high=(1.0, 2.0),
    )
    planner = control.mppi(
        task, num_samples=samples, horizon=HORIZON, noise_std=(0.05, 0.3)
    )
    draw_road = scenarios.scenario(name="s3", duration=seconds, state_size=5, dt=DT)

    @jax.jit
    def run(road_key, drive_key):
        road = draw_road(road_key)
        return simulation.simulate(
            step, planner, {}, road, drive_key, dt=DT, horizon=HORIZON
        ).lateral

    lateral = run(*jax.random.split(jax.random.key(0)))
    return float(jnp.sqrt(jnp.mean(lateral**2)))


if __name__ == "__main__":
    print(f"RMS distance from the path {main():.3f} m")
