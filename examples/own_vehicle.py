"""Your own vehicle as the rollout model: a delivery robot with two driven wheels
follows an S3 path.
"""

import jax
import jax.numpy as jnp

from sfkd_jax import control, evaluation, models, scenarios

DT, TRACK = 0.1, 0.6  # [s], between the wheels [m]


def step(state, action, env):
    """x = (p_x, p_y, yaw, v, yaw rate); action = (speed difference of the wheels,
    acceleration); env = (grip, wind).
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
    """RMS distance from the path over an episode [m]."""
    limits = {"control_low": (-1.0, -2.0), "control_high": (1.0, 2.0)}
    cost = control.tracking_cost(dt=DT, steering_rate=0.1)
    task = control.path_tracking(models.physics(step), cost, law, dt=DT, **limits)
    planner = control.mppi(task, num_samples=samples, horizon=15, noise_std=(0.05, 0.3))
    family = scenarios.scenario(name="s3", duration=seconds, state_size=5, dt=DT)

    @jax.jit
    def run(road_key, drive_key):
        road = family(road_key)
        return evaluation.simulate(
            step, planner, {}, road, drive_key, dt=DT, horizon=15
        ).lateral

    lateral = run(*jax.random.split(jax.random.key(0)))
    return float(jnp.sqrt(jnp.mean(lateral**2)))


if __name__ == "__main__":
    print(f"RMS distance from the path {main():.3f} m")
