"""Planning in path coordinates: projection, curvature preview, and limits of ν."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law, tiny

from sfkd_jax import assembly, control
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.path_coordinates import curvature_ahead, path_coordinates
from sfkd_jax.driving.paths import path_from_curvature, reference_window

PLANT = plants.kinematic()
LAW = any_law()
ENV = jnp.asarray([0.6, 2.0])
LIMITS = {
    "dt": PLANT.dt,
    "control_low": PLANT.control_low,
    "control_high": PLANT.control_high,
}


def bend(slope=1e-4):
    """A reference window from 30 m along a clothoid, and the curvature where it begins."""
    path = path_from_curvature(slope * 0.5 * jnp.arange(400), spacing=0.5)
    return reference_window(
        path, jnp.asarray(30.0), jnp.asarray(9.0), dt=0.1, horizon=20
    ), path


@cache
def planner(samples, **options):
    """A planner around the law, as a controller in the world, and its step."""
    model = assembly.reference_systems(PLANT, LAW)["oracle"].model
    task = path_following.following_law(
        model, path_following.tracking_cost(dt=0.1), LAW, **LIMITS
    )
    along = control.mppi(task, num_samples=samples, noise_std=(0.01, 0.2), **options)
    controller = path_following.along_reference(along, coordinates=3)
    return controller.init(jax.random.key(0)), jax.jit(controller.act)


def law_at(state, reference):
    """The law's control where a window of 9 m/s begins."""
    curvature = curvature_ahead(reference)[0]
    xi = path_coordinates(state, reference[0], curvature)
    return LAW(xi, curvature, jnp.asarray(9.0), ENV)


def test_the_curvature_of_every_step_is_seen_ahead():
    reference, _ = bend()
    middles = 30.0 + 0.9 * (np.arange(20) + 0.5)
    np.testing.assert_allclose(curvature_ahead(reference), 1e-4 * middles, atol=2e-5)


def test_without_samples_the_law_alone_drives():
    reference, _ = bend()
    memory, act = planner(1)
    state = jnp.asarray([30.0, 0.4, 0.1, 8.0])
    action, _, info = act({}, memory, state, ENV, reference)
    np.testing.assert_allclose(action, law_at(state, reference), atol=1e-6)
    assert bool(info.healthy)


def test_what_is_added_to_the_law_stays_within_its_bounds():
    """Also with large noise, and with a cost that favours more."""
    reference, _ = bend()
    loud, act = planner(64, temperature=0.1)
    noisy = control.tuned(loud.inner, noise_std=jnp.asarray([1.0, 10.0]))
    state = jnp.asarray([30.0, 2.5, 0.3, 6.0])
    action, after, _ = act({}, loud._replace(inner=noisy), state, ENV, reference)
    added = action - law_at(state, reference)
    assert np.all(np.abs(added) <= LAW.perturbation + 1e-6)
    assert np.all(np.abs(after.inner.plan) <= LAW.perturbation + 1e-6)


def test_predicted_states_lie_where_the_car_then_is():
    """On a bend, with the true plant as the model: within 1 cm laterally; along the
    path the speed error remains.
    """
    reference, _ = bend()
    x, y, yaw, _ = reference[0]
    point = jnp.stack([x - 0.9 * jnp.cos(yaw), y, yaw, jnp.asarray(9.0)])
    memory, act = planner(1)
    action, _, info = act({}, memory, point, ENV, reference)
    after = PLANT.step(point, action, ENV)
    np.testing.assert_allclose(info.plan.states[0, :2], after[:2], atol=0.05)
    np.testing.assert_allclose(info.plan.states[0, 2:], after[2:], atol=0.01)


def test_a_model_of_the_world_is_refused():
    make = partial(
        path_following.following_law,
        law=LAW,
        cost=path_following.tracking_cost(dt=0.1),
        **LIMITS,
    )
    with pytest.raises(ValueError, match=r"model\.frame=path"):
        make(tiny())
