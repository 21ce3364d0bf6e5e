"""The shield of a policy as a wrapper of gymnasium, around whatever acts."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.info import ControllerInfo, Reason
from sfkd_jax.policy import Policy, SystemPolicy
from sfkd_jax.types import Control, Controller, Environment, State


class GymnasiumShield(gymnasium.Wrapper):
    """An environment whose actions pass the shield of a policy.

    The agent, such as one of stable-baselines, sees an environment like the one inside.
    What it does passes unchanged, or as far as the certified bounds allow.

    `info` gains "control", which acted, "intervention", the share of the request that
    was removed, "claim", the bounds of the outputs that hold in this step or NaN, and
    "reason", which says why there is none, see `Reason`.

    Args:
        env: the environment. It, or a wrapper inside, has three methods: `situation()`
            returns (state, e, reference) as the policy's controller takes them,
            `control(action)` the control that an action is, and `action(control)` the
            reverse. `GymnasiumVehicle` has them.
        policy: with a certificate.

    Raises:
        ValueError: the environment lacks one of these methods, or the policy has no
            certified bounds.
    """

    def __init__(self, env: gymnasium.Env, policy: Policy | SystemPolicy) -> None:
        super().__init__(env)
        for name in ("situation", "control", "action"):
            if not env.has_wrapper_attr(name):
                raise ValueError(
                    f"a shield needs {name}() of the environment, see GymnasiumShield"
                )
        # Nothing of a shield is random.
        self._start = policy.shield(_requesting(jnp.zeros(0))).init(jax.random.key(0))
        self._shield_state = self._start

        @jax.jit
        def filtered(
            shield_state: Any,
            request: Control,
            state: State,
            env: Environment,
            reference: Any,
        ) -> tuple[Control, Any, ControllerInfo]:
            shield = policy.shield(_requesting(request))
            return shield.act(policy.params, shield_state, state, env, reference)

        self._filtered = filtered

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the nominal model starts at its first state."""
        self._shield_state = self._start
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Simulate one sampling period with what passes of an action."""
        request = self.env.get_wrapper_attr("control")(action)
        control, self._shield_state, about = self._filtered(
            self._shield_state,
            jnp.asarray(request, float),
            *self.env.get_wrapper_attr("situation")(),
        )
        passed = self.env.get_wrapper_attr("action")(np.asarray(control))
        seen, reward, terminated, truncated, info = self.env.step(passed)
        shield = {
            "control": np.asarray(control),
            "intervention": float(about.shield.intervention),
            "claim": np.asarray(about.claim.bound),
            "reason": Reason(int(about.claim.reason)),
        }
        return seen, reward, terminated, truncated, {**info, **shield}


def _requesting(request: Control) -> Controller:
    """Return a controller that asks for one control."""
    return Controller(
        lambda key: (),
        lambda params, state, observation, env, reference: (
            request,
            state,
            ControllerInfo(),
        ),
    )
