"""The nominal model of a shield, and its comparison with a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._safety_filter import Rows, size_of
from sfkd_jax.geometry import without_pose
from sfkd_jax.rollout import fold
from sfkd_jax.types import BODY, Environment, Fiber, Key, Latent, Model, Params, State


class NominalState(NamedTuple):
    """A nominal model between two control steps.

    Attributes:
        latent: ẑ, in the fibre of `env`; 0 before the start.
        started: whether it is running. Otherwise it starts anew at the next
            measurement.
        env: e of the last step, in its box; NaN before the first one.
    """

    latent: Latent
    started: Bool[Array, ""]
    env: Environment


class Nominal(NamedTuple):
    """A nominal model in the fibre of the current environment.

    Attributes:
        latent: ẑ.
        fiber: of e.
        state: ξ̂.
    """

    latent: Latent
    fiber: Fiber
    state: State


class Comparison(NamedTuple):
    """A nominal model beside a measurement.

    Attributes:
        nominal: at the measurement if the nominal model starts anew.
        distance: |y − ŷ| of each output, before it starts anew; NaN without a
            comparison.
        exceeded: whether a distance is larger than what is allowed.
        starts: whether the nominal model starts anew, because it was stopped or its
            distance is too large. What follows is then about another nominal model.
    """

    nominal: Nominal
    distance: Float[Array, " output"]
    exceeded: Bool[Array, ""]
    starts: Bool[Array, ""]


@dataclass(frozen=True, eq=False)
class NominalModel:
    """A model that is driven with the inputs of a system, without correction.

    Attributes:
        model: of the closed loop.
        outputs: entries of a state that are each output; |y| is their 2-norm.
    """

    model: Model
    outputs: Sequence[Rows]

    def init(self, key: Key, states: int, environments: int) -> NominalState:
        """Return a nominal model that was never started.

        Args:
            key: random key of the weights, of which only the shapes are used.
            states: number of entries of ξ.
            environments: number of entries of e.
        """

        def encode(params: Params) -> Latent:
            fiber = self.model.fiber(params, jnp.zeros(environments))
            return self.model.encode(fiber, without_pose(jnp.zeros(states)))

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, jax.eval_shape(self.model.init, key))
        return NominalState(
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent),
            started=jnp.asarray(False),
            env=jnp.full(environments, jnp.nan, dtype=float),
        )

    def carried(
        self, params: Params, before: NominalState, env: Environment
    ) -> Nominal:
        """Return the nominal model in the fibre of e, which may have switched."""
        model = self.model
        folded = fold(model, params)
        fiber = model.fiber(folded, env)

        def unchanged() -> Latent:
            return before.latent

        def transported() -> Latent:
            old = model.fiber(folded, before.env)
            return model.transport(old, fiber, before.latent)

        same = jnp.all(env == before.env)
        latent = jax.lax.cond(same, unchanged, transported)
        return Nominal(latent, fiber, model.decode(fiber, latent)[BODY])

    def compare(
        self,
        nominal: Nominal,
        state: State,
        allowed: Float[Array, " output"],
        *,
        started: Bool[Array, ""],
        measured: Bool[Array, ""],
    ) -> Comparison:
        """Compare the nominal model with a measurement, and start it if need be.

        Args:
            nominal: from `carried`.
            state: ξ as measured.
            allowed: largest |y − ŷ| of each output.
            started: whether the nominal model is running.
            measured: whether the outputs are measured.
        """
        model = self.model
        sizes = [size_of(state - nominal.state, rows) for rows in self.outputs]
        distance = jnp.stack(sizes)
        compared = started & measured
        # Written so that a distance of NaN exceeds the bound.
        exceeded = compared & ~jnp.all(distance <= allowed)
        starts = ~started | exceeded
        anchor = model.encode(nominal.fiber, without_pose(state))
        latent = jax.tree.map(partial(jnp.where, starts), anchor, nominal.latent)
        now = model.decode(nominal.fiber, latent)[BODY]
        return Comparison(
            nominal=Nominal(latent, nominal.fiber, now),
            distance=jnp.where(compared, distance, jnp.nan),
            exceeded=exceeded,
            starts=starts,
        )
