"""R2DN: a linear system in feedback with a 1-Lipschitz network, contracting by construction."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.se2 import compose
from sfkd_jax.models._continuous import has_pose, scaled_env
from sfkd_jax.models._r2dn_weights import Affine, Interconnection, Shared
from sfkd_jax.models.sfkd._networks import Biases, Encoder
from sfkd_jax.models.sfkd._records import SfkdLatent
from sfkd_jax.models.sfkd._sandwich import apply
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Declared,
    Environment,
    Explicit,
    Key,
    Model,
    Params,
    Polytope,
    Space,
    State,
)


class R2dnFiber(NamedTuple):
    """All that does not change along a rollout; only the biases and `env` depend on e."""

    A: Float[Array, "rank rank"]
    feedback: tuple[Float[Array, "_ _"], ...]
    feedback_biases: Biases
    decoder: tuple[Float[Array, "_ _"], ...]
    decoder_biases: Biases
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]
    env: Environment
    encoder: Any


def r2dn(
    space: Space,
    *,
    rank: int = 32,
    alpha: float = 0.995,
    hidden: tuple[int, ...] = (32, 32),
    decoder_hidden: tuple[int, ...] = (64, 32),
    encoder_hidden: int = 32,
    environment: bool = True,
    frame: str = "body",
) -> Model:
    """Robust recurrent deep network: an LTI system in feedback with a 1-Lipschitz network, the pose on SE(2) outside.

        z⁺ = A z + B₁ φ(C₁ z; u, e) + B₂ [u; e] + b,   g⁺ = g ∘ D(z; u, e),   s = C z + c

    φ is a sandwich network; u and e (scaled) are biases of each of its layers, so D₁₂
    [u; e] of the paper is part of the first one. For two trajectories under the same u
    and e let Δz be their difference, Δv = C₁ Δz and Δw that of φ. By construction, and
    checked in no search,

        |A Δz + B₁ Δw|² + |C₁ Δz|² ≤ α² |Δz|² + |Δw|²,   that is  ‖[A/α  B₁; C₁/α  0]‖₂ ≤ 1,

    and |Δw| ≤ |Δv|. The sum of both is |Δz⁺| ≤ α |Δz|. The metric of the paper is P = I
    here: encoder, decoder and read-out absorb P^(1/2), and B₁, C₁ the multiplier of φ's
    bound. A single bound for A and the feedback together leaves more room than ρ + β.
    Source: Barbara, Wang and Manchester, arXiv 2504.01250; its controls and
    observations are ours, as for SFKD.

    Args:
        space: measured scales; fixes all sizes.
        rank: of z, and of what φ takes in and gives out.
        alpha: α, below 1 for a certificate.
        hidden, decoder_hidden, encoder_hidden: hidden widths of φ, D and the encoder.
        environment: use e at all.
        frame: "body", or "path" for path coordinates, which have no pose.

    Raises:
        ValueError: an unknown frame, rank below 1, α outside (0, 1), or no hidden layer
            in φ or D.
    """
    _check(rank, alpha, hidden, decoder_hidden)
    pose = has_pose(frame)
    body, control = space.body_mean.shape[0], space.control_mean.shape[0]
    inputs = control + space.env_mean.shape[0]
    weights = Interconnection(
        rank, body, inputs, tuple(hidden), tuple(decoder_hidden), alpha, pose
    )
    encoder = Encoder(rank, encoder_hidden)

    def init(key: Key) -> Params:
        weights_key, encoder_key = jax.random.split(key)
        return {
            "weights": weights.init(weights_key)["params"],
            "encoder": encoder.init(
                encoder_key, jnp.zeros(body), jnp.zeros(inputs - control)
            )["params"],
        }

    def explicit_weights(params: Params) -> Shared:
        if "shared" in params:  # folded: what runs is then also what is certified
            return params["shared"]
        return cast(Shared, weights.apply({"params": params["weights"]}))

    def fold(params: Params) -> Params:
        return params | {"shared": explicit_weights(params)}

    def fiber(params: Params, env: Environment) -> R2dnFiber:
        shared = explicit_weights(params)
        scaled = scaled_env(space, env, environment)
        return R2dnFiber(
            A=shared.A,
            feedback=shared.feedback.matrices,
            feedback_biases=_biases(
                shared.feedback_inputs, shared.feedback.matrices, scaled
            ),
            decoder=shared.decoder.matrices,
            decoder_biases=_biases(
                shared.decoder_inputs, shared.decoder.matrices, scaled
            ),
            readout=shared.readout,
            centre=shared.centre,
            env=scaled,
            encoder=params["encoder"],
        )

    def encode(fiber: R2dnFiber, state: State) -> SfkdLatent:
        if state.shape != (3 + body,):
            raise ValueError(f"state must have shape ({3 + body},), got {state.shape}")
        scaled = (state[BODY] - space.body_mean) / space.body_scale
        return SfkdLatent(
            state[POSE],
            cast(
                jax.Array, encoder.apply({"params": fiber.encoder}, scaled, fiber.env)
            ),
        )

    def step(fiber: R2dnFiber, latent: SfkdLatent, control: Control) -> SfkdLatent:
        u = (control - space.control_mean) / space.control_scale
        z = fiber.A @ latent.z + apply(
            fiber.feedback, fiber.feedback_biases.at(u), latent.z
        )
        if not pose:
            return SfkdLatent(latent.pose, z)
        motion = apply(fiber.decoder, fiber.decoder_biases.at(u), latent.z)
        return SfkdLatent(
            compose(latent.pose, space.increment_mean + space.increment_scale * motion),
            z,
        )

    def decode(fiber: R2dnFiber, latent: SfkdLatent) -> State:
        scaled = fiber.readout @ latent.z + fiber.centre
        return jnp.concatenate(
            [latent.pose, space.body_mean + space.body_scale * scaled]
        )

    def explicit(params: Params) -> Explicit:
        shared = explicit_weights(params)
        decoder = shared.decoder.matrices
        if pose:
            decoder = (
                *decoder[:-1],
                jnp.asarray(space.increment_scale)[:, None] * decoder[-1],
            )
        return Explicit(
            operators=Polytope(shared.A[None]),
            residual=shared.feedback.matrices,
            residual_multipliers=shared.feedback.multipliers,
            decoder=decoder,
            decoder_multipliers=shared.decoder.multipliers,
            readout=jnp.asarray(space.body_scale)[:, None] * shared.readout,
            declared=Declared("tanh", "identity", control),
        )

    return Model(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=decode,
        transport=lambda fiber, fiber_next, latent: latent,
        observe=lambda fiber, latent, state: encode(fiber, state),
        vector=lambda latent: latent.z,
        explicit=explicit,
        fold=fold,
        rate=lambda params: jnp.asarray(alpha),
        along_path=not pose,
    )


def _biases(
    inputs: Affine | None, matrices: tuple[Float[Array, "_ _"], ...], env: Environment
) -> Biases:
    """b_k(u, e) of every layer for one e: all of [u; e] enters linearly, so e only shifts the offsets."""
    if inputs is None:
        return Biases((), ())
    widths = [matrix.shape[0] for matrix in matrices]
    edges = [sum(widths[: k + 1]) for k in range(len(widths) - 1)]
    controls = inputs.gain.shape[0] - env.shape[0]
    gains = jnp.split(inputs.gain[:controls].T, edges)
    offsets = jnp.split(env @ inputs.gain[controls:] + inputs.offset, edges)
    return Biases(tuple(gains), tuple(offsets))


def _check(
    rank: int, alpha: float, hidden: tuple[int, ...], decoder_hidden: tuple[int, ...]
) -> None:
    """Refuse settings that no model can have."""
    if rank < 1:
        raise ValueError(f"model.rank must be at least 1, got {rank}")
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"model.alpha must lie in (0, 1), got {alpha}")
    if not hidden or not decoder_hidden:
        raise ValueError(
            f"model.hidden and model.decoder_hidden need a layer each, got {hidden} and {decoder_hidden}"
        )
