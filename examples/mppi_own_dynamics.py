"""MPPI plans with dynamics of your own: it swings up a pendulum.

The motor is too weak to lift the pendulum at once, so it has to swing. Dynamics and
cost are two functions; nothing is learned. The program prints the height that is
reached at the end, which is 1 where the pendulum stands.

    python examples/mppi_own_dynamics.py
"""

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT = 0.05  # control period [s]


def dynamics(params, state, torque, env):
    """One step of the angle from upright [rad] and its rate [rad/s].

    The environment is the gravity [m/s²].
    """
    rate = state[1] + DT * (env[0] * jnp.sin(state[0]) + 3.0 * torque[0])
    return jnp.stack([state[0] + DT * rate, rate])


def stage(weights, state, torque, torque_before, target):
    """Cost of a step; its weights may be changed without compiling again."""
    return (
        weights["angle"] * (1 - jnp.cos(state[0]))
        + weights["rate"] * state[1] ** 2
        + 0.001 * torque[0] ** 2
    )


def main(samples: int = 512, steps: int = 120) -> float:
    """Drive for six seconds from hanging at rest, and return the height at the end."""
    task = control.free_task(
        dynamics,
        stage,
        dt=DT,
        control_low=(-2.0,),
        control_high=(2.0,),
        weights={"angle": 1.0, "rate": 0.05},
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
    run = jax.jit(lambda start: jax.lax.scan(step, start, None, length=steps))
    (state, _), _ = run(start)
    return float(jnp.cos(state[0]))


if __name__ == "__main__":
    print(f"height at the end {main():.3f}")
