"""Metrics of outputs: of tiny networks, forged ones, and of a model with its radii."""

import inspect
import json
from dataclasses import asdict, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, TINY, path_space
from networks import METRIC, NETWORK, TURNED, frame_of
from networks import TURNED_METRICS as HONEST

from sfkd_jax import models
from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certificate._reading import read_as
from sfkd_jax.certification import CertificationRefused
from sfkd_jax.certification._claims import readouts, rows
from sfkd_jax.certification._measured import Residuals, residuals, worst_gaps
from sfkd_jax.certification._metric_claims import require_output_metric
from sfkd_jax.certification._metrics import propose_metric
from sfkd_jax.certification._search import prove_claims
from sfkd_jax.certification._tubes import radii
from sfkd_jax.certification._weights import exported
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.rollout import fold, rollout
from sfkd_jax.types import Declared, Trajectory

every_output = pytest.mark.parametrize("name", HONEST)
require = inspect.unwrap(require_output_metric)
"""Past the types, which test runs check."""


def refuted(name, claim, message, weights=TURNED):
    with pytest.raises(CertificationRefused) as reason:
        require(name, claim, weights, frame_of(weights))
    assert str(reason.value).startswith(f"outputs.{name}{message}")


@every_output
def test_what_was_found_is_proved_also_from_json(name):
    claim = HONEST[name]
    again = read_as(OutputMetric, json.loads(json.dumps(asdict(claim))))
    require(name, again, TURNED, PATH_FRAME)
    assert again == claim
    assert 0.5 < claim.alpha < 1.0


@every_output
def test_the_constants_are_those_of_the_matrices(name):
    """|c|_{P⁻¹} of the row, and nothing smaller than what was found."""
    claim, row = HONEST[name], readouts(TURNED, PATH_FRAME)[name][0]
    gain = np.sqrt(row @ np.linalg.solve(METRIC, row))
    assert claim.lipschitz == pytest.approx(gain, rel=1e-5)
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        larger = replace(claim, **{constant: 1.001 * value})
        require(name, larger, TURNED, PATH_FRAME)
        for share in (0.5, 1 - 4e-6):
            smaller = replace(claim, **{constant: share * value})
            refuted(name, smaller, f".{constant} does not follow")


@pytest.mark.parametrize("constant", ["alpha", "lipschitz"])
@pytest.mark.parametrize("value", [0.0, -5e-324, np.inf, np.nan])
def test_what_is_no_bound_is_none(constant, value):
    claim = replace(HONEST["position"], **{constant: value})
    refuted("position", claim, f".{constant} is not a bound: {value!r}")


@pytest.mark.parametrize("alpha", [1.0, 1.0 + 1e-12, 7.0])
def test_a_rate_that_is_proved_and_no_contraction_is_refused(alpha):
    claim = replace(HONEST["position"], alpha=alpha)
    refuted("position", claim, ".alpha does not follow")


@pytest.mark.parametrize("size", [2, 4])
def test_a_witness_of_another_size_is_refused(size):
    claim = HONEST["position"]
    other = replace(claim, metric=rows(np.eye(size)))
    refuted("position", other, ".metric is of another size")
    other = replace(claim, joint=(2 * claim.joint)[:size])
    refuted("position", other, ".alpha does not follow")


def test_what_may_have_a_metric_is_a_polytope_without_transport_and_decoder():
    claim = HONEST["position"]
    for transport in ("rotation", "identity "):
        other = TURNED._replace(declared=Declared("tanh", transport, 2))
        refuted("position", claim, ": this model has no", other)
    other = TURNED._replace(decoder=NETWORK.decoder)
    refuted("position", claim, ": this model has no", other)
    refuted("body", claim, ": this model has no")


# --- of a model -----------------------------------------------------------------------

OPTIONS = TINY | {
    "frame": PATH_FRAME,
    "transport": False,
    "budget": "joint",
    "forcing_hidden": 4,
    "rho": 0.85,
}


@cache
def trained():
    """A model, its explicit weights, and folded ones."""
    model, random = models.sfkd(path_space(), **OPTIONS), np.random.default_rng(1)
    params = jax.tree.map(
        lambda leaf: leaf + 0.3 * random.standard_normal(leaf.shape).astype("float32"),
        model.init(jax.random.key(0)),
    )
    return model, exported(model, params), jax.jit(partial(fold, model))(params)


@cache
def runs(count=6, steps=40, seed=2):
    """Not of any plant: smooth random path states, controls and environments."""
    keys = jax.random.split(jax.random.key(seed), 3)
    walk = 0.02 * jax.random.normal(keys[0], (count, steps + 1, 3))
    body = jnp.cumsum(walk, axis=1) + jnp.asarray([0.0, 0.0, 9.0])
    states = jnp.concatenate([jnp.zeros((count, steps + 1, 3)), body], axis=-1)
    spread = jnp.asarray([0.03, 1.0, 0.02, 1.0])
    controls = spread * jax.random.uniform(keys[1], (count, steps, 4), minval=-1.0)
    controls = controls.at[..., 3].add(9.0)
    low, high = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)
    envs = low + (high - low) * jax.random.uniform(keys[2], (count, steps, 2))
    return Trajectory(states, controls, envs)


@cache
def measured():
    model, _, folded = trained()
    return residuals(model, folded, runs())


@cache
def proposed(name="position"):
    weights = trained()[1]
    return propose_metric(
        weights, readouts(weights, PATH_FRAME)[name], worst_gaps(measured())
    )


def test_multipliers_that_prove_nothing_do_not_stop_the_search():
    """Those of the weights are about the residual alone; a proof has better ones."""
    weights = trained()[1]
    useless = tuple(1e-9 * part for part in weights.residual_multipliers)
    readout = readouts(weights, PATH_FRAME)["position"]
    joint = prove_claims(weights, PATH_FRAME).witnesses.joint
    start = np.eye(readout.shape[1]), joint
    gaps = worst_gaps(measured())
    bad = weights._replace(residual_multipliers=useless)
    with pytest.raises(CertificationRefused, match="no metric"):
        propose_metric(bad, readout, gaps)
    found = propose_metric(bad, readout, gaps, [start])
    require_output_metric("position", found, weights, PATH_FRAME)
    assert found.alpha < 1.0


@every_output
def test_what_is_proposed_is_proved(name):
    require_output_metric(name, proposed(name), trained()[1], PATH_FRAME)


def test_no_pair_of_latents_contradicts_the_metric():
    """The running step, float32, at scales from 1e-2 to 1e2 and where the residual is
    steepest.
    """
    claim, (model, weights, folded) = proposed(), trained()
    factor = np.linalg.cholesky(np.asarray(claim.metric))

    @jax.jit
    @jax.vmap
    def distance(z, direction, control, env):
        fiber = model.fiber(folded, env)
        latent = model.encode(fiber, runs().states[0, 0])
        moved = [
            model.step(fiber, latent._replace(z=at), control).z
            for at in (z, z + direction)
        ]
        return moved[1] - moved[0]

    random, count = np.random.default_rng(3), 4000
    z, direction = random.standard_normal((2, count, len(factor)))
    z *= 10.0 ** random.uniform(-2, 2, (count, 1))
    direction *= 10.0 ** random.uniform(-1, 1, (count, 1))
    drawn = random.integers(0, 240, count)
    controls = np.asarray(runs().controls).reshape(-1, 4)[drawn]
    envs = random.uniform(ENV_LOW, ENV_HIGH, (count, 2))
    after = np.asarray(
        distance(*map(jnp.float32, (z, direction, controls, envs))), dtype=np.float64
    )
    lengths = np.linalg.norm(direction @ factor, axis=1)
    ratios = np.linalg.norm(after @ factor, axis=1) / lengths
    assert 0.5 * claim.alpha < np.max(ratios) <= claim.alpha * (1 + 1e-4)
    read = np.abs(direction @ readouts(weights, PATH_FRAME)["position"][0])
    assert np.all(read <= claim.lipschitz * lengths)


def test_every_distance_to_a_nominal_model_lies_within_the_radius_of_its_run():
    """For any inputs, the nominal model started where the car is or beside it; each
    form bounds the next.
    """
    model, _, folded = trained()
    predicted = jax.jit(jax.vmap(lambda run: rollout(model, folded, run).free))(runs())
    for index, name in enumerate(HONEST):
        distance = np.abs(np.asarray(predicted - runs().states[:, 1:]))
        distance = distance[..., 3 + index].max(axis=1)
        bounds = radii(measured(), name, proposed(name))
        assert np.all(distance <= bounds["vehicle_to_nominal"] * (1 + 1e-4))
        further = bounds["asymptotic"] * (1 + 1e-12)
        assert np.all(bounds["vehicle_to_nominal"] <= further)
        start = np.full((len(distance), OPTIONS["rank"]), 0.1)
        beside = radii(measured(), name, proposed(name), start)
        assert np.all(beside["vehicle_to_nominal"] >= bounds["vehicle_to_nominal"])
        assert np.all(beside["asymptotic"] >= bounds["asymptotic"])


def test_radii_of_one_dimension_are_the_sums_that_they_are():
    """z⁺ = z/2, y = 2 z, |d| = 1, 0, 1, 0: R = 1, 1/2, 5/4, 5/8 and |y − ŷ| ≤ 2·½·R
    before + ε.
    """
    claim = OutputMetric(alpha=0.5, lipschitz=2.0, metric=((1.0,),), joint=((),))
    steps = np.asarray([1.0, 0.0, -1.0, 0.0]).reshape(1, 4, 1)
    misses = {"position": np.asarray([[0.1, 0.0, 0.0, 0.3]])}
    bounds = radii(Residuals(steps, misses), "position", claim)
    assert bounds["vehicle_to_nominal"] == pytest.approx(1.25 + 0.3)
    assert bounds["asymptotic"] == pytest.approx(2.0 + 0.3)
    later = radii(Residuals(steps, misses), "position", claim, np.asarray([[8.0]]))
    assert later["vehicle_to_nominal"] == pytest.approx(8.0 + 0.1)
