"""The search for a planner's settings over a batch of tasks."""

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import control

HORIZON = 6
NOTHING = jnp.zeros(0)
TASK = control.free_task(
    lambda params, x, u, e: x + u,
    lambda weights, x, u, before, target: jnp.sum(x**2),
    control_low=-1.0,
    control_high=1.0,
)


def planner(**settings):
    options = {"num_samples": 64, "horizon": HORIZON, "noise_std": (0.01,)}
    return control.mppi(TASK, **(options | settings))


def drive_with(controller):
    """Sum of squares over eight steps from a start."""

    def drive(state, start):
        def step(carry, _):
            x, state = carry
            u, state, _ = controller.act({}, state, x, NOTHING, ())
            x = x + u
            return (x, state), jnp.sum(x**2)

        return jnp.sum(jax.lax.scan(step, (start, state), None, length=8)[1])

    return drive


STARTS = jnp.linspace(-2.0, 2.0, 6)[:, None]


def test_settings_that_are_far_off_are_found_and_the_first_trial_is_the_start():
    """Noise of 0.01 cannot cross two units in eight steps; a temperature of 500 makes
    all samples count the same.
    """
    controller = planner(temperature=500.0)
    drive = drive_with(controller)
    found = control.autotune(
        controller, drive, STARTS, key=jax.random.key(0), rounds=4, span=30.0
    )
    np.testing.assert_array_equal(found.factors[0], [1.0, 1.0])
    assert found.cost == jnp.min(found.costs) < 0.2 * found.costs[0]
    assert found.factors.shape == (4 * 9, 2)
    assert float(found.tuning.noise_std[0]) > 0.1
    keys = jax.random.split(jax.random.key(0), len(STARTS))

    def one(key, start):
        state = controller.init(key)
        return drive(state._replace(tuning=found.tuning), start)

    again = jnp.mean(jax.vmap(one)(keys, STARTS))
    np.testing.assert_allclose(again, found.cost, rtol=1e-4)


def test_a_cost_that_is_not_finite_never_wins():
    def drive(state, start):
        noise = state.tuning.noise_std[0]
        return jnp.where(noise > 0.011, jnp.nan, start[0] * 0.0 + noise)

    found = control.autotune(
        planner(), drive, STARTS, key=jax.random.key(0), entries=("noise_std",)
    )
    assert bool(jnp.isfinite(found.cost))
    assert float(found.tuning.noise_std[0]) < 0.011
    assert bool(jnp.isinf(found.costs).any())
