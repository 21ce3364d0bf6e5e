"""Files with changed bytes or values are refused in one line, or mean the same."""

import copy
import json
import random
import shutil
import warnings

import numpy as np
import pytest
from helpers import refusal_of

from sfkd_jax import demo, policy, store

SHIPPED = demo.SHIPPED / "kinematic"
WORSE = (None, "word", [], {}, -1, [[1, 2], 3], True, 1e300)
"""What a value of a document is replaced by."""


@pytest.fixture
def run(tmp_path):
    shutil.copytree(SHIPPED, tmp_path / "run")
    return tmp_path / "run"


def leaves(document, path=()):
    """Where every value of a document is; of a list of numbers only the first."""
    items = (
        document.items()
        if isinstance(document, dict)
        else enumerate(document[:2])
        if isinstance(document, list)
        else ()
    )
    for key, value in items:
        yield (*path, key)
        yield from leaves(value, (*path, key))


def spoiled(document, path, value):
    changed = copy.deepcopy(document)
    node = changed
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    return changed


def accepted(run):
    """Load a policy: its certificate, None without one, or the line of a refusal."""
    loaded = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        line = refusal_of(lambda: loaded.append(policy.load(run)))
    return line if line is not None else loaded[0].certificate


def test_bytes_of_a_policy_and_its_certificate(run):
    """Either file, changed or cut anywhere, is refused or certifies the same."""
    honest, draw = policy.load(run).certificate, random.Random(1)
    for name in ("policy.safetensors", "certificate.json"):
        whole = (run / name).read_bytes()
        for case in range(12):
            place = draw.randrange(len(whole))
            content = bytearray(whole)
            content[place] ^= 1 << draw.randrange(7)
            content = whole[:place] if case % 3 == 0 else bytes(content)
            (run / name).write_bytes(content)
            outcome = accepted(run)
            if isinstance(outcome, str):
                assert name in outcome or "certificate" in outcome
            elif outcome is not None:
                # A text that nothing is concluded from, such as a date.
                assert outcome["alpha"] == honest["alpha"]
        (run / name).write_bytes(whole)


def test_values_of_a_certificate(run):
    """No value gone or of another kind makes a stronger claim."""
    document = json.loads((run / "certificate.json").read_bytes())
    places, draw = list(leaves(document)), random.Random(2)
    for path in draw.sample(places, 25):
        changed = spoiled(document, path, draw.choice(WORSE))
        (run / "certificate.json").write_text(json.dumps(changed))
        outcome = accepted(run)
        if isinstance(outcome, dict):
            assert outcome["alpha"] == document["alpha"]


def test_values_of_the_settings_of_a_policy(run):
    """Settings that were exchanged together with their hash certify nothing."""
    file = run / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    places, draw = list(leaves(manifest["config"])), random.Random(3)
    for path in draw.sample(places, 15):
        config = spoiled(manifest["config"], path, draw.choice(WORSE))
        if config == manifest["config"]:
            continue
        store.write_arrays(file, arrays, kind=policy.KIND, config=config)
        outcome = accepted(run)
        assert outcome is None or isinstance(outcome, str)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite(run, value):
    file = run / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    name = sorted(arrays)[0]
    arrays[name] = np.full_like(arrays[name], value)
    store.write_arrays(file, arrays, kind=policy.KIND, config=manifest["config"])
    assert f"weights {name} are not finite" in accepted(run)
