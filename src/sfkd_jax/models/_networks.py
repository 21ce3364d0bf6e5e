"""Networks with a Lipschitz bound in z: sandwich layers, Gram bound, encoder."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar

FLOAT32_MARGIN = 1e-5
"""Relative margin for float32 rounding inside the Gram iteration (measured: 2.2e-6)."""
GRAM_ITERATIONS = 6
CAYLEY_RANGE = 8.0
"""Largest 2-norm of the free matrices. Beyond it, I + Z is too ill-conditioned for
orthogonality in float32.
"""
SMALL = nn.initializers.variance_scaling(0.1, "fan_in", "truncated_normal")
"""Initial weights of a head whose output should start close to its bias."""


class Weights(NamedTuple):
    """Weights of the network W_L σ(… σ(W_1 z + b_1) …) + b_L.

    Attributes:
        matrices: W_1 … W_L; () for the function 0.
        multipliers: λ_1 … λ_{L-1} of the Lipschitz bound; () without a bound.
    """

    matrices: tuple[Float[Array, "_ _"], ...] = ()
    multipliers: tuple[Float[Array, " _"], ...] = ()


def apply(
    matrices: Sequence[Float[Array, "_ _"]],
    biases: Sequence[Float[Array, " _"]],
    z: Float[Array, " _"],
) -> Float[Array, " _"]:
    """Return W_L tanh(… tanh(W_1 z + b_1) …) + b_L; b_L without matrices."""
    if not matrices:
        return biases[-1]
    for matrix, bias in zip(matrices[:-1], biases[:-1], strict=True):
        z = jnp.tanh(matrix @ z + bias)
    return matrices[-1] @ z + biases[-1]


class Sandwich(nn.Module):
    """Weights of a sandwich (LBDN) network, |f(z) − f(z')| ≤ γ |z − z'|.

    The bound holds for any biases and slopes in [0, 1]. With [A_k B_k] the rows of an
    orthogonal Cayley block, A A' + B B' = I, and Ψ_k = diag(exp ψ_k),

        W_1 = √(2γ) Ψ_1⁻¹ B_1,   W_k = 2 Ψ_k⁻¹ B_k A_{k-1}' Ψ_{k-1},
        W_L = √(2γ) B_L A_{L-1}' Ψ_{L-1},

    and Λ_k = γ Ψ_k² is the witness of the bound. There is at least one hidden layer.
    Source: Wang and Manchester, arXiv 2301.11526.
    """

    is_bounded: ClassVar[bool] = True
    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return explicit weights for the Lipschitz bound γ."""
        # A little below the bound, because rounding in the products may add to the
        # norm.
        gamma = jnp.asarray(bound) * (1.0 - FLOAT32_MARGIN)
        sizes = (self.inputs, *self.hidden, self.outputs)
        spread = nn.initializers.lecun_normal()
        matrices = []
        multipliers = []
        # `left` carries A_{k-1}' Ψ_{k-1} on; √γ goes in at either end.
        left = jnp.sqrt(gamma) * jnp.eye(self.inputs)
        for k, (before, after) in enumerate(pairwise(sizes)):
            square = self.param(f"square_{k}", spread, (after, after))
            tall = self.param(f"tall_{k}", spread, (before, after))
            square = bounded(square, CAYLEY_RANGE)
            tall = bounded(tall, CAYLEY_RANGE)
            A, B = cayley(square, tall)
            # No slope follows the last layer, so it has no Ψ and no factor √2.
            if k == len(self.hidden):
                matrices.append(jnp.sqrt(gamma) * B @ left)
                break
            psi = self.param(f"psi_{k}", nn.initializers.zeros, (after,))
            # Beyond e^±5, float32 does not resolve the multipliers ψ² beside 1.
            psi = jnp.exp(jnp.clip(psi, -5.0, 5.0))
            matrices.append(jnp.sqrt(2.0) * (B @ left) / psi[:, None])
            multipliers.append(gamma * psi**2)
            left = jnp.sqrt(2.0) * A.T * psi
        return Weights(tuple(matrices), tuple(multipliers))


class Free(nn.Module):
    """`Sandwich` without a bound, for an ablation.

    A model with it is certified only if it turns out to contract.
    """

    is_bounded: ClassVar[bool] = False
    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return plain weights; the bound is ignored.

        The signature is that of `Sandwich`, so that the ablation exchanges the class
        alone.
        """
        sizes = pairwise((self.inputs, *self.hidden, self.outputs))
        spread = nn.initializers.lecun_normal()
        matrices = tuple(
            self.param(f"kernel_{k}", spread, (after, before))
            for k, (before, after) in enumerate(sizes)
        )
        return Weights(matrices, ())


class Encoder(nn.Module):
    """φ(s, ψ(e)) = W_0 s + W_2 tanh(W_1 [s; ψ(e)] + b_1) + b_2.

    The read-out of s is linear in z. With W_0 s the lift contains s itself, which need
    not be reconstructed from saturating functions.

    Attributes:
        rank: size of z.
        hidden: width.
        linear: whether W_0 s is included.
    """

    rank: int
    hidden: int
    linear: bool = True

    @nn.compact
    def __call__(
        self, body: Float[Array, " inputs"], embedding: Float[Array, " embedding"]
    ) -> Array:
        """Return z before rotation, shape (rank,)."""
        # e enters through its embedding, so that the lift may differ by environment.
        hidden = nn.tanh(nn.Dense(self.hidden)(jnp.concatenate([body, embedding])))
        # W_0 and W_2 are separate layers, so that the ablation drops W_0 s and nothing
        # else.
        z = nn.Dense(self.rank)(hidden)
        if not self.linear:
            return z
        return z + nn.Dense(self.rank, use_bias=False)(body)


def gram_bound(
    matrix: Float[Array, "rows columns"], *, iterations: int = GRAM_ITERATIONS
) -> Scalar:
    """Return an upper bound on ||M||_2 of a matrix M of rank r.

        G_0 = M,   G_{k+1} = G_k' G_k,   ||M||_2 ≤ ||G_k||_F^(1/2^k)

    The bound is too large by a factor r^(1/2^(k+1)) at most. In this Gram iteration
    every G_k is scaled to unit Frobenius norm, and the scales are multiplied at the
    end. It needs no singular vectors, so the gradient is finite at repeated singular
    values. Source: Delattre et al., arXiv 2305.16173.
    """

    def square(k: Any, carry: tuple[Array, Scalar]) -> tuple[Array, Scalar]:
        before, log_norm = carry
        gram = before.T @ before
        scale = _frobenius(gram)
        # A Gram step squares the norm, so each later scale counts half as much.
        return gram / scale, log_norm + 0.5**k * jnp.log(scale)

    # The matrix is scaled first, because the squares of very large or small entries
    # leave the range of float32. So would a norm to the power 2^k, and the scales are
    # kept as logarithms.
    scale = _frobenius(matrix)
    first = square(1.0, (matrix / scale, jnp.log(scale)))
    # A loop that is not unrolled, since most of the time to compile a model is in here.
    _, log_norm = jax.lax.fori_loop(2, iterations + 1, square, first)
    return jnp.exp(log_norm)


def bounded(
    matrix: Float[Array, "rows columns"], bound: float
) -> Float[Array, "rows columns"]:
    """Return M · ρ / max(ρ, gram(M)(1 + margin)), whose 2-norm is at most ρ.

    A matrix with a Gram bound below ρ is returned as it is, up to the margin.
    """
    # With one margin the bound is above the norm after rounding, with the other one the
    # result is below ρ.
    norm = gram_bound(matrix) * (1.0 + FLOAT32_MARGIN)
    # The maximum leaves matrices inside the bound as they are, so training is free
    # there.
    return matrix * (bound * (1.0 - FLOAT32_MARGIN) / jnp.maximum(bound, norm))


def _frobenius(matrix: Float[Array, "rows columns"]) -> Scalar:
    """Return ||M||_F, away from 0 so that its logarithm and gradient exist."""
    return jnp.sqrt(jnp.sum(matrix**2) + 1e-24)


def cayley(
    square: Float[Array, "out out"], tall: Float[Array, "inputs out"]
) -> tuple[Float[Array, "out out"], Float[Array, "out inputs"]]:
    """Return A, B with A A' + B B' = I from free matrices X (square) and Y (tall).

    Z = X − X' + Y'Y,   A' = (I − Z)(I + Z)⁻¹,   B' = −2 Y (I + Z)⁻¹
    """
    identity = jnp.eye(square.shape[0])
    # Z is skew plus positive semidefinite, so I + Z is invertible for every X and Y.
    Z = square - square.T + tall.T @ tall
    inverse = jnp.linalg.inv(identity + Z)
    return ((identity - Z) @ inverse).T, (-2.0 * tall @ inverse).T
