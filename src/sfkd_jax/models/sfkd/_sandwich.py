"""Networks with a Lipschitz bound in z; all other inputs enter as biases."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._bounds import FLOAT32_MARGIN, bounded
from sfkd_jax.types import Scalar

CAYLEY_RANGE = 8.0
"""Largest 2-norm of the free matrices; beyond it I + Z is too ill-conditioned for
orthogonality in float32.
"""


class Weights(NamedTuple):
    """Matrices of W_L σ(… σ(W_1 z + b_1) …) + b_L and the multipliers of its bound.

    Attributes:
        matrices: W_1 … W_L, each (out, in).
        multipliers: λ_1 … λ_{L-1}, one vector per hidden layer; () without a bound.
    """

    matrices: tuple[Float[Array, "_ _"], ...]
    multipliers: tuple[Float[Array, " _"], ...]


class Sandwich(nn.Module):
    """Weights of a sandwich (LBDN) network, |f(z) − f(z')| ≤ γ |z − z'|.

    The bound holds for any biases and slopes in [0, 1]. With [A_k B_k] the rows of an
    orthogonal Cayley block, A A' + B B' = I, and Ψ_k = diag(exp ψ_k),

        W_1 = √(2γ) Ψ_1⁻¹ B_1,   W_k = 2 Ψ_k⁻¹ B_k A_{k-1}' Ψ_{k-1},
        W_L = √(2γ) B_L A_{L-1}' Ψ_{L-1},

    and Λ_k = γ Ψ_k² is the witness of the bound. Source: Wang and Manchester, arXiv
    2301.11526.

    Attributes:
        inputs: number of inputs.
        hidden: widths of the hidden layers, at least one.
        outputs: number of outputs.
    """

    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return explicit weights for the Lipschitz bound γ."""
        gamma = jnp.asarray(bound) * (1.0 - FLOAT32_MARGIN)
        sizes = (self.inputs, *self.hidden, self.outputs)
        spread = nn.initializers.lecun_normal()
        matrices, multipliers = [], []
        left = jnp.sqrt(gamma) * jnp.eye(self.inputs)
        for k, (before, after) in enumerate(pairwise(sizes)):
            square = bounded(
                self.param(f"square_{k}", spread, (after, after)), CAYLEY_RANGE
            )
            tall = bounded(
                self.param(f"tall_{k}", spread, (before, after)), CAYLEY_RANGE
            )
            A, B = cayley(square, tall)
            if k == len(self.hidden):
                matrices.append(jnp.sqrt(gamma) * B @ left)
                break
            psi = jnp.exp(
                jnp.clip(
                    self.param(f"psi_{k}", nn.initializers.zeros, (after,)), -5.0, 5.0
                )
            )
            matrices.append(jnp.sqrt(2.0) * (B @ left) / psi[:, None])
            multipliers.append(gamma * psi**2)
            left = jnp.sqrt(2.0) * A.T * psi
        return Weights(tuple(matrices), tuple(multipliers))


class Free(nn.Module):
    """The same network without a bound, an ablation: certified only if it contracts.

    Attributes:
        inputs: number of inputs.
        hidden: widths of the hidden layers.
        outputs: number of outputs.
    """

    inputs: int
    hidden: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, bound: Scalar | float) -> Weights:
        """Return plain weights; the bound is ignored."""
        del bound
        sizes = (self.inputs, *self.hidden, self.outputs)
        pairs = enumerate(zip(sizes[1:], sizes[:-1], strict=True))
        matrices = tuple(
            self.param(f"kernel_{k}", nn.initializers.lecun_normal(), size)
            for k, size in pairs
        )
        return Weights(matrices, ())


def cayley(
    square: Float[Array, "out out"], tall: Float[Array, "inputs out"]
) -> tuple[Float[Array, "out out"], Float[Array, "out inputs"]]:
    """Return A, B with A A' + B B' = I from free matrices X (square) and Y (tall).

    Z = X − X' + Y'Y,   A' = (I − Z)(I + Z)⁻¹,   B' = −2 Y (I + Z)⁻¹
    """
    identity = jnp.eye(square.shape[0])
    Z = square - square.T + tall.T @ tall
    inverse = jnp.linalg.inv(identity + Z)
    return ((identity - Z) @ inverse).T, (-2.0 * tall @ inverse).T


def apply(
    matrices: Sequence[Float[Array, "_ _"]],
    biases: Sequence[Float[Array, " _"]],
    z: Float[Array, " _"],
) -> Float[Array, " _"]:
    """Return W_L tanh(… tanh(W_1 z + b_1) …) + b_L."""
    for matrix, bias in zip(matrices[:-1], biases[:-1], strict=True):
        z = jnp.tanh(matrix @ z + bias)
    return matrices[-1] @ z + biases[-1]
