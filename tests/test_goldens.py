"""What ships does not change: controls of the policies along recorded episodes, and
the acceptance of their certificates. Recorded at 91241cc, along a path with the planners of this commit.
"""

from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import optimised

import sfkd_jax

RECORDED = Path(__file__).parent / "goldens" / "controls.npz"
PRETRAINED = Path(sfkd_jax.__file__).parent / "pretrained"
POLICIES = ("kinematic", "dynamic", "kinematic_path", "dynamic_path")


@pytest.fixture(scope="module")
def recorded():
    with np.load(RECORDED) as arrays:
        return dict(arrays)


@pytest.mark.parametrize("name", POLICIES)
def test_a_shipped_policy_is_certified_and_acts_as_recorded(name, recorded):
    policy = sfkd_jax.load(PRETRAINED / name)
    assert policy.certificate is not None
    act = optimised(policy.controller.act)
    for scenario in ("s1", "s2", "s3"):
        states, envs, references, controls = (
            recorded[f"{name}/{scenario}/{key}"] for key in "xeru"
        )
        memory = policy.controller.init(jax.random.key(7))
        acted = []
        for inputs in zip(states, envs, references, strict=True):
            control, memory, info = act(policy.params, memory, *inputs)
            assert bool(info.healthy)
            acted.append(np.asarray(control))
        assert act._cache_size() == 1  # states keep their types
        # Rounding differs between processors and compilers, and grows with the plan.
        np.testing.assert_allclose(np.stack(acted), controls, atol=2e-4)
