"""MPPI on dynamics of your own: swing up a pendulum that the motor is too weak to lift
at once.
"""

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT = 0.05


def dynamics(
    params, state, torque, env
):  # angle from upright [rad], rate [rad/s]; env is the gravity [m/s²]
    rate = state[1] + DT * (env[0] * jnp.sin(state[0]) + 3.0 * torque[0])
    return jnp.stack([state[0] + DT * rate, rate])


def stage(weights, state, torque, torque_before, target):
    return (
        weights["angle"] * (1 - jnp.cos(state[0]))
        + weights["rate"] * state[1] ** 2
        + 0.001 * torque[0] ** 2
    )


def main(samples: int = 512, steps: int = 120) -> float:
    """Drive for six seconds from hanging at rest; the height reached at the end, 1 is
    upright.
    """
    weights = {"angle": 1.0, "rate": 0.05}
    task = control.free_task(
        dynamics,
        stage,
        dt=DT,
        control_low=(-2.0,),
        control_high=(2.0,),
        weights=weights,
    )
    planner = control.mppi(
        task,
        num_samples=samples,
        horizon=40,
        noise_std=(1.5,),
        noise="spline",
        noise_knots=8,
        effective_samples=20.0,
    )
    gravity = jnp.asarray([9.81])

    def step(carry, _):
        state, memory = carry
        torque, memory, _ = planner.act({}, memory, state, gravity, ())
        return (dynamics({}, state, torque, gravity), memory), None

    start = (jnp.asarray([jnp.pi, 0.0]), planner.init(jax.random.key(0)))
    (state, _), _ = jax.jit(
        lambda start: jax.lax.scan(step, start, None, length=steps)
    )(start)
    return float(jnp.cos(state[0]))


if __name__ == "__main__":
    print(f"height at the end {main():.3f}")
