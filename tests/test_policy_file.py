"""The file of a policy: its hash, contradictions in it, its weights, and precision."""

import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from helpers import put, refusal_of

from sfkd_jax import policy, rollout, store
from sfkd_jax.certificate import read
from sfkd_jax.certification import CertificationRefused
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.corridor import verify_driving

POLICIES = ("kinematic", "dynamic", "kinematic_path", "dynamic_path")


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
    assert (
        policy.restore("kinematic").sha256
        == store.content_hash(manifest)
        not in changed
    )
    assert store.content_hash(manifest | {"sha256": "0" * 64}) not in {
        *changed,
        policy.restore("kinematic").sha256,
    }


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
    trained = policy.restore("kinematic_path")
    honest = read(
        policy.SHIPPED / "kinematic_path" / "certificate.json", DrivingCertificate
    )
    if holds:
        verify_driving(honest, trained)
        return
    with pytest.raises(CertificationRefused, match="does not follow from its witness"):
        verify_driving(honest, trained)


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
