"""What a rollout carries and what it is given: the latent and the fibre."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._networks import Biases
from sfkd_jax.types import Pose


class SfkdLatent(NamedTuple):
    """The rollout state: the pose (body frame) or the anchor of the segment (segment frame), and z."""

    pose: Pose
    z: Float[Array, " rank"]


class Mixture(NamedTuple):
    """A(e) = Σ_j w_j A_j, not summed: the gradient by the A_j then needs no matrix of its own for every e.

    That is what training differentiates, where every step of every window has its own
    e.
    """

    weights: Float[Array, " vertex"]
    vertices: Float[Array, "vertex rank rank"]

    def __matmul__(self, z: Float[Array, " rank"]) -> Float[Array, " rank"]:
        """A(e) z."""
        return self.weights @ (self.vertices @ z)

    def summed(self) -> Float[Array, "rank rank"]:
        """A(e), for many steps under one e."""
        return jnp.tensordot(self.weights, self.vertices, axes=1)


class SfkdFiber(NamedTuple):
    """All that depends on e alone, with explicit weights: nothing is left to normalise inside a rollout."""

    A: Mixture | Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    residual: tuple[Float[Array, "_ _"], ...]
    residual_biases: Biases
    decoder: tuple[Float[Array, "_ _"], ...]
    decoder_biases: Biases
    forcing: tuple[Float[Array, "_ _"], ...]
    forcing_biases: Biases
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]
    tangents: Float[Array, " plane"]
    embedding: Float[Array, " embedding"]
    encoder: Any
