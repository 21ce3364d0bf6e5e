"""This library among the contenders; each builds `step(z, target) -> u` on numpy
arrays.
"""

from functools import partial

from benchmarks import harness
from benchmarks.timing import problem


def planner(samples, horizon, **settings):
    """A `Controller` for the problem, and its weights: noise, all rollouts, weights,
    the plan rolled out once more.
    """
    import jax.numpy as jnp

    from sfkd_jax import control

    w = {name: jnp.asarray(value) for name, value in problem.weights().items()}

    def dynamics(w, z, u, env):
        return problem.advance(jnp, w, z, u)

    def stage(weights, z, u, before, target):
        return problem.charge(jnp, w, z, u, target)

    limits = {
        "control_low": (problem.LOW,) * problem.CONTROLS,
        "control_high": (problem.HIGH,) * problem.CONTROLS,
    }
    task = control.free_task(dynamics, stage, **limits)
    same = {"noise": "white", "temperature": problem.TEMPERATURE}
    settings = {**same, "unroll": 4, **settings}
    noise = (problem.NOISE,) * problem.CONTROLS
    return control.mppi(
        task, num_samples=samples, horizon=horizon, noise_std=noise, **settings
    ), w


def arguments(controller, w, horizon, seed=0):
    """What `act` takes: weights, state, observation, environment, targets."""
    import jax
    import jax.numpy as jnp

    targets = jnp.tile(jnp.asarray(problem.TARGET), (horizon, 1))
    return (
        w,
        controller.init(jax.random.key(seed)),
        jnp.asarray(problem.start()),
        jnp.zeros(0),
        targets,
    )


def sfkd_jax(samples, horizon, seed=0, **settings):
    """The algorithm that the others have: white noise, one temperature, weights that
    are constants of the compiled step.
    """
    import jax
    import numpy as np

    controller, w = planner(samples, horizon, **settings)
    _, state, _, env, _ = arguments(controller, w, horizon, seed)
    act, memory = jax.jit(partial(controller.act, w)), [state]

    def step(z, target):
        u, memory[0], _ = act(memory[0], z, env, np.tile(target, (horizon, 1)))
        return np.asarray(u)

    return step


def sfkd_jax_ess(samples, horizon, seed=0):
    """The same with a temperature that is found for 30 effective samples."""
    return sfkd_jax(samples, horizon, seed, effective_samples=30.0)


def sfkd_jax_knots(samples, horizon, seed=0):
    """The same with noise of five bumps over the horizon."""
    return sfkd_jax(
        samples, horizon, seed, effective_samples=30.0, noise="rbf", noise_knots=5
    )


def sfkd_jax_sharded(samples, horizon, seed=0, **settings):
    """The samples on as many host devices as there are cores."""
    return sfkd_jax(samples, horizon, seed, sharding=spread(), **settings)


def spread():
    """Samples dealt to all devices."""
    import jax
    import numpy as np

    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("sample",))
    return jax.sharding.NamedSharding(
        mesh, jax.sharding.PartitionSpec(None, "sample", None)
    )


sfkd_jax_sharded.environment = harness.HOST_DEVICES
