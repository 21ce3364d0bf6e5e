"""Learned weights of R2DN in explicit form, with the contraction bound enforced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._bounds import bounded
from sfkd_jax.models.sfkd._sandwich import Sandwich, Weights

SMALL = nn.initializers.variance_scaling(0.1, "fan_in", "truncated_normal")


class Affine(NamedTuple):
    """The biases of all layers of a network, concatenated, as [u; e] gain + offset."""

    gain: Float[Array, "inputs all"]
    offset: Float[Array, " all"]


class Shared(NamedTuple):
    """Plain weights, with all bounds enforced.

    Attributes:
        A: of z⁺ = A z + W_L tanh(… W_1 z …).
        feedback: W_1 = V_1 C₁, …, W_L = B₁ V_L with V of φ, and φ's multipliers, which
            prove α for the whole step.
        feedback_inputs: biases of the feedback; the last one is B₂ [u; e] + b.
        decoder: of the pose increment; empty without a pose.
        decoder_inputs: biases of the decoder; None without a pose.
        readout: C of the body state.
        centre: c of the body state.
    """

    A: Float[Array, "rank rank"]
    feedback: Weights
    feedback_inputs: Affine
    decoder: Weights
    decoder_inputs: Affine | None
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]


class Interconnection(nn.Module):
    """Everything learned except the encoder.

    Attributes:
        rank: size of z.
        body: size of s.
        inputs: size of [u; e].
        hidden: hidden widths of φ.
        decoder_hidden: hidden widths of the decoder.
        alpha: α.
        pose: whether there is a decoder of the pose.
    """

    rank: int
    body: int
    inputs: int
    hidden: Sequence[int]
    decoder_hidden: Sequence[int]
    alpha: float
    pose: bool = True

    @nn.compact
    def __call__(self) -> Shared:
        """Return the explicit weights."""
        square = (self.rank, self.rank)
        A, B1, C1 = contracting(
            self.param("A", lambda key, shape: jnp.eye(*shape), square),
            self.param("B1", SMALL, square),
            self.param("C1", SMALL, square),
            self.alpha,
        )
        phi = Sandwich(self.rank, self.hidden, self.rank, name="phi")(1.0)
        first, *middle, last = phi.matrices
        decoder, decoder_inputs = (
            self._decoder() if self.pose else (Weights((), ()), None)
        )
        return Shared(
            A=A,
            feedback=Weights((first @ C1, *middle, B1 @ last), phi.multipliers),
            feedback_inputs=self._affine(
                "feedback", sum(self.hidden) + self.rank, SMALL
            ),
            decoder=decoder,
            decoder_inputs=decoder_inputs,
            readout=bounded(
                self.param(
                    "readout", nn.initializers.orthogonal(), (self.body, self.rank)
                ),
                1.0,
            ),
            centre=self.param("centre", nn.initializers.zeros, (self.body,)),
        )

    def _decoder(self) -> tuple[Weights, Affine]:
        """Weights and biases of the decoder of the pose increment."""
        bound = jnp.exp(
            self.param("log_decoder_bound", nn.initializers.constant(1.0), ())
        )
        weights = Sandwich(self.rank, self.decoder_hidden, 3, name="decoder")(bound)
        return weights, self._affine(
            "decoder", sum(self.decoder_hidden) + 3, nn.initializers.lecun_normal()
        )

    def _affine(
        self, name: str, size: int, spread: nn.initializers.Initializer
    ) -> Affine:
        """The learned biases of one network."""
        gain = self.param(f"{name}_gain", spread, (self.inputs, size))
        return Affine(
            gain, self.param(f"{name}_offset", nn.initializers.zeros, (size,))
        )


def contracting(
    A: Float[Array, "rank rank"],
    B1: Float[Array, "rank w"],
    C1: Float[Array, "v rank"],
    alpha: float,
) -> tuple[Float[Array, "rank rank"], Float[Array, "rank w"], Float[Array, "v rank"]]:
    """Return (α Ã, B̃₁, α C̃₁) from free matrices, with ‖[Ã B̃₁; C̃₁ 0]‖₂ ≤ 1.

    [Ã B̃₁; C̃₁ 0] = [A B₁; C₁ 0] / max(1, Gram bound of [A B₁; C₁ 0]).
    """
    zeros = jnp.zeros((C1.shape[0], B1.shape[1]))
    block = bounded(jnp.block([[A, B1], [C1, zeros]]), 1.0)
    rows, columns = A.shape
    return (
        alpha * block[:rows, :columns],
        block[:rows, columns:],
        alpha * block[rows:, :columns],
    )
