"""The rate of a continuous flow: exact cases, attacks, and mutants of the check."""

import dataclasses
import json
from functools import cache

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from composing import settings
from helpers import ENV_HIGH, ENV_LOW, jit, model_and_params, space

from sfkd_jax import build, certification, certify, models, policy, store
from sfkd_jax.certification import (
    CertificateStale,
    CertificationRefused,
    attack_growth,
    certify_incremental,
    check_incremental,
    contraction_metrics,
    incremental_rate,
    is_incremental,
)
from sfkd_jax.experiment import runs, stages
from sfkd_jax.settings import plain
from sfkd_jax.types import Declared, Incremental, Structure


def flow(linear, outer, inner, multipliers, metric=None):
    """Weights by hand."""
    linear = np.asarray(linear, dtype=np.float64)
    metric = np.eye(len(linear)) if metric is None else metric
    parts = [
        np.asarray(part, dtype=np.float64)
        for part in (outer, inner, metric, multipliers)
    ]
    return Incremental(linear, *parts, Declared("tanh", "identity", 2))


@cache
def generic(body=4, scale=0.5, seed=0):
    """Weights of a ControlSynth model."""
    model = models.control_synth(space(body), width=8, input_hidden=(4,))
    random = np.random.default_rng(seed)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    params = jax.tree.map(
        lambda leaf: (scale * random.standard_normal(leaf.shape)).astype(np.float32),
        shapes,
    )
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype=np.float64),
        jit(model.structure.explicit)(params),
    )


def random_flow(seed, body, hidden):
    """Weights with no structure, most of which contract."""
    random = np.random.default_rng(seed)
    outer, inner = (
        random.standard_normal((body, hidden)),
        random.standard_normal((hidden, body)),
    )
    linear = random.standard_normal((body, body)) - 2.0 * random.uniform(
        0.5, 3.0
    ) * hidden * np.eye(body)
    root = np.eye(body) + 0.3 * random.standard_normal((body, body))
    multipliers = np.linalg.norm(outer, axis=0) / np.linalg.norm(inner, axis=1)
    return flow(linear, outer, inner, multipliers, root.T @ root)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_rate_of_a_scalar_flow_is_known(scale):
    """With λ_i = |a_i / w_i| the inequality is exact: γ = −a_0 − Σ max(0, a_i w_i)."""
    random = np.random.default_rng(3)
    a, w = scale * random.standard_normal(12), random.standard_normal(12) / scale
    gain = float(np.sum(np.maximum(a * w, 0.0)))
    weights = flow([[-gain - 0.7]], a[None], w[:, None], np.abs(a / w))
    assert incremental_rate(weights) == pytest.approx(0.7, rel=1e-3)
    assert incremental_rate(weights) <= 0.7
    assert attack_growth(weights) == pytest.approx(-0.7, rel=1e-9)


def test_a_gradient_flow_pays_nothing_for_its_networks():
    """A = −W'Λ: the slopes only add decay, and the rate is that of the linear part."""
    random = np.random.default_rng(0)
    inner, multipliers = random.standard_normal((20, 3)), random.uniform(0.1, 10.0, 20)
    weights = flow(-0.3 * np.eye(3), -inner.T * multipliers, inner, multipliers)
    assert 0.3 * (1 - 2e-3) <= incremental_rate(weights) <= 0.3
    assert attack_growth(weights) == pytest.approx(-0.3)


@hypothesis.given(
    seed=st.integers(0, 10**6), body=st.integers(1, 5), hidden=st.integers(1, 12)
)
@hypothesis.settings(max_examples=25, deadline=None)
def test_the_proved_rate_holds_for_every_pattern_of_slopes(seed, body, hidden):
    weights = random_flow(seed, body, hidden)
    attack = -attack_growth(weights)
    try:
        rate = incremental_rate(weights)
    except CertificationRefused:
        rate = 0.0
    assert rate <= attack or attack < 0.0
    random = np.random.default_rng(seed)
    for _ in range(20):
        slopes = random.uniform(size=hidden) ** random.uniform(0.2, 5.0)
        moving = weights.metric @ (
            weights.linear + weights.outer @ (slopes[:, None] * weights.inner)
        )
        top = (
            np.linalg.eigvals(
                np.linalg.solve(weights.metric, moving + moving.T)
            ).real.max()
            / 2
        )
        assert top <= -attack + 1e-9 * abs(attack)
        assert top <= -rate + 1e-9 or rate == 0.0


MUTANTS = {
    "linear part shifted by 2γ": lambda w, rate: w._replace(
        linear=w.linear + 2 * rate * np.eye(4)
    ),
    "linear part shifted a little": lambda w, rate: w._replace(
        linear=w.linear + 1e-4 * rate * np.eye(4)
    ),
    "one multiplier negative": lambda w, _: w._replace(
        multipliers=w.multipliers * np.r_[-1.0, np.ones(15)]
    ),
    "all multipliers negative": lambda w, _: w._replace(multipliers=-w.multipliers),
    "one multiplier 0": lambda w, _: w._replace(
        multipliers=w.multipliers * np.r_[0.0, np.ones(15)]
    ),
    "multipliers far too large": lambda w, _: w._replace(
        multipliers=1e4 * w.multipliers
    ),
    "rows of W in another order": lambda w, _: w._replace(
        inner=np.roll(w.inner, 1, axis=0)
    ),
    "sign of A": lambda w, _: w._replace(outer=-w.outer),
    "A ten times too large": lambda w, _: w._replace(outer=10 * w.outer),
    "the metric forgotten": lambda w, _: w._replace(metric=np.eye(4)),
    "the metric negative": lambda w, _: w._replace(metric=-w.metric),
    "the metric singular": lambda w, _: w._replace(
        metric=np.diag([1.0, 1.0, 1.0, 0.0])
    ),
    "transposed linear part": lambda w, _: w._replace(linear=w.linear.T),
    "NaN in A": lambda w, _: w._replace(
        outer=np.where(np.arange(16) == 3, np.nan, w.outer)
    ),
    "NaN in W": lambda w, _: w._replace(
        inner=np.where(np.arange(4) == 3, np.nan, w.inner)
    ),
    "NaN in the metric": lambda w, _: w._replace(metric=np.full((4, 4), np.nan)),
    "an infinite multiplier": lambda w, _: w._replace(
        multipliers=w.multipliers * np.r_[np.inf, np.ones(15)]
    ),
    "infinity in the linear part": lambda w, _: w._replace(linear=w.linear - np.inf),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_mutants_are_caught(mutant):
    weights = generic()
    rate = incremental_rate(weights)
    assert check_incremental(weights, rate)
    assert not check_incremental(MUTANTS[mutant](weights, rate), rate)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_never_proved(rate):
    assert not check_incremental(generic(), rate)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"outer": np.full((4, 16), np.nan)}, "not finite"),
        (
            {"declared": Declared("gelu", "identity", 2)},
            "slopes of the activation 'gelu'",
        ),
        ({"declared": Declared("tanh", "rotation", 2)}, "transport 'rotation'"),
        ({"multipliers": -np.ones(16)}, "multipliers are not positive"),
        ({"metric": np.diag([1.0, 1.0, 1.0, -1.0])}, "metric is not positive definite"),
        ({"linear": np.eye(4)}, "no rate above 0"),
    ],
)
def test_a_refusal_names_its_reason(change, reason):
    with pytest.raises(CertificationRefused, match=reason):
        incremental_rate(generic()._replace(**change))


def test_the_document_states_the_rate_and_an_attack_that_is_no_slower():
    model = models.control_synth(space(4), width=8, input_hidden=(4,))
    params = jit(model.init)(jax.random.key(0))
    document = certify_incremental(model, params, dt=0.1)
    assert document["valid"]
    assert document["mode"] == "incremental"
    assert document["reason"] is None
    assert 0.05 <= document["rate_per_s"] <= document["attack"]
    assert document["alpha"] == pytest.approx(np.exp(-0.1 * document["rate_per_s"]))
    assert 1.0 <= document["tightness"] < 1.1
    assert "not its discretisation" in document["scope"]
    json.dumps(document)


def test_a_false_declaration_is_refused_at_the_door_of_the_model():
    model, params = model_and_params("control_synth")

    def explicit(params):
        weights = model.structure.explicit(params)
        return weights._replace(
            declared=dataclasses.replace(weights.declared, activation="sin")
        )

    with pytest.raises(CertificationRefused, match="sin"):
        certify_incremental(
            model._replace(structure=Structure(explicit=explicit)), params, dt=0.1
        )


def test_no_certificate_of_steps_is_given_for_a_flow_and_none_of_a_flow_for_steps():
    model, params = model_and_params("control_synth")
    assert is_incremental(model, params)
    assert contraction_metrics(model, params) == {}
    with pytest.raises(CertificationRefused, match="continuous flow"):
        certification.certify(model, params, (ENV_LOW, ENV_HIGH))
    ours, ours_params = model_and_params("sfkd")
    assert not is_incremental(ours, ours_params)
    assert not is_incremental(*model_and_params("neural_ode"))


def untrained(name="control_synth"):
    """Settings of a run with an untrained policy in its directory."""
    requested = settings("+experiment=smoke", f"model={name}")
    plant = build.build_vehicle(requested.vehicle)
    params = jit(build.build_model(requested.model, space(), plant).init)(
        jax.random.key(0)
    )
    saved = plain(requested) | {"space": build.space_to_settings(space())}
    runs.claim(requested)
    policy.save(requested.run_dir / "policy.safetensors", params, saved, made_from={})
    return requested


def test_the_door_writes_the_rate_apart_from_certificates_of_steps(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    requested = untrained()
    printed = certify.run(requested)
    file = tmp_path / printed["certificate"]
    document = json.loads(file.read_text())
    assert printed["valid"]
    assert (
        printed["alpha"] == document["alpha"] == np.exp(-0.1 * document["rate_per_s"])
    )
    assert [
        printed[name] for name in ("alpha_separate", "rho", "beta", "d_bar", "reason")
    ] == [None] * 5
    assert file.name == "incremental.json"
    assert not (file.parent / "certificate.json").exists()
    assert (
        policy.load(file.parent).certificate is None
    )  # nothing that a monitor could take for its bounds
    assert document["weights_sha256"] == policy.restore(file.parent).weights_sha256
    store.write_json(file, document | {"policy_sha256": "others"})
    with pytest.raises(CertificateStale, match="other weights"):
        certify.run(requested)
    assert stages.certify_policy(requested)["alpha"] == document["alpha"]
