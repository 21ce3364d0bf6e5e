"""A controller in the states of a system, from one in the coordinates of its frame."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control import Stateful
from sfkd_jax.info import ControllerInfo, PathInfo
from sfkd_jax.systems._tracking import Tracked
from sfkd_jax.types import Control, Controller, Environment, Key, Params, State


@dataclass(frozen=True, kw_only=True)
class Following(Stateful):
    """A controller that sees states and a reference, from one that sees ξ and ρ.

    The reference of a step consists of the states of the reference now and at the next
    sampling times, (horizon + 1, reference), in the order of `Tracking.followed`.

    Attributes:
        inner: its `act` takes ξ and ρ (horizon, inputs).
        tracked: the system in the coordinates of its frame.
    """

    inner: Controller
    tracked: Tracked

    def init(self, key: Key) -> object:
        """Return the state before the first control step."""
        return self.inner.init(key)

    def act(
        self,
        params: Params,
        state: object,
        observation: State,
        env: Environment,
        reference: Float[Array, "horizon_plus_1 reference"],
    ) -> tuple[Control, object, ControllerInfo]:
        """Take one control step."""
        tracked = self.tracked
        self._check(observation, env, reference)
        error = tracked.coordinates(observation, reference[0])
        rates = tracked.rates_between(reference)
        inputs = jax.vmap(tracked.inputs)(reference[:-1], rates)
        # A bound holds for what moves as the chains say; nobody can follow a jump.
        moves = jax.vmap(tracked.moves)(reference[:-1], rates, reference[1:])
        inputs = jnp.where(moves[:, None], inputs, jnp.nan)
        control, after, info = self.inner.act(params, state, error, env, inputs)
        path = PathInfo(xi=error, inputs=inputs[0], planned=info.plan.states)
        return control, after, info._replace(path=path)

    def _check(self, observation: State, env: Environment, reference: Array) -> None:
        """Raise a ValueError that names an argument of the wrong shape."""
        tracked = self.tracked
        names = tracked.names
        if jnp.shape(observation) != (len(names),):
            raise ValueError(
                f"observation must have shape ({len(names)},): {', '.join(names)}; "
                f"got {jnp.shape(observation)}"
            )
        entries = tuple(tracked.system.environment)
        if jnp.shape(env) != (len(entries),):
            raise ValueError(
                f"env must have shape ({len(entries)},): {', '.join(entries)}; "
                f"got {jnp.shape(env)}"
            )
        followed = tracked.frame.followed
        if jnp.ndim(reference) != 2 or jnp.shape(reference)[1] != len(followed):
            raise ValueError(
                f"reference must have shape (horizon + 1, {len(followed)}): "
                f"{', '.join(followed)}; got {jnp.shape(reference)}"
            )
