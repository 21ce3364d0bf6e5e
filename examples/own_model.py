"""A model of your own becomes a row of the benchmark: the bicycle plus a learned rate.

docs/results.md has the command that trains this model and drives it beside SFKD.
`corrected_bicycle` is the factory that the command names. Its argument `space` holds
mean and scale of body state, control and environment. Arguments that are called `dt`,
`nominal` and `environment` are filled in; all others are set by `model.options`.
"""

import jax
import jax.numpy as jnp

from sfkd_jax import models


def corrected_bicycle(space, *, nominal, dt, width=32):
    """Return the textbook bicycle plus a learned rate of the body state and the yaw."""
    body = space.body_mean.shape[0]
    inputs = body + 2 + 2  # body state, control, environment

    def init(key):
        hidden = jax.random.normal(key, (width, inputs)) / jnp.sqrt(inputs)
        return {"hidden": hidden, "out": jnp.zeros((1 + body, width))}

    def fiber(params, env):
        return params, env, (env - space.env_mean) / space.env_scale

    def step(fiber, state, control):
        params, env, scaled_env = fiber
        scaled_body = (state[3:] - space.body_mean) / space.body_scale
        scaled_control = (control - space.control_mean) / space.control_scale
        features = jnp.concatenate([scaled_body, scaled_control, scaled_env])
        learned = params["out"] @ jnp.tanh(params["hidden"] @ features)
        rate = nominal(state, control, env)
        return state + dt * rate.at[2:].add(learned)

    return models.state_model(init, fiber, step, state_size=3 + body)
