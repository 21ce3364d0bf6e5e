"""Networks with a bound in z: sandwich layers, Gram bound, biases and the encoder."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar

FLOAT32_MARGIN = 1e-5
"""Relative margin for float32 rounding inside the Gram iteration (measured: 2.2e-6)."""
GRAM_ITERATIONS = 6
CAYLEY_RANGE = 8.0
"""Largest 2-norm of the free matrices; beyond it I + Z is too ill-conditioned for
orthogonality in float32.
"""
SMALL = nn.initializers.variance_scaling(0.1, "fan_in", "truncated_normal")
"""Initial weights of heads whose output should start close to its bias."""
FRAMES = ("body", "path")
"""Coordinates of a model: those of the world, or those along a path, without a pose."""


class Weights(NamedTuple):
    """W_1 … W_L of W_L σ(… σ(W_1 z + b_1) …) + b_L and λ_1 … λ_{L-1} of its bound.

    Without matrices it is the function 0; without a bound there are no multipliers.
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

    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return explicit weights for the Lipschitz bound γ."""
        # A little less than asked for: rounding in the products may add to the norm.
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
            # Where the Cayley transform is orthogonal in float32, see CAYLEY_RANGE.
            A, B = cayley(*(bounded(free, CAYLEY_RANGE) for free in (square, tall)))
            # The last layer has no slope after it, so no Ψ and no factor √2.
            if k == len(self.hidden):
                matrices.append(jnp.sqrt(gamma) * B @ left)
                break
            psi = self.param(f"psi_{k}", nn.initializers.zeros, (after,))
            # Beyond e^±5 the multipliers ψ² leave what float32 resolves beside 1.
            psi = jnp.exp(jnp.clip(psi, -5.0, 5.0))
            matrices.append(jnp.sqrt(2.0) * (B @ left) / psi[:, None])
            multipliers.append(gamma * psi**2)
            left = jnp.sqrt(2.0) * A.T * psi
        return Weights(tuple(matrices), tuple(multipliers))


class Free(nn.Module):
    """`Sandwich` without a bound, an ablation: certified only if it contracts."""

    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return plain weights; the bound is ignored."""
        # The signature of `Sandwich`: the ablation exchanges the class alone.
        sizes = pairwise((self.inputs, *self.hidden, self.outputs))
        spread = nn.initializers.lecun_normal()
        matrices = tuple(
            self.param(f"kernel_{k}", spread, (after, before))
            for k, (before, after) in enumerate(sizes)
        )
        return Weights(matrices, ())


class Encoder(nn.Module):
    """φ(s, ψ(e)) = W_0 s + W_2 tanh(W_1 [s; ψ(e)] + b_1) + b_2.

    The read-out of s is linear in z: a lift that contains s itself, W_0 s, need not
    reconstruct it from saturating functions. Without `linear` it is left out.
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
        # Not one layer on [s; hidden]: the ablation drops W_0 s and nothing else.
        z = nn.Dense(self.rank)(hidden)
        return z + nn.Dense(self.rank, use_bias=False)(body) if self.linear else z


def gram_bound(
    matrix: Float[Array, "rows columns"], *, iterations: int = GRAM_ITERATIONS
) -> Scalar:
    """Return an upper bound on ||M||_2, too large by a factor r^(1/2^(k+1)) at most.

    Gram iteration: G_0 = M, G_{k+1} = G_k' G_k rescaled to unit Frobenius norm; ||M||_2
    ≤ ||G_k||_F^(1/2^k), scales undone. It needs no singular vectors, so the gradient is
    finite at repeated singular values. Source: Delattre et al., arXiv 2305.16173.
    """

    def square(k: Any, known: tuple[Array, Scalar]) -> tuple[Array, Scalar]:
        gram = known[0].T @ known[0]
        scale = _frobenius(gram)
        # A Gram step squares the norm, so each later scale counts half as much.
        return gram / scale, known[1] + 0.5**k * jnp.log(scale)

    scale = _frobenius(matrix)
    # Unit norm first: squaring very large or small entries leaves float32. Scales are
    # kept as logarithms: a norm to the power 2^k leaves it as well.
    first = square(1.0, (matrix / scale, jnp.log(scale)))
    # A loop: unrolled, most of the time to compile a model is in here.
    return jnp.exp(jax.lax.fori_loop(2, iterations + 1, square, first)[1])


def bounded(
    matrix: Float[Array, "rows columns"], bound: float
) -> Float[Array, "rows columns"]:
    """Return M · ρ / max(ρ, gram(M)(1 + margin)), whose 2-norm is at most ρ.

    A matrix with a Gram bound below ρ is returned as it is, up to the margin.
    """
    # Both margins: the bound is above the norm, and the result below ρ, once rounded.
    norm = gram_bound(matrix) * (1.0 + FLOAT32_MARGIN)
    # The maximum leaves matrices inside the bound alone: there training is free.
    return matrix * (bound * (1.0 - FLOAT32_MARGIN) / jnp.maximum(bound, norm))


def _frobenius(matrix: Float[Array, "rows columns"]) -> Scalar:
    """||M||_F, away from zero so that its logarithm and gradient exist."""
    return jnp.sqrt(jnp.sum(matrix**2) + 1e-24)


def cayley(
    square: Float[Array, "out out"], tall: Float[Array, "inputs out"]
) -> tuple[Float[Array, "out out"], Float[Array, "out inputs"]]:
    """Return A, B with A A' + B B' = I from free matrices X (square) and Y (tall).

    Z = X − X' + Y'Y,   A' = (I − Z)(I + Z)⁻¹,   B' = −2 Y (I + Z)⁻¹
    """
    identity = jnp.eye(square.shape[0])
    # Skew plus positive semidefinite: I + Z is invertible for every X and Y.
    Z = square - square.T + tall.T @ tall
    inverse = jnp.linalg.inv(identity + Z)
    return ((identity - Z) @ inverse).T, (-2.0 * tall @ inverse).T
