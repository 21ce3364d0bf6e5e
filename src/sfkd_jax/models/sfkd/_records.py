"""What a rollout carries and what it is given: the latent and the fibre."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._networks import Biases
from sfkd_jax.types import Pose


class SfkdLatent(NamedTuple):
    """The rollout state: the pose (body frame) or the anchor of the segment (segment frame), and z."""

    pose: Pose
    z: Float[Array, " rank"]


class SfkdFiber(NamedTuple):
    """All that depends on e alone, with explicit weights: nothing is left to normalise inside a rollout."""

    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    residual: tuple[Float[Array, "_ _"], ...]
    residual_biases: Biases
    decoder: tuple[Float[Array, "_ _"], ...]
    decoder_biases: Biases
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]
    tangents: Float[Array, " plane"]
    embedding: Float[Array, " embedding"]
    encoder: Any
