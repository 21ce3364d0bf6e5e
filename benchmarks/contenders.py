"""The contenders: each builds a function of no arguments that takes one control step, in a process of its own."""

import os

import problem


def sfkd_jax(samples, horizon, **settings):
    """This library; the step includes noise, all rollouts, weights, and the plan rolled out once more."""
    import jax
    import jax.numpy as jnp

    from sfkd_jax import control

    w = {name: jnp.asarray(value) for name, value in problem.weights().items()}

    def dynamics(w, z, u, env):
        hidden = jnp.tanh(w["W1"] @ jnp.concatenate([z, u]) + w["b1"])
        return w["A"] @ z + w["B"] @ u + w["W3"] @ jnp.tanh(w["W2"] @ hidden + w["b2"])

    decoder = {name: w[name] for name in ("D1", "D2", "D3")}

    def stage(weights, z, u, before, target):
        y = decoder["D3"] @ jnp.tanh(decoder["D2"] @ jnp.tanh(decoder["D1"] @ z))
        return jnp.sum((y - target) ** 2) + problem.EFFORT * jnp.sum(u**2)

    limits = {"control_low": (problem.LOW,) * problem.CONTROLS, "control_high": (problem.HIGH,) * problem.CONTROLS}
    task = control.free_task(dynamics, stage, **limits)
    settings = {"noise": "white", "temperature": problem.TEMPERATURE, **settings}
    noise = (problem.NOISE,) * problem.CONTROLS
    planner = control.mppi(task, num_samples=samples, horizon=horizon, noise_std=noise, **settings)
    targets = jnp.tile(jnp.asarray(problem.TARGET), (horizon, 1))
    act, memory = jax.jit(planner.act), [planner.init(jax.random.key(0))]
    z, env = jnp.asarray(problem.start()), jnp.zeros(0)

    def step():
        u, memory[0], _ = act(w, memory[0], z, env, targets)
        return u.block_until_ready()

    return step


def sfkd_jax_ess(samples, horizon):
    """The same with a temperature that is found for 30 effective samples."""
    return sfkd_jax(samples, horizon, effective_samples=30.0)


def sfkd_jax_sharded(samples, horizon):
    """The same with the samples on as many host devices as there are cores."""
    import jax
    import numpy as np

    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("sample",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(None, "sample", None))
    return sfkd_jax(samples, horizon, sharding=spread)


sfkd_jax_sharded.environment = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={len(os.sched_getaffinity(0))}"}


def pytorch_mppi(samples, horizon):
    """pytorch-mppi, MPPI, eager, float32."""
    import torch
    from pytorch_mppi import MPPI

    w = {name: torch.as_tensor(value) for name, value in problem.weights().items()}
    target = torch.as_tensor(problem.TARGET)

    def dynamics(z, u):
        hidden = torch.tanh(torch.cat([z, u], dim=1) @ w["W1"].T + w["b1"])
        return z @ w["A"].T + u @ w["B"].T + torch.tanh(hidden @ w["W2"].T + w["b2"]) @ w["W3"].T

    def cost(z, u):
        y = torch.tanh(torch.tanh(z @ w["D1"].T) @ w["D2"].T) @ w["D3"].T
        return ((y - target) ** 2).sum(dim=1) + problem.EFFORT * (u**2).sum(dim=1)

    bounds = {
        "u_min": torch.full((problem.CONTROLS,), problem.LOW),
        "u_max": torch.full((problem.CONTROLS,), problem.HIGH),
    }
    planner = MPPI(
        dynamics,
        cost,
        problem.RANK,
        noise_sigma=problem.NOISE**2 * torch.eye(problem.CONTROLS),
        num_samples=samples,
        horizon=horizon,
        lambda_=problem.TEMPERATURE,
        **bounds,
    )
    z = torch.as_tensor(problem.start())
    return lambda: planner.command(z)


CONTENDERS = {found.__name__: found for found in (sfkd_jax, sfkd_jax_ess, sfkd_jax_sharded, pytorch_mppi)}
