"""One planner is spread over several devices.

Two ways are shown: the samples of one vehicle are spread, or the vehicles of a fleet
are. Both give the same controls as one device does. The program prints the time of a
control step and the operations that each device carries out. Without several devices,
XLA can show the CPU as four:

    XLA_FLAGS=--xla_force_host_platform_device_count=4 python examples/devices.py
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from sfkd_jax import control

DT = 0.1  # control period [s]
HORIZON = 20


def dynamics(params, x, u, env):
    """Pendulum: angle from below [rad], rate [rad/s]; torque."""
    rate = x[1] + DT * (u[0] - 9.81 * jnp.sin(x[0]))
    return jnp.stack([x[0] + DT * rate, rate])


def stage(weights, x, u, before, goal):
    """Cost of a step: the pendulum shall stand."""
    return (1.0 + jnp.cos(x[0])) ** 2 + 0.1 * x[1] ** 2 + 0.01 * u[0] ** 2


def measure(function, *inputs, repeat=20):
    """Return its result, the compiled program, and the shortest time of a call [ms]."""
    compiled = jax.jit(function).lower(*inputs).compile()
    result = jax.block_until_ready(compiled(*inputs))
    times = []
    for _ in range(repeat):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        times.append(1e3 * (time.perf_counter() - began))
    return result, compiled, min(times)


def main(samples=4096, vehicles=16):
    """Return controls, program and time [ms]: on one device, and on all of them."""
    task = control.free_task(dynamics, stage, control_low=-5.0, control_high=5.0)
    planner = control.mppi(
        task,
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(2.0,),
        temperature=1.0,
    )
    goal = jnp.zeros((HORIZON, 1))

    def step(memory, x):
        return planner.act({}, memory, x, None, goal)[0]

    count = jax.device_count()
    mesh_along = partial(jax.make_mesh, (count,), axis_types=(AxisType.Auto,))
    results = {}

    # The planner spreads its samples over an axis of the mesh that is called "samples".
    # All that it is given lies on every device.
    vehicle = planner.init(jax.random.key(0)), jnp.asarray([0.1, 0.0])
    results["samples, one device"] = measure(step, *vehicle)
    mesh = mesh_along(("samples",))
    with jax.set_mesh(mesh):
        everywhere = jax.device_put(vehicle, NamedSharding(mesh, PartitionSpec()))
        results[f"samples, {count} devices"] = measure(step, *everywhere)

    # The arrays of a fleet begin with the vehicle, and this axis is spread.
    keys = jax.random.split(jax.random.key(0), vehicles)
    states = jnp.linspace(-1.0, 1.0, 2 * vehicles).reshape(vehicles, 2)
    fleet = jax.vmap(planner.init)(keys), states
    results["vehicles, one device"] = measure(jax.vmap(step), *fleet)
    mesh = mesh_along(("vehicles",))
    spread = jax.device_put(fleet, NamedSharding(mesh, PartitionSpec("vehicles")))
    results[f"vehicles, {count} devices"] = measure(jax.vmap(step), *spread)
    return results


if __name__ == "__main__":
    for name, (_, compiled, milliseconds) in main().items():
        work = compiled.cost_analysis()["flops"]
        print(f"{name}: {milliseconds:.2f} ms, {work:.2e} operations a device")
