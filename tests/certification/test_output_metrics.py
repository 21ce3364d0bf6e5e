"""Metrics of single outputs of a trained model, and the radii from them."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, TINY, path_space

from sfkd_jax import models
from sfkd_jax.certification import OutputMetric
from sfkd_jax.certification._claims import OUTPUTS, readouts, require_output_metric
from sfkd_jax.certification._measured import Residuals, residuals
from sfkd_jax.certification._metrics import propose_metric
from sfkd_jax.certification._tubes import radii, worst_gaps
from sfkd_jax.certification._weights import exported
from sfkd_jax.rollout import fold, rollout
from sfkd_jax.types import Trajectory

OPTIONS = TINY | {
    "frame": "path",
    "transport": False,
    "budget": "joint",
    "forcing_hidden": 4,
    "rho": 0.85,
}


@cache
def model():
    return models.sfkd(path_space(), **OPTIONS)


@cache
def params():
    drawn = model().init(jax.random.key(0))
    noise = jax.random.split(jax.random.key(1), len(jax.tree.leaves(drawn)))
    leaves = [
        leaf + 0.3 * jax.random.normal(key, leaf.shape)
        for leaf, key in zip(jax.tree.leaves(drawn), noise, strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(drawn), leaves)


@cache
def weights():
    return exported(model(), params())


@cache
def runs(count=6, steps=40, seed=2):
    """Not of any plant: smooth random path states, controls and environments."""
    keys = jax.random.split(jax.random.key(seed), 3)
    body = jnp.cumsum(
        0.02 * jax.random.normal(keys[0], (count, steps + 1, 3)), axis=1
    ) + jnp.asarray([0.0, 0.0, 9.0])
    states = jnp.concatenate([jnp.zeros((count, steps + 1, 3)), body], axis=-1)
    controls = jax.random.uniform(
        keys[1], (count, steps, 4), minval=-1.0
    ) * jnp.asarray([0.03, 1.0, 0.02, 1.0])
    controls = controls.at[..., 3].add(9.0)
    envs = jax.random.uniform(
        keys[2],
        (count, steps, 2),
        minval=jnp.asarray(ENV_LOW),
        maxval=jnp.asarray(ENV_HIGH),
    )
    return Trajectory(states, controls, envs)


@cache
def measured():
    return residuals(model(), jax.jit(partial(fold, model()))(params()), runs())


@cache
def proposed(name="position"):
    return propose_metric(weights(), readouts(weights())[name], worst_gaps(measured()))


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_is_proposed_is_proved(name):
    require_output_metric(name, proposed(name), weights())


def test_no_pair_of_latents_contradicts_the_metric():
    """The running step, float32, at scales from 1e-2 to 1e2 and where the residual is
    steepest.
    """
    claim, folded = proposed(), jax.jit(partial(fold, model()))(params())
    factor = np.linalg.cholesky(claim.metric)

    @jax.jit
    @jax.vmap
    def distance(z, direction, control, env):
        fiber = model().fiber(folded, env)
        latent = model().encode(fiber, runs().states[0, 0])
        moved = [
            model().step(fiber, latent._replace(z=at), control).z
            for at in (z, z + direction)
        ]
        return moved[1] - moved[0]

    random = np.random.default_rng(3)
    count, rank = 4000, len(factor)
    z = random.standard_normal((count, rank)) * 10.0 ** random.uniform(
        -2, 2, (count, 1)
    )
    direction = random.standard_normal((count, rank)) * 10.0 ** random.uniform(
        -1, 1, (count, 1)
    )
    controls = np.asarray(runs().controls).reshape(-1, 4)[
        random.integers(0, 240, count)
    ]
    envs = random.uniform(ENV_LOW, ENV_HIGH, (count, 2))
    after = np.asarray(
        distance(*map(jnp.float32, (z, direction, controls, envs))), dtype=np.float64
    )
    lengths = np.linalg.norm(direction @ factor, axis=1)
    ratios = np.linalg.norm(after @ factor, axis=1) / lengths
    assert 0.5 * claim.alpha < np.max(ratios) <= claim.alpha * (1 + 1e-4)
    read = np.abs(direction @ readouts(weights())["position"][0])
    assert np.all(read <= claim.lipschitz * lengths)


def test_every_distance_to_a_nominal_model_lies_within_the_radius_of_its_run():
    """For any inputs, the nominal model started where the car is or beside it; each
    form bounds the next.
    """
    folded = jax.jit(partial(fold, model()))(params())
    predicted = jax.vmap(lambda run: rollout(model(), folded, run)[0])(runs())
    for index, name in enumerate(OUTPUTS):
        distance = np.abs(np.asarray(predicted - runs().states[:, 1:]))
        distance = distance[..., 3 + index].max(axis=1)
        bounds = radii(measured(), name, proposed(name))
        assert np.all(distance <= bounds.vehicle_to_nominal * (1 + 1e-4))
        assert np.all(bounds.vehicle_to_nominal <= bounds.asymptotic * (1 + 1e-12))
        start = np.full((len(distance), OPTIONS["rank"]), 0.1)
        beside = radii(measured(), name, proposed(name), start)
        assert np.all(beside.vehicle_to_nominal >= bounds.vehicle_to_nominal)
        assert np.all(beside.asymptotic >= bounds.asymptotic)


def test_radii_of_one_dimension_are_the_sums_that_they_are():
    """z⁺ = z/2, y = 2 z, |d| = 1, 0, 1, 0: R = 1, 1/2, 5/4, 5/8 and |y − ŷ| ≤ 2·½·R
    before + ε.
    """
    claim = OutputMetric(0.5, 2.0, np.eye(1), [[]])
    steps = np.asarray([1.0, 0.0, -1.0, 0.0]).reshape(1, 4, 1)
    misses = np.asarray([0.1, 0.0, 0.0, 0.3]).reshape(1, 4, 1) * np.ones((1, 1, 3))
    bounds = radii(Residuals(steps, misses), "position", claim)
    assert bounds.vehicle_to_nominal == pytest.approx(1.25 + 0.3)
    assert bounds.asymptotic == pytest.approx(2.0 + 0.3)
    later = radii(Residuals(steps, misses), "position", claim, np.asarray([[8.0]]))
    assert later.vehicle_to_nominal == pytest.approx(8.0 + 0.1)
