"""The learned parts of SFKD as flax modules, used through init and apply."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._bounds import bounded
from sfkd_jax.models.sfkd._budget import share_budget
from sfkd_jax.models.sfkd._sandwich import Free, Sandwich, Weights
from sfkd_jax.types import Scalar

LOWEST_RATE = 0.5
"""Smallest learned α: no car converges to its path faster than that in 0.1 s."""
ALPHA_START = 2.0
"""Initial logit of a learned α: 88 % of the way from the smallest to the largest."""


class Biases(NamedTuple):
    """b_k(u, e) = gain_k(e) u + offset_k(e) for every layer of a network and one e.

    Attributes:
        gains: (out, control) per layer.
        offsets: (out,) per layer.
    """

    gains: tuple[Float[Array, "_ control"], ...]
    offsets: tuple[Float[Array, " _"], ...]

    def at(self, control: Float[Array, " control"]) -> tuple[Float[Array, " _"], ...]:
        """Return the biases for one scaled control."""
        return tuple(
            gain @ control + offset
            for gain, offset in zip(self.gains, self.offsets, strict=True)
        )


class Shared(NamedTuple):
    """Weights that do not depend on e: vertices, the bounded networks, the read-out."""

    vertices: Float[Array, "vertex rank rank"]
    residual: Weights
    decoder: Weights
    forcing: tuple[Float[Array, "_ _"], ...]
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]


class PerEnvironment(NamedTuple):
    """Functions of e: mixture of the vertices, B(e), biases, rotation, embedding."""

    mixture: Float[Array, " vertex"]
    B: Float[Array, "rank control"]
    residual: Biases
    decoder: Biases
    forcing: Biases
    tangents: Float[Array, " plane"]
    embedding: Float[Array, " embedding"]


class Networks(nn.Module):
    """Embedding ψ(e), operators, residual, decoder and transport: all but the encoder.

    Attributes:
        rank: r, even.
        body: size of s.
        control: size of u.
        vertices: number of operator vertices.
        residual_hidden: hidden widths of the residual.
        decoder_hidden: hidden widths of the decoder.
        embedding: size of ψ(e).
        rho: ρ.
        beta: β.
        residual: "sandwich", "free" or "none".
        transport: whether Q(e) is learned.
        budget: "sum" bounds A(e) by ρ and the residual by β; "joint" bounds their sum,
            as one map, by ρ + β.
        pose: whether there is a decoder of the pose.
        learn_alpha: whether a joint budget may choose α below ρ + β.
        forcing_hidden: width of f(u, e), which is added to B(e) u; 0 for none.
    """

    rank: int
    body: int
    control: int
    vertices: int
    residual_hidden: Sequence[int]
    decoder_hidden: Sequence[int]
    embedding: int
    rho: float
    beta: float
    residual: str
    transport: bool
    budget: str
    pose: bool = True
    learn_alpha: bool = False
    forcing_hidden: int = 0

    def setup(self) -> None:
        """Declare submodules and parameters."""
        kinds = {"sandwich": Sandwich, "free": Free, "none": Free}
        self.psi = nn.Sequential(
            [
                nn.Dense(64),
                nn.tanh,
                nn.Dense(64),
                nn.tanh,
                nn.Dense(self.embedding),
                nn.tanh,
            ]
        )
        self.residual_weights = kinds[self.residual](
            self.rank, self.residual_hidden, self.rank
        )
        small = nn.initializers.variance_scaling(0.1, "fan_in", "truncated_normal")
        self.mixture_head = nn.Dense(self.vertices, kernel_init=small)
        self.input_head = nn.Dense(self.rank * self.control)
        self.residual_head = nn.Dense(
            self._bias_size(self.residual_hidden, self.rank), kernel_init=small
        )
        if self.pose:
            self.decoder_weights = Sandwich(self.rank, self.decoder_hidden, 3)
            self.decoder_head = nn.Dense(self._bias_size(self.decoder_hidden, 3))
            self.log_decoder_bound = self.param(
                "log_decoder_bound", nn.initializers.constant(1.0), ()
            )
        if self.forcing_hidden:
            self.forcing_head = nn.Dense(self.forcing_hidden * (self.control + 1))
            self.forcing_weights = self.param(
                "forcing", nn.initializers.zeros, (self.rank, self.forcing_hidden)
            )
        self.tangent_head = nn.Dense(
            self.rank // 2, kernel_init=small, bias_init=nn.initializers.zeros
        )
        shape = (self.vertices, self.rank, self.rank)
        self.operators = self.param("operators", _near_identity, shape)
        self.readout = self.param(
            "readout", nn.initializers.orthogonal(), (self.body, self.rank)
        )
        self.centre = self.param("centre", nn.initializers.zeros, (self.body,))
        if self._joint:
            self.couplings = self.param(
                "couplings", _couplings, (2, self.rank, self.rank)
            )
            if self.learn_alpha:
                self.alpha_logit = self.param(
                    "alpha_logit", nn.initializers.constant(ALPHA_START), ()
                )

    @property
    def _joint(self) -> bool:
        return self.budget == "joint" and self.residual == "sandwich"

    def rate(self) -> Scalar:
        """Return α = ρ + β, or less if it is learned."""
        most = jnp.asarray(self.rho + self.beta)
        if not (self._joint and self.learn_alpha):
            return most
        return LOWEST_RATE + (most - LOWEST_RATE) * nn.sigmoid(self.alpha_logit)

    def __call__(self, env: Array) -> tuple[Shared, PerEnvironment]:
        """Evaluate every part once, so that init creates all parameters."""
        return self.shared(), self.per_environment(env)

    def shared(self) -> Shared:
        """Return the weights that do not depend on e, with every bound enforced."""
        vertices, residual = self._step()
        decoder = (
            self.decoder_weights(jnp.exp(self.log_decoder_bound))
            if self.pose
            else Weights((), ())
        )
        forcing = (self.forcing_weights,) if self.forcing_hidden else ()
        return Shared(
            vertices,
            residual,
            decoder,
            forcing,
            bounded(self.readout, 1.0),
            self.centre,
        )

    def _step(self) -> tuple[Array, Weights]:
        """Vertices of A(e) and the residual, such that every step contracts."""
        if self._joint:
            return share_budget(
                self.operators, self.couplings, self.residual_weights(1.0), self.rate()
            )
        vertices = jax.vmap(lambda matrix: bounded(matrix, self.rho))(self.operators)
        residual = self.residual_weights(self.beta)
        if self.residual == "none":
            residual = Weights(
                tuple(jnp.zeros_like(matrix) for matrix in residual.matrices), ()
            )
        return vertices, residual

    def per_environment(self, env: Float[Array, " environment"]) -> PerEnvironment:
        """Return the functions of e; `env` is scaled to about [-1, 1]."""
        embedding = self.psi(env)
        residual = self._biases(
            self.residual_head(embedding), self.residual_hidden, self.rank
        )
        if self.residual == "none":
            residual = jax.tree.map(jnp.zeros_like, residual)
        tangents = self.tangent_head(embedding)
        return PerEnvironment(
            mixture=nn.softmax(self.mixture_head(embedding)),
            B=self.input_head(embedding).reshape(self.rank, self.control),
            residual=residual,
            decoder=self._biases(self.decoder_head(embedding), self.decoder_hidden, 3)
            if self.pose
            else Biases((), ()),
            forcing=self._forcing(embedding),
            tangents=tangents if self.transport else jnp.zeros_like(tangents),
            embedding=embedding,
        )

    def _forcing(self, embedding: Array) -> Biases:
        """Biases of the hidden layer of f."""
        if not self.forcing_hidden:
            return Biases((), ())
        table = self.forcing_head(embedding).reshape(
            self.forcing_hidden, self.control + 1
        )
        return Biases((table[:, :-1],), (table[:, -1],))

    def _bias_size(self, hidden: Sequence[int], outputs: int) -> int:
        return (sum(hidden) + outputs) * (self.control + 1)

    def _biases(self, flat: Array, hidden: Sequence[int], outputs: int) -> Biases:
        """Cut one flat vector into gains and offsets per layer."""
        table = flat.reshape(sum(hidden) + outputs, self.control + 1)
        edges = [sum(hidden[: k + 1]) for k in range(len(hidden))]
        parts = jnp.split(table, edges)
        return Biases(
            tuple(part[:, :-1] for part in parts), tuple(part[:, -1] for part in parts)
        )


class Encoder(nn.Module):
    """φ(s, ψ(e)) = W_0 s + W_2 tanh(W_1 [s; ψ(e)] + b_1) + b_2.

    The read-out of s is linear in z: a lift that contains s itself, W_0 s, need not
    reconstruct it from saturating functions.

    Attributes:
        rank: r.
        hidden: width.
        linear: whether W_0 s is part of the lift.
    """

    rank: int
    hidden: int
    linear: bool = True

    @nn.compact
    def __call__(
        self, body: Float[Array, " inputs"], embedding: Float[Array, " embedding"]
    ) -> Array:
        """Return z before rotation, shape (rank,)."""
        hidden = nn.tanh(nn.Dense(self.hidden)(jnp.concatenate([body, embedding])))
        z = nn.Dense(self.rank)(hidden)
        return z + nn.Dense(self.rank, use_bias=False)(body) if self.linear else z


def _couplings(
    key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32
) -> Array:
    """Initial couplings of norm 0.3: the initial gain of the residual is about 0.1."""
    return jax.random.normal(key, shape, dtype) * (0.15 / shape[-1] ** 0.5)


def _near_identity(
    key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32
) -> Array:
    """Initial operators: I plus a little noise, which is slow dynamics."""
    noise = jax.random.normal(key, shape, dtype) * (0.1 / shape[-1] ** 0.5)
    return jnp.eye(shape[-1], dtype=dtype) + noise
