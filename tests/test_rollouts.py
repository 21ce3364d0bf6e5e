"""What a model does along a trajectory, where the answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, driven, jit, model_and_params

from sfkd_jax.rollout import fibers_along, in_batches, rollout


@pytest.fixture(scope="module")
def one():
    return at(driven(), 0)


def run(function, name, trajectory):
    model, params = model_and_params(name)
    return jit(lambda params, data: function(model, params, data))(params, trajectory)


def test_the_true_plant_as_a_model_has_no_defects(one):
    known = run(rollout, "oracle", one)
    np.testing.assert_allclose(known.defects, 0.0 * known.defects, rtol=0, atol=2e-6)
    np.testing.assert_allclose(known.single, one.states[1:], rtol=0, atol=2e-6)


def test_fibers_are_those_of_each_step_and_of_the_one_after(one):
    # The fiber of a physics model is e itself.
    now, later = run(fibers_along, "oracle", one)
    np.testing.assert_array_equal(now, one.envs)
    np.testing.assert_array_equal(later[:-1], one.envs[1:])
    np.testing.assert_array_equal(later[-1], one.envs[-1])


@pytest.mark.parametrize("name", ["sfkd", "no_transport", "joint", "path", "state"])
def test_a_defect_matches_its_definition_on_every_switch(one, name):
    """d_k = Φ(x_{k+1}, e_{k+1}) − T(e_k → e_{k+1}) F(Φ(x_k, e_k), u_k, e_k), step by
    step.
    """
    model, params = model_and_params(name)

    @jit
    def by_hand(params, here, there, state, after, control):
        fiber, fiber_next = model.fiber(params, here), model.fiber(params, there)
        expected = model.transport(
            fiber, fiber_next, model.step(fiber, model.encode(fiber, state), control)
        )
        return model.encode(fiber_next, after).z - expected.z

    free, single, gaps, _ = run(rollout, name, one)
    for k in (0, 4, len(one.envs) - 2):
        gap = by_hand(
            params, *one.envs[k : k + 2], *one.states[k : k + 2], one.controls[k]
        )
        np.testing.assert_allclose(gaps[k], gap, atol=3e-6)
    assert float(jnp.max(jnp.abs(gaps))) > 1e-4
    np.testing.assert_allclose(free[0], single[0], atol=1e-6)


@pytest.mark.parametrize("size", [1, 3, 7, 50])
def test_batches_of_any_size_leave_every_item_what_it_is_and_trace_one_program(size):
    items, traced = {"a": jnp.arange(14.0).reshape(7, 2), "b": jnp.arange(7)}, []

    def function(item):
        traced.append(item)
        return {"sum": item["a"].sum() + item["b"], "twice": 2.0 * item["a"]}

    results = in_batches(jax.vmap(function), items, size=size)
    np.testing.assert_array_equal(results["sum"], items["a"].sum(axis=1) + items["b"])
    np.testing.assert_array_equal(results["twice"], 2.0 * items["a"])
    assert len(traced) == 1
