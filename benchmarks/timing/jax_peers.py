"""Contenders in jax that are not ours; each builds `step(z, target) -> u` on numpy
arrays.
"""

from functools import partial

from benchmarks.timing import problem


def plain_jax(samples, horizon, seed=0, temperature=problem.TEMPERATURE):
    """What a user would write by hand: one scan over the horizon, softmax, shift; no
    limits kept but the box.
    """
    import jax
    import jax.numpy as jnp

    w = _weights()

    def act(memory, z, target):
        key, plan = memory
        key, draw = jax.random.split(key)
        noise = problem.NOISE * jax.random.normal(
            draw, (horizon, samples, problem.CONTROLS)
        )
        plans = jnp.clip(plan[:, None] + noise, problem.LOW, problem.HIGH)

        def body(carry, controls):
            costs, states = carry
            states = jax.vmap(partial(problem.advance, jnp, w))(states, controls)
            charges = jax.vmap(partial(problem.charge, jnp, w), in_axes=(0, 0, None))(
                states, controls, target
            )
            return (costs + charges, states), None

        (costs, _), _ = jax.lax.scan(
            body, (jnp.zeros(samples), jnp.tile(z, (samples, 1))), plans
        )
        plan = jnp.einsum("m,tmc->tc", jax.nn.softmax(-costs / temperature), plans)
        return plan[0], (key, jnp.concatenate([plan[1:], plan[-1:]]))

    return _stepping(
        act, (jax.random.key(seed), jnp.zeros((horizon, problem.CONTROLS)))
    )


def jax_mppi(samples, horizon, seed=0, temperature=problem.TEMPERATURE):
    """jax_mppi, `mppi.command` inside one jit; it charges z_t where the others charge
    z_{t+1}: as much work.
    """
    import jax
    import jax.numpy as jnp
    from jax_mppi import mppi

    w, ones = _weights(), jnp.ones(problem.CONTROLS)
    box = {
        "u_min": problem.LOW * ones,
        "u_max": problem.HIGH * ones,
        "key": jax.random.PRNGKey(seed),
    }
    size = {"num_samples": samples, "horizon": horizon, "lambda_": temperature}
    config, first = mppi.create(
        problem.RANK, problem.CONTROLS, problem.NOISE**2 * jnp.diag(ones), **size, **box
    )

    def act(memory, z, target):
        cost = lambda z, u: problem.charge(jnp, w, z, u, target)
        return mppi.command(config, memory, z, partial(problem.advance, jnp, w), cost)

    return _stepping(act, first)


def evosax_cma_es(samples, horizon, seed=0):
    """evosax, one generation of CMA-ES a step, started anew around the shifted plan."""
    import jax
    import jax.numpy as jnp
    from evosax.algorithms import CMA_ES

    w = _weights()
    plan = jnp.zeros((horizon, problem.CONTROLS))
    strategy = CMA_ES(population_size=samples, solution=plan)
    params = strategy.default_params.replace(std_init=problem.NOISE)

    def rollout(z, target, controls):
        def body(z, u):
            z = problem.advance(jnp, w, z, u)
            return z, problem.charge(jnp, w, z, u, target)

        return jnp.sum(jax.lax.scan(body, z, controls)[1])

    def act(memory, z, target):
        key, plan = memory
        key, begin, ask, tell = jax.random.split(key, 4)
        state = strategy.init(begin, plan, params)
        plans, state = strategy.ask(ask, state, params)
        plans = jnp.clip(plans, problem.LOW, problem.HIGH)
        costs = jax.vmap(partial(rollout, z, target))(plans)
        state, _ = strategy.tell(tell, plans, costs, state, params)
        plan = jnp.clip(strategy.get_mean(state), problem.LOW, problem.HIGH)
        return plan[0], (key, jnp.concatenate([plan[1:], plan[-1:]]))

    return _stepping(act, (jax.random.key(seed), plan))


def _weights():
    """The problem's, on the device."""
    import jax.numpy as jnp

    return {name: jnp.asarray(value) for name, value in problem.weights().items()}


def _stepping(act, first):
    """`act(memory, z, target) -> u, memory`, jitted, with its memory kept."""
    import jax
    import numpy as np

    jitted, memory = jax.jit(act), [first]

    def step(z, target):
        u, memory[0] = jitted(memory[0], z, target)
        return np.asarray(u)

    return step
