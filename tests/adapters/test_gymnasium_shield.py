"""Agents in environments of gymnasium behind a shield, as random as agents may be."""

from functools import cache

import gymnasium
import numpy as np
import pytest

import sfkd_jax
from sfkd_jax import adapters
from sfkd_jax.info import Reason

STEPS = 120


@cache
def car():
    """A car in gymnasium behind the shield of the policy that ships."""
    policy = sfkd_jax.load("kinematic_path")
    adapters.register_gymnasium()
    settings = {"scenario": "s3", "duration": 20.0, "preview": 20}
    env = gymnasium.make("sfkd_jax/Vehicle-v0", **settings)
    return policy, adapters.GymnasiumShield(env, policy)


def test_an_agent_at_full_lock_is_kept_where_the_certificate_says():
    _, env = car()
    env.reset(seed=3)
    rng = np.random.default_rng(3)
    claimed = []
    for _ in range(STEPS):
        action = np.sign(rng.normal(size=2)).astype(np.float32)
        _, _, left, _, info = env.step(action)
        assert not left
        assert np.isfinite(info["claim"]) == (info["reason"] <= Reason.CERTIFIED)
        claimed.append(np.isfinite(info["claim"]))
        if claimed[-1]:
            assert info["lateral"] <= info["claim"] + 0.05
    assert info["intervention"] > 0.0


def test_what_has_passed_passes_again_unchanged():
    _, env = car()
    lock = np.asarray([1.0, 0.3], np.float32)
    env.reset(seed=4)
    *_, first = env.step(lock)
    assert first["intervention"] > 0.5
    passed = env.unwrapped.action(first["control"])
    env.reset(seed=4)
    *_, again = env.step(passed)
    assert again["intervention"] < 1e-4
    np.testing.assert_allclose(again["control"], first["control"], atol=1e-6)


def test_an_environment_that_cannot_say_where_it_is_is_refused():
    policy, _ = car()
    with pytest.raises(ValueError, match=r"a shield needs situation\(\)"):
        adapters.GymnasiumShield(gymnasium.make("Pendulum-v1"), policy)
