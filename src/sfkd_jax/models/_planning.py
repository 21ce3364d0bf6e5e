"""The model that planners roll out: the steps of the certified one with a residual."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple, TypeAlias, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import compose, without_pose
from sfkd_jax.models._state_model import state_model
from sfkd_jax.rollout import unfold
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Fiber,
    Key,
    Model,
    Params,
    Space,
    State,
)

HIDDEN = 64
"""Hidden width of g without a reference; around a known one half is enough."""
WIDTH = 64
"""Width of the network that gives the weights of g."""
SCALE = 0.005
"""Factor of M, N, m and V, because g is small."""
BodyState: TypeAlias = Float[Array, " body"]


class Residual(NamedTuple):
    """(s, ν) ↦ P s + N ν + p + V tanh(W s + U ν + c), with the rows of both joined.

    States are (s, 1). If a vector that all samples share were added to a vector of each
    sample instead, XLA would transpose the arrays of all samples.

    Attributes:
        of_state: (P, p) above (W, c).
        of_control: N above U.
        V: output weights.
    """

    of_state: Float[Array, "row state_plus_1"]
    of_control: Float[Array, "row control"]
    V: Float[Array, "out hidden"]

    def __call__(
        self, state: Float[Array, " state_plus_1"], control: Float[Array, " control"]
    ) -> Float[Array, " out"]:
        """Return the value at (s, 1) and ν."""
        # Two products, since joining the inputs would copy the inputs of every sample.
        rows = self.of_state @ state + self.of_control @ control
        direct, hidden = jnp.split(rows, [self.V.shape[0]])
        return direct + self.V @ jnp.tanh(hidden)


class PlanningFiber(NamedTuple):
    """The fiber of F and g.

    Attributes:
        certified: of F.
        residual: g; if it depends on ρ, before ρ is known, weights and scaled e that
            determine it.
    """

    certified: Fiber
    residual: Any


@dataclass(frozen=True, eq=False)
class Planning:
    """F with a residual g that has no bound, for planners alone.

        x⁺ = D F(Φ(x), u; e) + g,   g = M s + N ν + m + V tanh(W s + U ν + c)

    The model returns to the state at every step. A network of e and ρ gives M to c,
    which all samples of a plan share. In a frame with a reference they also share F,
    linearised at a system that follows it, so one small layer is left for each sample.

    Attributes:
        certified: F.
        space: its scales.
        environment: whether e is read.
    """

    certified: Model
    space: Space
    environment: bool

    @property
    def _free(self) -> int:
        """Number of entries of a control that differ between samples, before ρ."""
        return self.space.control_mean.shape[0] - self.certified.frame.inputs

    @property
    def _hidden(self) -> int:
        """Hidden width of g."""
        return HIDDEN // 2 if self.certified.frame.inputs else HIDDEN

    @property
    def _sizes(self) -> tuple[int, list[int]]:
        """Number of inputs of g, and the ends of its parts in the network's outputs."""
        body = self.space.body_mean.shape[0]
        pose = 3 if self.certified.frame.has_pose else 0
        inputs = body + self._free
        outputs = body + pose
        affine = outputs * (inputs + 1)
        hidden = self._hidden * (inputs + 1)
        return inputs, list(accumulate([affine, hidden, outputs * self._hidden]))

    @property
    def _network(self) -> nn.Sequential:
        """The network of ρ and e. Its initial g is 0."""
        inputs, (affine_end, hidden_end, size) = self._sizes

        def start(key: Key, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
            # W, U and c are not 0: with V they would otherwise have no gradient.
            drawn = jax.random.normal(key, shape, dtype) / inputs**0.5
            rows = jnp.arange(size)
            return jnp.where((rows >= affine_end) & (rows < hidden_end), drawn, 0.0)

        layers = [nn.Dense(WIDTH), nn.tanh, nn.Dense(WIDTH), nn.tanh]
        last = nn.Dense(size, kernel_init=nn.initializers.zeros, bias_init=start)
        return nn.Sequential([*layers, last])

    def init(self, key: Key) -> Params:
        """Draw parameters of F, and those of g as its entry "planning"."""
        inputs = jnp.zeros(self.certified.frame.inputs + self.space.env_mean.shape[0])
        # From another key, so that the parameters of F are those without g.
        planning = self._network.init(jax.random.fold_in(key, 2), inputs)["params"]
        return {**self.certified.init(key), "planning": planning}

    def fiber(self, params: Params, env: Environment) -> PlanningFiber:
        """Return the fiber of F and g, see `PlanningFiber`."""
        scaled = self.space.scaled_env(env, self.environment)
        weights = unfold(params)["planning"]
        if self.certified.frame.inputs:
            residual = (weights, scaled)
        else:
            residual = self._residual(weights, scaled)
        return PlanningFiber(self.certified.fiber(params, env), residual)

    def step(self, fiber: PlanningFiber, state: State, control: Control) -> State:
        """Advance the state, or (s, 1) around a reference, by one sampling period."""
        nu = control[: self._free]
        g = fiber.residual
        if not self.certified.frame.inputs:
            after = self._certified(fiber, state, control)
            added = g(jnp.append(state[BODY], 1.0), nu)
            pose = compose(after[POSE], added[POSE])
            return jnp.concatenate([pose, after[BODY] + added[BODY]])
        if isinstance(g, Residual):
            return g(state, nu)
        # For a single step, a product with the derivative is less work than the
        # derivative itself.
        rho = control[self._free :]
        certified, at = self._on_reference(fiber, rho)
        before, change = jax.jvp(certified, at, (state[:-1] - at[0], nu))
        weights, env = g
        added = self._residual(weights, env, rho)(state, nu)
        return jnp.append(before + change + added, 1.0)

    def on_reference(self, fiber: PlanningFiber, rho: Control) -> PlanningFiber:
        """Return the fiber of steps with inputs ρ, with F in the affine part of g."""
        certified, at = self._on_reference(fiber, rho)
        weights, env = fiber.residual
        A, B = jax.jacfwd(certified, (0, 1))(*at)
        offset = certified(*at) - A @ at[0]
        g = self._residual(weights, env, rho)
        size = A.shape[0]
        # One more row keeps the last entry of (s, 1) at 1.
        last_row = jnp.eye(size + 1)[-1:]
        affine = jnp.column_stack([A, offset]) + g.of_state[:size]
        residual = Residual(
            of_state=jnp.vstack([affine, last_row, g.of_state[size:]]),
            of_control=jnp.vstack(
                [B + g.of_control[:size], 0 * B[:1], g.of_control[size:]]
            ),
            V=jnp.vstack([g.V, 0 * g.V[:1]]),
        )
        return fiber._replace(residual=residual)

    def _on_reference(self, fiber: PlanningFiber, rho: Control) -> tuple[Any, Any]:
        """Return F at ρ as (s, ν) ↦ s⁺, and s and ν of a system on its reference."""

        def certified(body: BodyState, nu: Control) -> BodyState:
            return self._certified(fiber, without_pose(body), jnp.append(nu, rho))[BODY]

        size = self.space.body_mean.shape[0]
        body = self.certified.frame.following(rho, size)
        return certified, (body, jnp.zeros(self._free))

    def model(self) -> Model:
        """Return F, in place of which planners roll out F + g."""
        size = 3 + self.space.body_mean.shape[0]
        F = self.certified
        planning = state_model(self.init, self.fiber, self.step, state_size=size)
        planning = planning._replace(shared=F.shared, frame=F.frame)
        if F.frame.inputs:
            planning = planning._replace(
                encode=_encode,
                decode=_decode,
                observe=_observe,
                vector=_vector,
                on_reference=self.on_reference,
            )
        return F._replace(init=self.init, planning=planning)

    def _certified(self, fiber: PlanningFiber, state: State, control: Control) -> State:
        """Return the state after one step of F."""
        F = self.certified
        latent = F.encode(fiber.certified, state)
        return F.decode(fiber.certified, F.step(fiber.certified, latent, control))

    def _residual(
        self, weights: Params, env: Environment, rho: Control | None = None
    ) -> Residual:
        """Return g in the units of states and controls.

        Args:
            weights: of the network.
            env: scaled e.
            rho: inputs from the reference; None in a frame without them.
        """
        space = self.space
        inputs, ends = self._sizes
        network_inputs = env
        if rho is not None:
            mean = space.control_mean[self._free :]
            scale = space.control_scale[self._free :]
            network_inputs = jnp.append((rho - mean) / scale, env)
        outputs = self._network.apply({"params": weights}, network_inputs)
        affine, hidden, last = jnp.split(cast(Array, outputs), ends[:-1])
        affine = affine.reshape(-1, inputs + 1)
        hidden = hidden.reshape(-1, inputs + 1)
        mean = jnp.append(space.body_mean, space.control_mean[: self._free])
        scale = jnp.append(space.body_scale, space.control_scale[: self._free])
        units = jnp.asarray(space.body_scale)
        if self.certified.frame.has_pose:
            units = jnp.append(space.increment_scale, units)
        units = SCALE * units[:, None]
        # The inputs of g are in physical units, so that a rollout scales none.
        rows = jnp.vstack([units * affine, hidden])
        gains = rows[:, :-1] / scale
        of_state, of_control = jnp.split(gains, [space.body_mean.shape[0]], axis=1)
        offset = rows[:, -1] - gains @ mean
        return Residual(
            of_state=jnp.column_stack([of_state, offset]),
            of_control=of_control,
            V=units * last.reshape(-1, self._hidden),
        )


def _encode(fiber: PlanningFiber, state: State) -> Float[Array, " _"]:
    """Return (s, 1)."""
    return jnp.append(state[BODY], 1.0)


def _decode(fiber: PlanningFiber, latent: Float[Array, " _"]) -> State:
    """Return the state of (s, 1)."""
    return without_pose(latent[:-1])


def _observe(
    fiber: PlanningFiber, latent: Float[Array, " _"], state: State
) -> Float[Array, " _"]:
    """Return (s, 1) of a state."""
    return _encode(fiber, state)


def _vector(latent: Float[Array, " _"]) -> BodyState:
    """Return s."""
    return latent[:-1]
