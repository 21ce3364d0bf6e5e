"""Everything that SFKD learns besides its encoder, as one flax module."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._networks import SMALL, Sandwich, Weights, bounded
from sfkd_jax.models.sfkd._residual import separate_budget, share_budget
from sfkd_jax.types import Scalar

LOWEST_RATE = 0.5
"""Smallest learned α: no closed loop converges faster than that in 0.1 s."""
ALPHA_START = 2.0
"""Initial logit of a learned α: 88 % of the way from the smallest to the largest."""


class SharedWeights(NamedTuple):
    """Weights that do not depend on e, with every bound enforced.

    Attributes:
        vertices: A_j.
        residual: of the network r.
        decoder: of the network D.
        forcing: V in a tuple, or ().
        readout: C.
        centre: c.
        lift: C⁻¹ where z is the state in other coordinates; None where φ lifts.
    """

    vertices: Float[Array, "vertex rank rank"]
    residual: Weights
    decoder: Weights
    forcing: tuple[Float[Array, "_ _"], ...]
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]
    lift: Float[Array, "rank body"] | None

    @property
    def ends(self) -> tuple[list[int], list[int]]:
        """Rows at which the layers end in both tables of `PerEnvironment`."""
        decoder = self.decoder.matrices
        rank = self.readout.shape[1]
        hidden = (*self.residual.matrices[:-1], *decoder[:-1])
        hidden_ends = list(accumulate(map(len, hidden)))
        decoder_outputs = 3 if decoder else 0
        return hidden_ends, [rank, rank + decoder_outputs]


class PerEnvironment(NamedTuple):
    """Functions of e.

    Biases are gain(e) u + offset(e), in two tables. The first one has the biases before
    a tanh: of residual, decoder and forcing. The second one has those of outputs: of
    the residual with B(e) u, of the decoder, and the logits of the mixture.

    Attributes:
        mixture: w; None if its logits are in the second table.
        gains: of both tables.
        offsets: of both tables.
        tangents: of the rotation Q(e), see `rotate_planes`.
        embedding: ψ(e).
    """

    mixture: Float[Array, " vertex"] | None
    gains: tuple[Float[Array, "_ control"], ...]
    offsets: tuple[Float[Array, " _"], ...]
    tangents: Float[Array, " plane"]
    embedding: Float[Array, " embedding"]


class Learned(nn.Module):
    """Embedding ψ(e), operators, residual, decoder and transport; fields as of `sfkd`.

    Attributes:
        rank: r.
        body: size of s.
        control: size of u.
        embedding: size of ψ(e).
        pose: whether there is a decoder of the pose.
        transport: whether Q(e) is learned; otherwise it is the identity.
        residual_class: module of the residual, see `RESIDUALS`.
        joint: whether operators and residual are bounded as one map by α = ρ + β;
            otherwise A(e) is bounded by ρ and the residual by β.
        state_lift: whether z is the state, z = C⁻¹ (s − c); then rank = body.
        scheduled: whether the mixture of the vertices reads u as well as e.
    """

    rank: int
    body: int
    control: int
    embedding: int
    pose: bool
    transport: bool
    vertices: int
    residual_hidden: Sequence[int]
    decoder_hidden: Sequence[int]
    rho: float
    beta: float
    residual_class: type[Any] | None
    joint: bool
    learn_alpha: bool
    forcing_hidden: int
    state_lift: bool
    scheduled: bool

    def setup(self) -> None:
        """Declare submodules and parameters; stored policies have these names."""
        layers = [nn.Dense(64), nn.tanh, nn.Dense(64), nn.tanh]
        self.psi = nn.Sequential([*layers, nn.Dense(self.embedding), nn.tanh])
        # With small weights of its head, e has little influence at the start.
        logits = self.vertices
        if self.scheduled:
            logits = self.vertices * (1 + self.control)
        self.mixture_head = nn.Dense(logits, kernel_init=SMALL)
        self.input_head = nn.Dense(self.rank * self.control)
        # A state with one entry has no plane, but no layer may be empty.
        self.tangent_head = nn.Dense(max(self.rank // 2, 1), kernel_init=SMALL)
        # Every bias has a gain for each control, and an offset.
        entries = self.control + 1
        # Only the biases of networks depend on e, so one bound holds for all e.
        if self.residual_class is not None:
            self.residual_weights = self.residual_class(
                self.rank, self.residual_hidden, self.rank
            )
            self.residual_head = nn.Dense(
                (sum(self.residual_hidden) + self.rank) * entries, kernel_init=SMALL
            )
        if self.pose:
            # The three outputs are the increment of the pose.
            self.decoder_weights = Sandwich(self.rank, self.decoder_hidden, 3)
            self.decoder_head = nn.Dense((sum(self.decoder_hidden) + 3) * entries)
            self.log_decoder_bound = self.param(
                "log_decoder_bound", nn.initializers.constant(1.0), ()
            )
        if self.forcing_hidden:
            self.forcing_head = nn.Dense(self.forcing_hidden * entries)
            self.forcing_weights = self.param(
                # With zeros, the extension begins as the model without it.
                "forcing",
                nn.initializers.zeros,
                (self.rank, self.forcing_hidden),
            )
        # Flax numbers the keys of `param` by call, so another order would draw other
        # weights.
        square = (self.rank, self.rank)
        self.operators = self.param(
            "operators", _near_identity, (self.vertices, *square)
        )
        self.readout = self.param(
            "readout", nn.initializers.orthogonal(), (self.body, self.rank)
        )
        self.centre = self.param("centre", nn.initializers.zeros, (self.body,))
        if self.joint:
            self.couplings = self.param("couplings", _couplings, (2, *square))
        if self.joint and self.learn_alpha:
            self.alpha_logit = self.param(
                "alpha_logit", nn.initializers.constant(ALPHA_START), ()
            )

    @property
    def bounded(self) -> bool:
        """Whether a step contracts by construction."""
        return self.residual_class is None or self.residual_class.is_bounded

    def rate(self) -> Scalar:
        """Return α = ρ + β, or less if it is learned."""
        largest = jnp.asarray(self.rho + self.beta)
        # Without a joint budget α is the sum of two settings.
        if not (self.joint and self.learn_alpha):
            return largest
        # No step of the optimiser leaves the ends of the sigmoid.
        return LOWEST_RATE + (largest - LOWEST_RATE) * nn.sigmoid(self.alpha_logit)

    def __call__(self, env: Array) -> tuple[SharedWeights, PerEnvironment]:
        """Evaluate every part once, so that `init` creates all parameters."""
        return self.shared(), self.per_environment(env)

    def shared(self) -> SharedWeights:
        """Return the weights that do not depend on e, with every bound enforced."""
        if self.joint:
            # φ is bounded by 1, since the couplings carry its gain; otherwise α would
            # count twice.
            vertices, residual = share_budget(
                self.operators, self.couplings, self.residual_weights(1.0), self.rate()
            )
        else:
            vertices = separate_budget(self.operators, self.rho)
            residual = Weights()
            if self.residual_class is not None:
                residual = self.residual_weights(self.beta)
        # With norm at most 1 in scaled units, a ball in z bounds the body state.
        readout = bounded(self.readout, 1.0)
        decoder = Weights()
        if self.pose:
            # The decoder feeds nothing back, so its bound may be learned.
            decoder = self.decoder_weights(jnp.exp(self.log_decoder_bound))
        return SharedWeights(
            vertices=vertices,
            residual=residual,
            decoder=decoder,
            forcing=(self.forcing_weights,) if self.forcing_hidden else (),
            readout=readout,
            centre=self.centre,
            lift=jnp.linalg.inv(readout) if self.state_lift else None,
        )

    def per_environment(self, env: Float[Array, " environment"]) -> PerEnvironment:
        """Return the functions of e; `env` is scaled to about [-1, 1]."""
        embedding = self.psi(env)

        def outputs_of(head: nn.Dense) -> Array:
            return head(embedding)

        tables = self._tables(outputs_of)
        # On the simplex by construction: a mixture of contractions contracts.
        mixture = None if self.scheduled else nn.softmax(self.mixture_head(embedding))
        return PerEnvironment(
            mixture=mixture,
            gains=tuple(table[:, :-1] for table in tables),
            offsets=tuple(table[:, -1] for table in tables),
            # Evaluated even without transport, so that the ablation has the same
            # parameters.
            tangents=self.tangent_head(embedding),
            embedding=embedding,
        )

    def bilinear(self) -> tuple[Float[Array, "row product"], ...]:
        """Return T of gain(e) u + offset(e) = T ([ψ(e); 1] ⊗ [u; 1]), of both tables.

        It is for training, where every step of every window has its own e. The gains of
        all of them would be a hundred times as many numbers as products of ψ and u.
        """

        def weights_of(head: nn.Dense) -> Array:
            params = head.variables["params"]
            return jnp.vstack([params["kernel"], params["bias"]])

        # A table is linear in the outputs of the heads, hence in their weights.
        tables = [jnp.moveaxis(table, 0, 1) for table in self._tables(weights_of)]
        return tuple(table.reshape(table.shape[0], -1) for table in tables)

    def _tables(self, read: Callable[[nn.Dense], Array]) -> tuple[Array, ...]:
        """Return [gain, offset] of the biases before a tanh, and of the others.

        Args:
            read: head -> its outputs, or anything that is linear in them.
        """

        def table(head: nn.Dense) -> Array:
            outputs = read(head)
            return outputs.reshape(*outputs.shape[:-1], -1, self.control + 1)

        B = read(self.input_head)
        B = B.reshape(*B.shape[:-1], self.rank, self.control)
        outer = [jnp.concatenate([B, jnp.zeros_like(B[..., :1])], axis=-1)]
        hidden = [outer[0][..., :0, :]]
        if self.residual_class is not None:
            rows = table(self.residual_head)
            hidden.append(rows[..., : -self.rank, :])
            outer[0] += rows[..., -self.rank :, :]
        if self.pose:
            rows = table(self.decoder_head)
            hidden.append(rows[..., :-3, :])
            outer.append(rows[..., -3:, :])
        if self.forcing_hidden:
            hidden.append(table(self.forcing_head))
        if self.scheduled:
            outer.append(table(self.mixture_head))
        return jnp.concatenate(hidden, axis=-2), jnp.concatenate(outer, axis=-2)


def _couplings(key: Array, shape: tuple[int, ...]) -> Array:
    """Draw couplings of norm 0.3, for an initial gain of the residual of about 0.1."""
    return jax.random.normal(key, shape, jnp.float32) * (0.15 / shape[-1] ** 0.5)


def _near_identity(key: Array, shape: tuple[int, ...]) -> Array:
    """Draw operators near the identity, since a state changes little in one step."""
    noise = jax.random.normal(key, shape, jnp.float32) * (0.1 / shape[-1] ** 0.5)
    return jnp.eye(shape[-1], dtype=jnp.float32) + noise
