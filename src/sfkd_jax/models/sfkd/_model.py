"""Assembly of Stable Fiber-Koopman Residual Dynamics."""

from __future__ import annotations

from functools import partial
from typing import cast

import jax
import jax.numpy as jnp

from sfkd_jax.core.se2 import between, compose
from sfkd_jax.models._continuous import scaled_env
from sfkd_jax.models.sfkd._networks import Encoder, Networks, PerEnvironment, Shared
from sfkd_jax.models.sfkd._records import Mixture, SfkdFiber, SfkdLatent
from sfkd_jax.models.sfkd._sandwich import apply
from sfkd_jax.models.sfkd._settings import check_settings
from sfkd_jax.models.sfkd._start import identified
from sfkd_jax.models.sfkd._transport import rotate_planes
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
    Pose,
    Scalar,
    Space,
    State,
)

SEGMENT_STEPS = 20.0
"""Increments per unit of the segment-frame pose scale: a window of the paper's horizon."""


def sfkd(
    space: Space,
    *,
    rank: int = 32,
    rho: float = 0.895,
    beta: float = 0.1,
    vertices: int = 8,
    residual_hidden: tuple[int, ...] = (32, 32),
    decoder_hidden: tuple[int, ...] = (64, 32),
    encoder_hidden: int = 32,
    linear_lift: bool = True,
    embedding: int = 16,
    frame: str = "body",
    residual: str = "sandwich",
    budget: str = "joint",
    transport: bool = True,
    environment: bool = True,
    soft_penalty: float = 0.0,
    learn_alpha: bool = False,
    forcing_hidden: int = 0,
) -> Model:
    """Environment-conditioned Koopman operators, a β-Lipschitz residual and isometric transport (eq:sfkd).

        z = Q(e) φ(s, ψ(e)),   z⁺ = A(e) z + B(e) u + r(z; u, e),   z ← T(e → e') z on a switch
        g⁺ = g ∘ D(z; u, e),   s = C z + c

    For every e, by construction and in float32: A(e) = Σ_j w_j(e) A_j with w on the
    simplex, and z ↦ A_j z + r is α-Lipschitz for every j, hence for every mixture, α =
    ρ + β; Q orthogonal; Lip_z D bounded; ||C||_2 ≤ 1 in scaled units. With
    `budget="sum"` ||A_j||_2 ≤ ρ by the Gram bound and Lip_z r ≤ β (sandwich layers; u
    and e are biases); with "joint" the two share α as one map (see `share_budget`),
    which holds all of those and more.

    Args:
        space: measured scales; fixes all sizes.
        rank: r, even.
        rho, beta: the hard bounds, ρ + β < 1 for a certificate; of a joint budget only
            the sum counts.
        vertices: operators to mix.
        embedding: size of ψ(e).
        residual_hidden, decoder_hidden, encoder_hidden: hidden widths.
        linear_lift: φ holds W_0 s, see `Encoder`.
        frame: "body" composes the pose on SE(2) outside z; "segment" is the paper's
            reading, the pose relative to the start of the window inside z; "path" has
            path coordinates as body (see `path_frame`) and no pose.
        residual: "sandwich", "free" (no bound by construction; ||A_j|| ≤ ρ) or "none"
            (||A_j|| ≤ ρ).
        budget: "joint" or "sum", of a sandwich residual.
        transport: learn Q(e), else the identity.
        environment: use e at all.
        forcing_hidden: width of f(u, e) = V tanh(G(e) u + h(e)), added to B(e) u: no
            function of z, so every bound stands as it is; 0 for none.
        learn_alpha: let training choose α of a joint budget between `LOWEST_RATE` and ρ
            + β, from the latter on.
        soft_penalty: weight of the paper's hinge max(0, ||∂r/∂z||_2 − β)² in the
            training loss (eq:contr_loss).

    Raises:
        ValueError: unknown frame or residual, odd rank, or bounds outside (0, 1).
    """
    check_settings(rank, rho, beta, frame, residual, budget, learn_alpha)
    segment, pose = frame == "segment", frame != "path"
    body, control = space.body_mean.shape[0], space.control_mean.shape[0]
    hidden = tuple(residual_hidden), tuple(decoder_hidden)
    bounds = (rho, beta, residual, transport, budget, pose, learn_alpha, forcing_hidden)
    networks = Networks(rank, body, control, vertices, *hidden, embedding, *bounds)
    encoder = Encoder(rank, encoder_hidden, linear_lift)
    pose_scale = jnp.asarray(space.increment_scale) * SEGMENT_STEPS

    def init(key: Key) -> Params:
        network_key, encoder_key = jax.random.split(key)
        inputs = jnp.zeros(body + 3 if segment else body)
        return {
            "networks": networks.init(network_key, jnp.zeros(space.env_mean.shape[0]))[
                "params"
            ],
            "encoder": encoder.init(encoder_key, inputs, jnp.zeros(embedding))[
                "params"
            ],
        }

    def bounded_parts(params: Params) -> Shared:
        if "shared" in params:  # folded: what runs is then also what is certified
            return params["shared"]
        return cast(
            Shared, networks.apply({"params": params["networks"]}, method="shared")
        )

    def fold(params: Params) -> Params:
        return params | {"shared": bounded_parts(params)}

    def fiber(params: Params, env: Environment) -> SfkdFiber:
        shared = bounded_parts(params)
        found = networks.apply(
            {"params": params["networks"]},
            scaled_env(space, env, environment),
            method="per_environment",
        )
        local = cast(PerEnvironment, found)
        operator = Mixture(local.mixture, shared.vertices)
        return SfkdFiber(
            A=operator.summed()
            if "shared" in params
            else operator,  # folded is what drives: many steps under one e
            B=local.B,
            residual=shared.residual.matrices,
            residual_biases=local.residual,
            decoder=shared.decoder.matrices,
            decoder_biases=local.decoder,
            forcing=shared.forcing,
            forcing_biases=local.forcing,
            readout=shared.readout,
            centre=shared.centre,
            tangents=local.tangents,
            embedding=local.embedding,
            encoder=params["encoder"],
        )

    def rate(params: Params) -> Scalar:
        return cast(
            Scalar, networks.apply({"params": params["networks"]}, method="rate")
        )

    def lift(fiber: SfkdFiber, at: Pose, state: State) -> SfkdLatent:
        if state.shape != (3 + body,):
            raise ValueError(f"state must have shape ({3 + body},), got {state.shape}")
        inputs = (state[BODY] - space.body_mean) / space.body_scale
        if segment:
            inputs = jnp.concatenate([between(at, state[POSE]) / pose_scale, inputs])
        z = cast(
            jax.Array, encoder.apply({"params": fiber.encoder}, inputs, fiber.embedding)
        )
        return SfkdLatent(at, rotate_planes(fiber.tangents, z))

    def encode(fiber: SfkdFiber, state: State) -> SfkdLatent:
        return lift(fiber, state[POSE], state)

    def observe(fiber: SfkdFiber, latent: SfkdLatent, state: State) -> SfkdLatent:
        return lift(fiber, latent.pose if segment else state[POSE], state)

    def scaled_control(control: Control) -> Control:
        return (control - space.control_mean) / space.control_scale

    def step(fiber: SfkdFiber, latent: SfkdLatent, control: Control) -> SfkdLatent:
        u = scaled_control(control)
        z = fiber.A @ latent.z + fiber.B @ u
        if forcing_hidden:
            z = z + fiber.forcing[0] @ jnp.tanh(fiber.forcing_biases.at(u)[0])
        if residual != "none":
            z = z + apply(fiber.residual, fiber.residual_biases.at(u), latent.z)
        if segment or not pose:
            return SfkdLatent(latent.pose, z)
        motion = apply(fiber.decoder, fiber.decoder_biases.at(u), latent.z)
        return SfkdLatent(
            compose(latent.pose, space.increment_mean + space.increment_scale * motion),
            z,
        )

    def decode(fiber: SfkdFiber, latent: SfkdLatent) -> State:
        reached = latent.pose
        if segment:
            offset = apply(fiber.decoder, fiber.decoder_biases.offsets, latent.z)
            reached = compose(reached, pose_scale * offset)
        scaled = fiber.readout @ latent.z + fiber.centre
        return jnp.concatenate([reached, space.body_mean + space.body_scale * scaled])

    def carry(
        fiber: SfkdFiber, fiber_next: SfkdFiber, latent: SfkdLatent
    ) -> SfkdLatent:
        home = rotate_planes(-fiber.tangents, latent.z)
        return latent._replace(z=rotate_planes(fiber_next.tangents, home))

    def explicit(params: Params) -> Explicit:
        shared = bounded_parts(params)
        scale = (pose_scale if segment else jnp.asarray(space.increment_scale))[:, None]
        decoder = (
            (*shared.decoder.matrices[:-1], scale * shared.decoder.matrices[-1])
            if pose
            else ()
        )
        return Explicit(
            operators=Polytope(shared.vertices),
            residual=() if residual == "none" else shared.residual.matrices,
            residual_multipliers=shared.residual.multipliers,
            decoder=decoder,
            decoder_multipliers=shared.decoder.multipliers,
            readout=jnp.asarray(space.body_scale)[:, None] * shared.readout,
            declared=Declared("tanh", "rotation" if transport else "identity", control),
        )

    def hinge(fiber: SfkdFiber, latent: SfkdLatent, control: Control) -> Scalar:
        biases = fiber.residual_biases.at(scaled_control(control))
        jacobian = jax.jacobian(lambda z: apply(fiber.residual, biases, z))(latent.z)
        return soft_penalty * jnp.maximum(0.0, jnp.linalg.norm(jacobian, 2) - beta) ** 2

    model = Model(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=decode,
        transport=carry,
        observe=observe,
        vector=lambda latent: latent.z,
        explicit=explicit,
        penalty=hinge if soft_penalty else None,
        fold=fold,
        rate=rate if residual != "free" else None,
        along_path=not pose,
    )
    return model._replace(
        start=partial(identified, model, networks, space, environment)
    )
