"""The functions of an SFKD model over its learned parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, compose
from sfkd_jax.models._continuous import scaled_env
from sfkd_jax.models.sfkd._networks import Encoder, Networks, PerEnvironment, Shared
from sfkd_jax.models.sfkd._records import Mixture, SfkdFiber, SfkdLatent
from sfkd_jax.models.sfkd._sandwich import apply
from sfkd_jax.models.sfkd._transport import rotate_planes
from sfkd_jax.rollout import Folded, unfold
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Declared,
    Environment,
    Explicit,
    Key,
    Params,
    Polytope,
    Pose,
    Scalar,
    Space,
    State,
)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """What the functions of `Model` close over.

    Attributes:
        space: measured scales.
        networks: everything learned except the encoder.
        encoder: of the body state (and of the pose in the segment frame).
        pose_scale: units of the pose in the segment frame.
        segment: whether the pose relative to the start of the segment is part of z.
        environment: whether e is used.
        soft_penalty: weight of `hinge`.
    """

    space: Space
    networks: Networks
    encoder: Encoder
    pose_scale: Float[Array, " 3"]
    segment: bool
    environment: bool
    soft_penalty: float

    def init(self, key: Key) -> Params:
        """Draw initial parameters."""
        network_key, encoder_key = jax.random.split(key)
        body = self.networks.body
        inputs = jnp.zeros(body + 3 if self.segment else body)
        env = jnp.zeros(self.space.env_mean.shape[0])
        embedding = jnp.zeros(self.networks.embedding)
        return {
            "networks": self.networks.init(network_key, env)["params"],
            "encoder": self.encoder.init(encoder_key, inputs, embedding)["params"],
        }

    def shared(self, params: Params) -> Shared:
        """Return the bounded weights, as they are if folded."""
        if isinstance(params, Folded):
            return params.shared
        weights = {"params": params["networks"]}
        return cast(Shared, self.networks.apply(weights, method="shared"))

    def per_environment(self, params: Params, env: Environment) -> PerEnvironment:
        """Return the outputs of the networks of e."""
        scaled = scaled_env(self.space, env, self.environment)
        outputs = self.networks.apply(
            {"params": unfold(params)["networks"]}, scaled, method="per_environment"
        )
        return cast(PerEnvironment, outputs)

    def fiber(self, params: Params, env: Environment) -> SfkdFiber:
        """Return all that depends on e; A(e) is summed for folded parameters only.

        Training takes many environments and differentiates by the vertices; see
        `Mixture`. Driving takes many steps under one environment.
        """
        shared = self.shared(params)
        local = self.per_environment(params, env)
        operator = Mixture(local.mixture, shared.vertices)
        return SfkdFiber(
            A=operator.summed() if isinstance(params, Folded) else operator,
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
            encoder=unfold(params)["encoder"],
        )

    def rate(self, params: Params) -> Scalar:
        """Return α."""
        weights = {"params": unfold(params)["networks"]}
        return cast(Scalar, self.networks.apply(weights, method="rate"))

    def encode(self, fiber: SfkdFiber, state: State) -> SfkdLatent:
        """Return the latent of a state, in a frame that starts at its pose."""
        return self._lift(fiber, state[POSE], state)

    def observe(self, fiber: SfkdFiber, latent: SfkdLatent, state: State) -> SfkdLatent:
        """Return the latent of a state, in the frame of `latent`."""
        return self._lift(fiber, latent.pose if self.segment else state[POSE], state)

    def _lift(self, fiber: SfkdFiber, at: Pose, state: State) -> SfkdLatent:
        """The latent of a state in the frame of a pose."""
        space, size = self.space, 3 + self.networks.body
        if state.shape != (size,):
            raise ValueError(f"state must have shape ({size},), got {state.shape}")
        inputs = (state[BODY] - space.body_mean) / space.body_scale
        if self.segment:
            motion = between(at, state[POSE]) / self.pose_scale
            inputs = jnp.concatenate([motion, inputs])
        z = self.encoder.apply({"params": fiber.encoder}, inputs, fiber.embedding)
        return SfkdLatent(at, rotate_planes(fiber.tangents, cast(jax.Array, z)))

    def _scaled(self, control: Control) -> Control:
        """The control in scaled units."""
        return (control - self.space.control_mean) / self.space.control_scale

    def step(
        self, fiber: SfkdFiber, latent: SfkdLatent, control: Control
    ) -> SfkdLatent:
        """Advance z and the pose by one sampling period."""
        u = self._scaled(control)
        z = fiber.A @ latent.z + fiber.B @ u
        if self.networks.forcing_hidden:
            z = z + fiber.forcing[0] @ jnp.tanh(fiber.forcing_biases.at(u)[0])
        if self.networks.residual != "none":
            z = z + apply(fiber.residual, fiber.residual_biases.at(u), latent.z)
        if self.segment or not self.networks.pose:
            return SfkdLatent(latent.pose, z)
        motion = apply(fiber.decoder, fiber.decoder_biases.at(u), latent.z)
        space = self.space
        return SfkdLatent(
            compose(latent.pose, space.increment_mean + space.increment_scale * motion),
            z,
        )

    def decode(self, fiber: SfkdFiber, latent: SfkdLatent) -> State:
        """Return the state of a latent."""
        pose, space = latent.pose, self.space
        if self.segment:
            offset = apply(fiber.decoder, fiber.decoder_biases.offsets, latent.z)
            pose = compose(pose, self.pose_scale * offset)
        scaled = fiber.readout @ latent.z + fiber.centre
        return jnp.concatenate([pose, space.body_mean + space.body_scale * scaled])

    def transport(
        self, fiber: SfkdFiber, fiber_next: SfkdFiber, latent: SfkdLatent
    ) -> SfkdLatent:
        """Carry z from the fiber of e to that of e', T(e → e') z = Q(e') Q(e)' z."""
        unrotated = rotate_planes(-fiber.tangents, latent.z)
        return latent._replace(z=rotate_planes(fiber_next.tangents, unrotated))

    def explicit(self, params: Params) -> Explicit:
        """Return the weights that a certificate is about."""
        shared, space, networks = self.shared(params), self.space, self.networks
        decoder = shared.decoder.matrices
        if networks.pose:
            units = self.pose_scale if self.segment else space.increment_scale
            decoder = (*decoder[:-1], jnp.asarray(units)[:, None] * decoder[-1])
        return Explicit(
            operators=Polytope(shared.vertices),
            residual=() if networks.residual == "none" else shared.residual.matrices,
            residual_multipliers=shared.residual.multipliers,
            decoder=decoder,
            decoder_multipliers=shared.decoder.multipliers,
            readout=jnp.asarray(space.body_scale)[:, None] * shared.readout,
            declared=Declared(
                "tanh",
                "rotation" if networks.transport else "identity",
                networks.control,
            ),
        )

    def hinge(self, fiber: SfkdFiber, latent: SfkdLatent, control: Control) -> Scalar:
        """Return the weighted penalty max(0, ||∂r/∂z||_2 − β)² (eq:contr_loss)."""
        biases = fiber.residual_biases.at(self._scaled(control))
        jacobian = jax.jacobian(lambda z: apply(fiber.residual, biases, z))(latent.z)
        excess = jnp.linalg.norm(jacobian, 2) - self.networks.beta
        return self.soft_penalty * jnp.maximum(0.0, excess) ** 2
