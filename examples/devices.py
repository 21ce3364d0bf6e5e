"""One planner over several devices: its samples, or the vehicles of a fleet.

XLA_FLAGS=--xla_force_host_platform_device_count=4 python examples/devices.py
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from sfkd_jax import control

DT, HORIZON = 0.1, 20


def dynamics(params, x, u, env):
    """Pendulum: angle from below [rad], rate [rad/s]; torque."""
    rate = x[1] + DT * (u[0] - 9.81 * jnp.sin(x[0]))
    return jnp.stack([x[0] + DT * rate, rate])


def stage(weights, x, u, before, goal):
    return (1.0 + jnp.cos(x[0])) ** 2 + 0.1 * x[1] ** 2 + 0.01 * u[0] ** 2


def measured(function, *given, repeat=20):
    """What it returns, the compiled program, and the shortest time of a call [ms]."""
    compiled = jax.jit(function).lower(*given).compile()
    result, times = jax.block_until_ready(compiled(*given)), []
    for _ in range(repeat):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*given))
        times.append(1e3 * (time.perf_counter() - began))
    return result, compiled, min(times)


def main(samples=4096, vehicles=16):
    """Controls, work of each device and time [ms]: on one device, and on all."""
    task = control.free_task(dynamics, stage, control_low=-5.0, control_high=5.0)
    settings = {"num_samples": samples, "horizon": HORIZON, "noise_std": (2.0,)}
    planner = control.mppi(task, temperature=1.0, **settings)
    act = partial(planner.act, {})
    goal = jnp.zeros((HORIZON, 1))

    def step(memory, x):
        return act(memory, x, None, goal)[0]

    # Everything is on all devices, except for what the name of an axis spreads.
    count = jax.device_count()
    axis = partial(jax.make_mesh, (count,), axis_types=(AxisType.Auto,))
    one = planner.init(jax.random.key(0)), jnp.asarray([0.1, 0.0])
    results = {"samples, one device": measured(step, *one)}
    with jax.set_mesh(mesh := axis(("samples",))):
        everywhere = jax.device_put(one, NamedSharding(mesh, PartitionSpec()))
        results[f"samples, {count} devices"] = measured(step, *everywhere)

    fleet = (
        jax.vmap(planner.init)(jax.random.split(jax.random.key(0), vehicles)),
        jnp.linspace(-1.0, 1.0, 2 * vehicles).reshape(vehicles, 2),
    )
    results["vehicles, one device"] = measured(jax.vmap(step), *fleet)
    mesh = axis(("vehicles",))
    spread = jax.device_put(fleet, NamedSharding(mesh, PartitionSpec("vehicles")))
    results[f"vehicles, {count} devices"] = measured(jax.vmap(step), *spread)
    return results


if __name__ == "__main__":
    for name, (_, compiled, milliseconds) in main().items():
        work = compiled.cost_analysis()["flops"]
        print(f"{name}: {milliseconds:.2f} ms, {work:.2e} operations a device")
