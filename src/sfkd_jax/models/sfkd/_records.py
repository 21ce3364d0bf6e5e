"""Latent and fiber of SFKD."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._networks import Biases
from sfkd_jax.types import Pose


class SfkdLatent(NamedTuple):
    """State of a rollout: z and a pose, in the segment frame that of its start."""

    pose: Pose
    z: Float[Array, " rank"]


class Mixture(NamedTuple):
    """A(e) = Σ_j w_j A_j, not summed.

    In training every step of every window has its own e. Without the sum, the gradient
    with respect to the A_j needs no matrix for each e.
    """

    weights: Float[Array, " vertex"]
    vertices: Float[Array, "vertex rank rank"]

    def __matmul__(self, z: Float[Array, " rank"]) -> Float[Array, " rank"]:
        """Return A(e) z."""
        return self.weights @ (self.vertices @ z)

    def summed(self) -> Float[Array, "rank rank"]:
        """Return A(e), for many steps under one e."""
        return jnp.tensordot(self.weights, self.vertices, axes=1)


class SfkdFiber(NamedTuple):
    """All that depends on e, with explicit weights that need no further bounding."""

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
