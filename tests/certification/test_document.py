"""Forged or stale certificates of a policy are refused in one line."""

import os
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import put, refusal_of
from jaxtyping import TypeCheckError

from sfkd_jax import policy, rollout, store
from sfkd_jax.certification import (
    CertificateStale,
    CertificationRefused,
    _schema,
    _verification,
    verify_document,
)
from sfkd_jax.certification._rules import Follows, Measured, Proved
from sfkd_jax.certification._verification import schema
from sfkd_jax.certification._weights import exported

POLICIES = ("kinematic", "dynamic", "kinematic_path", "dynamic_path")


@cache
def shipped(plant="kinematic"):
    return policy.restore(policy.SHIPPED / plant)


@cache
def honest(plant="kinematic"):
    return store.read_json(policy.SHIPPED / plant / "certificate.json")


@cache
def weights_of(plant):
    trained = shipped(plant)
    return exported(trained.model, trained.params)


def check(document, plant="kinematic"):
    try:
        verify_document(document, shipped(plant))
    # Under test, types are checked before anything is verified.
    except TypeCheckError as reason:
        raise CertificationRefused("of another type") from reason


def entries(rule, holder, key):
    """Every entry with a rule of its own: (rule, object or list that holds it, key)."""
    if isinstance(rule, dict | list):
        for inner in rule if isinstance(rule, dict) else range(len(rule)):
            yield from entries(rule[inner], holder[key], inner)
        return
    assert isinstance(rule, Proved | Follows | Measured)
    yield rule, holder, key


def forgeries(rule, holder, key):
    """What may not be accepted in place of an entry: (object, key, value)."""
    yield from [(holder, key, None)] if holder[key] is not None else []
    inner = holder, key
    # Of lists the last number.
    while isinstance(value := inner[0][inner[1]], list | dict) and value:
        inner = value, -1 if isinstance(value, list) else [*value][-1]
    others = [True, [], float("nan"), 1e300]
    others += [] if isinstance(value, str) else [f"{value}"]
    if not isinstance(value, int | float) or value is True:
        pass
    elif isinstance(rule, Measured):
        others += [-abs(value) - 1e-9] if np.min(rule.low) >= 0 else []
        others += [float(value), value + 0.5] if isinstance(value, int) else []
    elif isinstance(rule, Follows):
        others += [10 * value, 0.1 * value, 0, -value, float("inf")]
        others += [value * (1 + 3 * rule.tolerance) or 1e-9, float(value)]
    # A multiplier that proves as much is as good.
    else:
        others += [10 * value, 0.1 * value] if inner[0] is holder else [-value]
    yield from ((*inner, other) for other in others if repr(other) != repr(value))


@pytest.mark.parametrize("plant", POLICIES)
def test_what_ships_verifies_and_every_entry_has_a_class(plant):
    check(honest(plant), plant)
    document = {"": honest(plant)}
    rules = schema(document[""], shipped(plant), weights_of(plant))
    kinds = {type(rule) for rule, *_ in entries(rules, document, "")}
    assert kinds == {Proved, Follows, Measured}
    with pytest.raises(CertificationRefused, match="'extra' is not an entry"):
        check(document[""] | {"extra": 1.0}, plant)


@pytest.mark.parametrize("plant", ["kinematic", "dynamic_path"])
def test_no_forged_entry_is_accepted(plant, monkeypatch):
    """Each entry: changed in kind and size, left out, misspelt, swapped."""
    weights = weights_of(plant)
    digest = honest(plant)["params_sha256"]
    monkeypatch.setattr(_verification, "exported", lambda *_: weights)
    monkeypatch.setattr(_schema, "fingerprint", lambda *_: digest)
    document = {"": store.read_json(policy.SHIPPED / plant / "certificate.json")}
    rules = schema(document[""], shipped(plant), weights_of(plant))
    accepted, tried = [], Counter()

    def refused(named, kind):
        tried[kind] += 1
        try:
            check(document[""], plant)
        except (CertificationRefused, CertificateStale) as reason:
            accepted.extend([str(reason)] if "\n" in str(reason) else [])
        else:
            accepted.append((named, kind))

    for rule, holder, key in [*entries(rules, document, "")]:
        for inner, last, value in [*forgeries(rule, holder, key)]:
            before, inner[last] = inner[last], value
            refused(f"{key}.{last}", repr(value))
            inner[last] = before
        if not isinstance(holder, dict):
            continue
        before = holder.pop(key)
        refused(key, "left out")
        look_alike = key.replace("a", "\u0430").replace("o", "\u043e") + "\u200b"
        holder[look_alike] = before
        refused(key, "misspelt")
        del holder[look_alike]
        holder[key] = before
        other = next(reversed([one for one in holder if one != key]), key)
        if not isinstance(rule, Measured) and holder[other] != before:
            holder[key], holder[other] = holder[other], before
            refused(key, f"swapped with {other}")
            holder[key], holder[other] = before, holder[key]
    check(document[""], plant)
    assert accepted == []
    assert tried.total() > 400


# --- bound to everything that model and controller compute with -----------------------


def leaves(value, path=()):
    """Where the numbers, words and switches of nested settings lie."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in parts:
            yield from leaves(entry, (*path, str(key)))
    else:
        yield ".".join(path), value


def another(value):
    """A value of the same kind that is another one."""
    if isinstance(value, bool) or value is None:
        return not value
    return f"{value}_" if isinstance(value, str) else value * 1.01 + 1


@pytest.fixture
def copied(tmp_path):
    shutil.copytree(policy.SHIPPED / "kinematic", tmp_path / "run")
    return tmp_path / "run"


def test_the_hash_changes_with_every_single_setting():
    _, manifest = store.read_arrays(
        policy.SHIPPED / "kinematic" / "policy.safetensors", kind=policy.KIND
    )
    settings = dict(leaves(manifest["config"]))
    changed = {
        store.content_hash(
            manifest | {"config": put(manifest["config"], path, another(value))}
        )
        for path, value in settings.items()
    }
    assert len(settings) > 120
    assert len(changed) == len(settings)
    assert shipped().sha256 == store.content_hash(manifest) not in changed
    assert store.content_hash(manifest | {"sha256": "0" * 64}) not in {
        *changed,
        shipped().sha256,
    }


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("space.body_scale.0", 5.0),
        ("vehicle.mass", 1600.0),
        ("controller.cost.lateral", 2.0),
        ("model.transport", False),
    ],
)
def test_a_setting_that_changed_leaves_nothing_certified_and_says_so(
    copied, path, value
):
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    config = put(manifest["config"], path, value)
    store.write_arrays(file, arrays, kind=policy.KIND, config=config)
    with pytest.warns(
        UserWarning,
        match="nothing is certified; .* other weights or settings",
    ):
        loaded = policy.load(copied)
    assert loaded.certificate is None


def test_a_forged_certificate_is_an_error_that_names_the_file(copied):
    forged = put(honest(), "alpha", 0.5)
    store.write_json(copied / "certificate.json", forged)
    assert "certificate.json: " in refusal_of(lambda: policy.load(copied))


def test_the_reason_of_a_refusal_is_told_in_one_printable_line(copied):
    refused = {"valid": False, "reason": "no\nbound\x1b[31m"}
    store.write_json(copied / "certificate.json", refused)
    with pytest.warns(UserWarning, match=r"was refused: no bound\\x1b\[31m$"):
        policy.load(copied)


# --- settings that contradict each other ----------------------------------------------


def cut(table):
    """One grid point of a law instead of all."""
    return table[:1]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("space.body_scale.0", 0.0, "space.body_scale"),
        ("space.body_scale.0", 1e-30, "space.body_scale"),
        ("space.env_scale.1", -8.0, "space.env_scale"),
        ("vehicle.dt", 0.5, "vehicle.dt = 0.5 is not that of its law"),
        ("vehicle.dt", 0.15, "vehicle.dt = 0.15 is not that of its law"),
        ("dataset.law.speed", [0.0, 100.0], "its settings"),
        ("law/control", cut, "not of one grid"),
        ("law/gain", lambda table: table[..., :2], "not of one grid"),
        ("law/high", lambda table: -table, "axis without width"),
        ("law/perturbation", np.zeros_like, "no perturbation"),
        ("law/perturbation", lambda table: 300 * table, "its settings"),
        ("law/state", None, "not of one grid"),
    ],
)
def test_a_policy_that_contradicts_its_own_law_does_not_load(
    tmp_path, name, value, message
):
    """With hashes that are right."""
    shipping = policy.SHIPPED / "kinematic_path" / "policy.safetensors"
    arrays, manifest = store.read_arrays(shipping, kind=policy.KIND)
    config = manifest["config"]
    if name not in arrays:
        config = put(config, name, value)
    elif value is None:
        del arrays[name]
    else:
        arrays[name] = value(arrays[name])
    file = tmp_path / "policy.safetensors"
    store.write_arrays(file, arrays, kind=policy.KIND, config=config)
    assert message in refusal_of(lambda: policy.restore(tmp_path))


def test_a_sampling_period_that_is_not_that_of_the_data_does_not_load(copied):
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    config = put(manifest["config"], "vehicle.dt", 0.5)
    store.write_arrays(file, arrays, kind=policy.KIND, config=config)
    assert "is not that of its data" in refusal_of(lambda: policy.restore(copied))


def test_a_policy_with_a_shield_loads_with_one_or_if_asked_without(tmp_path):
    run = tmp_path / "run"
    shutil.copytree(policy.SHIPPED / "kinematic_path", run)
    (run / "certificate.json").unlink()
    line = refusal_of(lambda: policy.load(run))
    assert "controller.shield needs a certified corridor" in line
    assert "certificate.json is missing" in line
    bare = policy.restore(run).settings["controller"] | {"shield": False}
    with pytest.warns(UserWarning, match="nothing is certified"):
        assert policy.load(run, controller=bare).certificate is None


# --- precision ------------------------------------------------------------------------


def test_what_ships_loads_in_double_precision():
    code = "import sys, sfkd_jax; print(all(sfkd_jax.load(run).certificate for run in sys.argv[1:]))"
    command = [
        sys.executable,
        "-c",
        code,
        *(policy.SHIPPED / name for name in POLICIES),
    ]
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr[-2000:]


def ten_bits(array):
    """Factors as tensor cores read them, unless full precision is asked for."""
    bits = np.asarray(array, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 12)) & np.uint32(0xFFFFE000)).view(np.float32)


def on_tensor_cores(jaxpr, consts, *arguments):
    """Evaluate a program with products of `ten_bits`."""
    known = dict(
        zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True)
    )

    def read(variable):
        return variable.val if hasattr(variable, "val") else known[variable]

    for step in jaxpr.eqns:
        inputs, settings = [read(each) for each in step.invars], step.params
        inner = settings.get("jaxpr") or settings.get("call_jaxpr")
        if step.primitive.name in ("jit", "pjit", "custom_jvp_call"):
            outputs = on_tensor_cores(inner.jaxpr, inner.consts, *inputs)
        else:
            product = step.primitive.name == "dot_general"
            if product and "HIGHEST" not in str(settings["precision"]):
                inputs = [*map(ten_bits, inputs)]
            outputs = step.primitive.bind(*inputs, **settings)
            outputs = outputs if step.primitive.multiple_results else [outputs]
        known.update(zip(step.outvars, outputs, strict=True))
    return [read(each) for each in jaxpr.outvars]


@pytest.mark.parametrize(("full", "holds"), [(True, True), (False, False)])
def test_explicit_weights_ask_for_full_products(monkeypatch, full, holds):
    class Device:
        """jax on a device that rounds factors to ten bits."""

        def __getattr__(self, name):
            return getattr(jax, name)

        def jit(self, function, **_):
            def run(params):
                made, shape = jax.make_jaxpr(function, return_shape=True)(params)
                flat = on_tensor_cores(
                    made.jaxpr, made.consts, *jax.tree.leaves(params)
                )
                return jax.tree.unflatten(jax.tree.structure(shape), flat)

            return run

        def default_matmul_precision(self, name):
            return jax.default_matmul_precision(name if full else "bfloat16")

    monkeypatch.setattr(rollout, "jax", Device())
    if holds:
        check(honest("kinematic_path"), "kinematic_path")
        return
    with pytest.raises(CertificationRefused, match="does not follow from its witness"):
        check(honest("kinematic_path"), "kinematic_path")


# --- weights --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda leaf: leaf.astype(np.float64), "are float64"),
        (lambda leaf: leaf[..., :-1], "weights networks/operators are"),
        (lambda leaf: np.full_like(leaf, np.nan), "are not finite"),
        (lambda leaf: None, "weights networks/operators are missing"),
    ],
)
def test_weights_that_do_not_fit_the_model_are_refused_in_one_line(
    copied, spoil, message
):
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    changed = spoil(arrays.pop("networks/operators"))
    arrays |= {} if changed is None else {"networks/operators": changed}
    store.write_arrays(file, arrays, kind=policy.KIND, config=manifest["config"])
    line = refusal_of(lambda: policy.load(copied))
    assert message in line
    assert "policy.safetensors" in line


def test_a_certificate_of_one_policy_is_stale_beside_another():
    with pytest.raises(CertificateStale):
        check(honest("dynamic"), "kinematic")
    forged = honest("dynamic") | {"policy_sha256": shipped("kinematic").sha256}
    with pytest.raises(CertificationRefused, match="weights_sha256 does not follow"):
        check(forged, "kinematic")


def test_one_weight_that_moved_by_the_smallest_step_is_noticed():
    trained = shipped()
    leaf = trained.params["networks"]["operators"]
    nudged = leaf.at[0, 0, 0].set(jnp.nextafter(leaf[0, 0, 0], jnp.inf))
    params = trained.params | {
        "networks": trained.params["networks"] | {"operators": nudged}
    }
    assert jax.tree.structure(params) == jax.tree.structure(trained.params)
    with pytest.raises(CertificationRefused, match="params_sha256 does not follow"):
        verify_document(honest(), replace(trained, params=params))
