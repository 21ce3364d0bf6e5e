"""Metrics of single outputs of a trained model, and the radii from them."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, TINY, path_space
from jaxtyping import TypeCheckError

from sfkd_jax import models
from sfkd_jax.certification import (
    OUTPUTS,
    OutputMetric,
    _output_metrics,
    radii,
    residuals,
)
from sfkd_jax.certification._claims import Refuted, readouts
from sfkd_jax.certification._exported import exported
from sfkd_jax.certification._metric_search import propose_metric
from sfkd_jax.certification._radii import Residuals, worst_gaps
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
def drives(count=6, steps=40, seed=2):
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
    return residuals(model(), jax.jit(partial(fold, model()))(params()), drives())


@cache
def proposed(name="position"):
    start = weights().residual_multipliers
    return propose_metric(
        weights(), readouts(weights())[name], worst_gaps(measured(), 5), start
    )


def refuted(claim, of=None, name="position"):
    try:
        _output_metrics.require_output_metric(
            name, claim, weights() if of is None else of
        )
    except (Refuted, TypeCheckError, TypeError, ValueError):
        return True
    return False


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_is_proposed_is_proved_and_survives_json(name):
    claim = proposed(name)
    assert not refuted(claim, name=name)
    again = OutputMetric.from_document(claim.document())
    assert not refuted(again, name=name)
    np.testing.assert_array_equal(again.metric, claim.metric)


def test_the_tube_of_an_output_is_tighter_than_by_the_norm():
    claim, rank = proposed(), weights().readout.shape[1]
    rate = float(model().structure.rate(params()))
    plain = OutputMetric(
        rate,
        float(np.linalg.norm(readouts(weights())["position"], 2)),
        np.eye(rank),
        [],
    )
    sizes = [
        np.max(radii(measured(), "position", each).for_ever) for each in (claim, plain)
    ]
    assert sizes[0] < 0.95 * sizes[1]


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
        latent = model().encode(fiber, drives().states[0, 0])
        moved = [
            model().step(fiber, latent._replace(z=at), control).z
            for at in (z, z + direction)
        ]
        return moved[1] - moved[0]

    random = np.random.default_rng(3)
    count, rank = 4000, len(factor)
    scale = 10.0 ** random.uniform(-2, 2, (count, 1))
    z = random.standard_normal((count, rank)) * scale
    direction = random.standard_normal((count, rank)) * 10.0 ** random.uniform(
        -1, 1, (count, 1)
    )
    controls = np.asarray(drives().controls).reshape(-1, 4)[
        random.integers(0, 240, count)
    ]
    envs = random.uniform(ENV_LOW, ENV_HIGH, (count, 2))
    after = np.asarray(
        distance(*map(jnp.float32, (z, direction, controls, envs))), dtype=np.float64
    )
    ratios = np.linalg.norm(after @ factor, axis=1) / np.linalg.norm(
        direction @ factor, axis=1
    )
    assert np.max(ratios) <= claim.alpha * (1 + 1e-4)
    assert np.max(ratios) > 0.5 * claim.alpha
    read = np.abs(direction @ readouts(weights())["position"][0])
    assert np.all(read <= claim.lipschitz * np.linalg.norm(direction @ factor, axis=1))


HOSTILE = {
    "alpha smaller": lambda c: c._replace(alpha=0.999 * c.alpha),
    "alpha at 1": lambda c: c._replace(alpha=1.0),
    "alpha NaN": lambda c: c._replace(alpha=float("nan")),
    "alpha below 0": lambda c: c._replace(alpha=-c.alpha),
    "alpha a word": lambda c: c._replace(alpha="0.5"),
    "lipschitz smaller": lambda c: c._replace(lipschitz=0.999 * c.lipschitz),
    "lipschitz tiny": lambda c: c._replace(lipschitz=1e-300),
    "lipschitz huge": lambda c: c._replace(lipschitz=1e300),
    "lipschitz infinite": lambda c: c._replace(lipschitz=float("inf")),
    "P indefinite": lambda c: c._replace(
        metric=c.metric - 2 * np.eye(len(c.metric)) * np.trace(c.metric)
    ),
    "P zero": lambda c: c._replace(metric=0 * c.metric),
    "P the identity": lambda c: c._replace(metric=np.eye(len(c.metric))),
    "P not symmetric": lambda c: c._replace(metric=c.metric + np.triu(c.metric, 1)),
    "P denormal": lambda c: c._replace(metric=1e-310 * c.metric),
    "P overflowing": lambda c: c._replace(metric=1e308 * c.metric),
    "P with NaN": lambda c: c._replace(
        metric=np.where(np.eye(len(c.metric)) > 0, np.nan, c.metric)
    ),
    "P of another size": lambda c: c._replace(metric=np.eye(len(c.metric) - 1)),
    "a vertex without witness": lambda c: c._replace(joint=c.joint[:-1]),
    "witnesses exchanged for one": lambda c: c._replace(
        joint=[[0 * part for part in c.joint[0]]] * len(c.joint)
    ),
    "multipliers below 0": lambda c: c._replace(
        joint=[[-part for part in vertex] for vertex in c.joint]
    ),
    "multipliers with NaN": lambda c: c._replace(
        joint=[[np.nan * part for part in vertex] for vertex in c.joint]
    ),
    "a layer without multipliers": lambda c: c._replace(
        joint=[vertex[:-1] for vertex in c.joint]
    ),
}


@pytest.mark.parametrize("change", HOSTILE.values(), ids=list(HOSTILE))
def test_a_forged_metric_is_refused(change):
    assert refuted(change(proposed()))


def test_every_vertex_counts():
    """Weights of which only the last vertex is too large for the claim."""
    vertices = np.array(weights().operators.vertices)
    vertices[-1] *= 1.5
    assert refuted(
        proposed(),
        weights()._replace(operators=weights().operators._replace(vertices=vertices)),
    )


def test_a_transport_that_turns_the_latent_has_no_metric_of_its_own():
    turning = weights()._replace(
        declared=weights().declared.__class__("tanh", "rotation", 4)
    )
    assert refuted(proposed(), turning)
    assert refuted(proposed(), name="body")


def test_every_distance_to_a_copy_lies_within_the_radius_of_its_drive():
    """For any inputs, the copy started where the car is or beside it; each form bounds
    the next.
    """
    folded = jax.jit(partial(fold, model()))(params())
    predicted = jax.vmap(lambda drive: rollout(model(), folded, drive)[0])(drives())
    for index, name in enumerate(OUTPUTS):
        distance = np.abs(np.asarray(predicted - drives().states[:, 1:]))[
            ..., 3 + index
        ].max(axis=1)
        bounds = radii(measured(), name, proposed(name))
        assert np.all(distance <= bounds.followed * (1 + 1e-4))
        assert np.all(bounds.followed <= bounds.for_ever * (1 + 1e-12))
        beside = radii(measured(), name, proposed(name), np.full(len(distance), 0.3))
        assert np.all(beside.followed >= bounds.followed)
        assert np.all(beside.for_ever >= bounds.for_ever)


def test_radii_of_one_dimension_are_the_sums_that_they_are():
    """z⁺ = z/2, y = 2 z, |d| = 1, 0, 1, 0: R = 1, 1/2, 5/4, 5/8 and |y − ŷ| ≤ 2·½·R
    before + ε.
    """
    claim = OutputMetric(0.5, 2.0, np.eye(1), [[]])
    steps = np.asarray([1.0, 0.0, -1.0, 0.0]).reshape(1, 4, 1)
    misses = np.asarray([0.1, 0.0, 0.0, 0.3]).reshape(1, 4, 1) * np.ones((1, 1, 2))
    bounds = radii(Residuals(steps, misses), "position", claim)
    assert bounds.followed == pytest.approx(1.25 + 0.3)
    assert bounds.for_ever == pytest.approx(2.0 + 0.3)
    assert bounds.largest == pytest.approx(1.0)
    later = radii(Residuals(steps, misses), "position", claim, np.asarray([8.0]))
    assert later.followed == pytest.approx(8.0 + 0.1)
