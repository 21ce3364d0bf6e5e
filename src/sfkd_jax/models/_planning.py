"""What planners roll out in place of a certified model: its steps with a residual."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import PATH_SPEED, PathState, compose, path_state
from sfkd_jax.models._continuous import state_model
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

FREE = 2
"""Entries of a control that differ by sample; along a path κ and v_ref follow."""
HIDDEN = 64
"""Hidden width of g in the frame of the car; along a known road half of it is enough."""
WIDTH = 64
"""Width of the network that gives the weights of g."""
SCALE = 0.005
"""Of M, N, m and V: g is small."""


class Residual(NamedTuple):
    """(s, ν) ↦ P s + N ν + p + V tanh(W s + U ν + c), with the rows of both joined.

    States are (s, 1): a vector that all samples share, added to one of each of them,
    would turn the arrays of all samples around.
    """

    of_state: Float[Array, "row state_plus_1"]  # (P, p), (W, c)
    of_control: Float[Array, "row control"]  # N, U
    V: Float[Array, "out hidden"]

    def __call__(
        self, state: Float[Array, " state_plus_1"], control: Float[Array, " control"]
    ) -> Float[Array, " out"]:
        """Return its value."""
        # Two products, since joining the inputs would copy those of every sample.
        rows = self.of_state @ state + self.of_control @ control
        direct, hidden = jnp.split(rows, [self.V.shape[0]])
        return direct + self.V @ jnp.tanh(hidden)


class PlanningFiber(NamedTuple):
    """The fiber of F and g; of g weights and e, as long as its road is not known."""

    certified: Fiber
    residual: Any


@dataclass(frozen=True, eq=False)
class Planning:
    """F with a residual g of no bound, for planners alone.

        x⁺ = D F(Φ(x), u; e) + g,   g = M s + N ν + m + V tanh(W s + U ν + c)

    It goes back to the state at every step. A network of e, and along a path of κ and
    v_ref, gives M to c, which all samples of a plan share. Along a path they share F as
    well, linearised where a car on the path would be: of each sample one small layer is
    left.

    Attributes:
        certified: F.
        space: its scales.
        environment: whether e is read.
    """

    certified: Model
    space: Space
    environment: bool

    @property
    def _hidden(self) -> int:
        """Width of g."""
        return HIDDEN // 2 if self.certified.along_path else HIDDEN

    @property
    def _sizes(self) -> tuple[int, list[int]]:
        """Number of inputs of g, and the ends of its parts in the table."""
        body = self.space.body_mean.shape[0]
        # Along a path there is no pose: that of the start stays.
        inputs = body + FREE
        out = body + 3 * (not self.certified.along_path)
        parts = out * (inputs + 1), self._hidden * (inputs + 1), out * self._hidden
        return inputs, list(accumulate(parts))

    @property
    def _network(self) -> nn.Sequential:
        """The network of e and the road, whose g is zero at first."""
        inputs, (affine, hidden, size) = self._sizes

        def start(key: Key, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
            # W, U and c alone: with V at zero as well, g would have no gradient.
            drawn = jax.random.normal(key, shape, dtype) / inputs**0.5
            rows = jnp.arange(size)
            return jnp.where((rows >= affine) & (rows < hidden), drawn, 0.0)

        layers = [nn.Dense(WIDTH), nn.tanh, nn.Dense(WIDTH), nn.tanh]
        last = nn.Dense(size, kernel_init=nn.initializers.zeros, bias_init=start)
        return nn.Sequential([*layers, last])

    def init(self, key: Key) -> Params:
        """Draw parameters of F, and those of g as its entry "planning"."""
        road = self.space.control_mean[FREE:].shape[0]
        reads = jnp.zeros(road + self.space.env_mean.shape[0])
        # Another stream: those of F are drawn as without it.
        added = self._network.init(jax.random.fold_in(key, 2), reads)["params"]
        return {**self.certified.init(key), "planning": added}

    def fiber(self, params: Params, env: Environment) -> PlanningFiber:
        """Return the fiber of F, and g or, before a road is known, what gives it."""
        scaled = self.space.scaled_env(env, self.environment)
        known = unfold(params)["planning"], scaled
        residual = known if self.certified.along_path else self._residual(*known)
        return PlanningFiber(self.certified.fiber(params, env), residual)

    def step(self, fiber: PlanningFiber, state: State, control: Control) -> State:
        """Advance the state, or (ξ, 1) along a path, by one sampling period."""
        nu = control[:FREE]
        g = fiber.residual
        if not self.certified.along_path:
            after = self._certified(fiber, state, control)
            added = g(jnp.append(state[BODY], 1.0), nu)
            pose = compose(after[POSE], added[POSE])
            return jnp.concatenate([pose, after[BODY] + added[BODY]])
        if isinstance(g, Residual):
            return g(state, nu)
        # Of a single step a product with the tangent is less work than the tangent.
        certified, at = self._on_path(fiber, road := control[FREE:])
        before, change = jax.jvp(certified, at, (state[:-1] - at[0], nu))
        weights, env = g
        added = self._residual(weights, env, road)(state, nu)
        return jnp.append(before + change + added, 1.0)

    def on_road(self, fiber: PlanningFiber, road: Control) -> PlanningFiber:
        """Return the fiber of steps on a road, with F in the affine part of g."""
        certified, at = self._on_path(fiber, road)
        weights, env = fiber.residual
        A, B = jax.jacfwd(certified, (0, 1))(*at)
        offset = certified(*at) - A @ at[0]
        g = self._residual(weights, env, road)
        size = A.shape[0]
        # The entry 1 stays.
        one = jnp.eye(size + 1)[-1:]
        affine = jnp.column_stack([A, offset]) + g.of_state[:size]
        residual = Residual(
            jnp.vstack([affine, one, g.of_state[size:]]),
            jnp.vstack([B + g.of_control[:size], 0 * B[:1], g.of_control[size:]]),
            jnp.vstack([g.V, 0 * g.V[:1]]),
        )
        return fiber._replace(residual=residual)

    def _on_path(self, fiber: PlanningFiber, road: Control) -> tuple[Any, Any]:
        """F on a road as (ξ, ν) ↦ ξ⁺, and ξ and ν of a car on the path."""

        def certified(xi: PathState, nu: Control) -> PathState:
            return self._certified(fiber, path_state(xi), jnp.append(nu, road))[BODY]

        xi = jnp.zeros(self.space.body_mean.shape[0]).at[PATH_SPEED].set(road[1])
        return certified, (xi, jnp.zeros(FREE))

    def model(self) -> Model:
        """Return F, in place of which planners roll out F + g."""
        size = 3 + self.space.body_mean.shape[0]
        F = self.certified
        planning = state_model(self.init, self.fiber, self.step, state_size=size)
        planning = planning._replace(shared=F.shared, along_path=F.along_path)
        if F.along_path:
            planning = planning._replace(
                encode=lambda fiber, state: jnp.append(state[BODY], 1.0),
                decode=lambda fiber, latent: path_state(latent[:-1]),
                observe=lambda fiber, latent, state: jnp.append(state[BODY], 1.0),
                vector=lambda latent: latent[:-1],
                on_road=self.on_road,
            )
        return F._replace(init=self.init, planning=planning)

    def _certified(self, fiber: PlanningFiber, state: State, control: Control) -> State:
        """One step of F, from a state to a state."""
        own = fiber.certified
        latent = self.certified.encode(own, state)
        return self.certified.decode(own, self.certified.step(own, latent, control))

    def _residual(
        self, weights: Params, env: Environment, road: Control | None = None
    ) -> Residual:
        """Return g of scaled e and a road, in the units of states and controls."""
        space = self.space
        inputs, ends = self._sizes
        reads = env
        if road is not None:
            mean = space.control_mean[FREE:]
            scale = space.control_scale[FREE:]
            reads = jnp.append((road - mean) / scale, env)
        table = cast(Array, self._network.apply({"params": weights}, reads))
        affine, hidden, out = jnp.split(table, ends[:-1])
        affine, hidden = (part.reshape(-1, inputs + 1) for part in (affine, hidden))
        mean = jnp.append(space.body_mean, space.control_mean[:FREE])
        scale = jnp.append(space.body_scale, space.control_scale[:FREE])
        units = jnp.asarray(space.body_scale)
        if not self.certified.along_path:
            units = jnp.append(space.increment_scale, units)
        units = SCALE * units[:, None]
        # Inputs in their own units: a rollout scales none of its own.
        rows = jnp.vstack([units * affine, hidden])
        gains = rows[:, :-1] / scale
        of_state, of_control = jnp.split(gains, [space.body_mean.shape[0]], axis=1)
        offset = rows[:, -1] - gains @ mean
        V = units * out.reshape(-1, self._hidden)
        return Residual(jnp.column_stack([of_state, offset]), of_control, V)
