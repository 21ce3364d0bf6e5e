"""The functions of SFKD: encoding, steps, transport and explicit weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import compose
from sfkd_jax.models._networks import Encoder, apply
from sfkd_jax.models.sfkd._learned import Learned, PerEnvironment, SharedWeights
from sfkd_jax.rollout import Folded, unfold
from sfkd_jax.types import (
    POSE,
    Control,
    Declared,
    Environment,
    Explicit,
    Fitting,
    Frame,
    Key,
    Model,
    Params,
    Polytope,
    Pose,
    Scalar,
    Space,
    State,
    Structure,
)


class PosedLatent(NamedTuple):
    """State of a rollout: z and the pose."""

    pose: Pose
    z: Float[Array, " rank"]


class Mixture(NamedTuple):
    """A(e) = Σ_j w_j A_j, not summed.

    In training every step of every window has its own e. Without the sum, the gradient
    with respect to the A_j needs no matrix for each e.

    Attributes:
        weights: w, (vertex,); None for A(e, u), whose weights are known only with u.
        vertices: A_j.
    """

    weights: Any
    vertices: Float[Array, "vertex rank rank"]

    def __matmul__(self, z: Float[Array, " rank"]) -> Float[Array, " rank"]:
        """Return A(e) z."""
        # One product, [A_1 … A_n] [w_1 z; …; w_n z], without a matrix for this e.
        beside = jnp.moveaxis(self.vertices, 0, 1).reshape(z.shape[0], -1)
        return beside @ (self.weights[:, None] * z).ravel()

    def summed(self) -> Float[Array, "rank rank"]:
        """Return A(e), for many steps under one e."""
        return jnp.tensordot(self.weights, self.vertices, axes=1)


class Terms(NamedTuple):
    """Every function of u and e. No bound in z sees a bias.

    Attributes:
        A: A(e), or A(e, u).
        residual: biases of the residual; the last one includes B(e) u + f(u, e).
        decoder: biases of the decoder.
    """

    A: Any
    residual: Any
    decoder: Any


class SfkdFiber(NamedTuple):
    """All that a step needs.

    Attributes:
        A: A(e).
        local: the functions of e.
        shared: the weights that do not depend on e.
        encoder: weights of φ, or C⁻¹ where z is the state.
        terms: the functions of u and e for one control, see `LatentModel.step_fiber`;
            None if they are evaluated in each step.
    """

    A: Mixture | Float[Array, "rank rank"]
    local: PerEnvironment
    shared: SharedWeights
    encoder: Any
    terms: Terms | None = None


@dataclass(frozen=True, eq=False)
class LatentModel:
    """The functions of `Model`.

    Attributes:
        space: measured scales.
        learned: everything that is learned, besides the encoder.
        encoder: φ; None where z is the state.
        environment: whether e is used.
        frame: the coordinates of states.
        soft_penalty: weight of `hinge`.
        beta: bound in `hinge`.
    """

    space: Space
    learned: Learned
    encoder: Encoder | None
    environment: bool
    frame: Frame
    soft_penalty: float = 0.0
    beta: float = 0.0

    def init(self, key: Key) -> Params:
        """Draw initial parameters."""
        network_key, encoder_key = jax.random.split(key)
        body = jnp.zeros(self.learned.body)
        env = jnp.zeros(self.space.env_mean.shape[0])
        # The encoder reads ψ(e), which may have another size than e.
        embedding = jnp.zeros(self.learned.embedding)
        params = {"networks": self.learned.init(network_key, env)["params"]}
        if self.encoder is not None:
            encoder = self.encoder.init(encoder_key, body, embedding)
            params["encoder"] = encoder["params"]
        return params

    def _apply(self, params: Params, method: str, *inputs: Array) -> Any:
        """Call a method of the flax module."""
        weights = {"params": unfold(params)["networks"]}
        return self.learned.apply(weights, *inputs, method=method)

    def shared(self, params: Params) -> SharedWeights:
        """Return the bounded weights; of folded parameters they are known."""
        if isinstance(params, Folded):
            return params.shared
        return cast(SharedWeights, self._apply(params, "shared"))

    def rate(self, params: Params) -> Scalar:
        """Return α."""
        return cast(Scalar, self._apply(params, "rate"))

    def fiber(self, params: Params, env: Environment) -> SfkdFiber:
        """Return all that depends on e, for many steps in it."""
        fiber = self._fiber(params, env)
        local = fiber.local
        A = cast(Mixture, fiber.A)
        # In physical units of u, so that a rollout scales no control.
        gains = tuple(gain / self.space.control_scale for gain in local.gains)
        offsets = _moved(gains, local.offsets, -self.space.control_mean)
        local = local._replace(gains=gains, offsets=offsets)
        operator = A if A.weights is None else A.summed()
        return fiber._replace(A=operator, local=local)

    def step_fiber(
        self, params: Params, env: Environment, control: Control
    ) -> SfkdFiber:
        """Return the fiber of a single step.

        In training every step has its own e and u. What depends on both is then a
        product of weights and ψ(e) ⊗ u, without a gain for each e.
        """
        fiber = self._fiber(params, env)
        scaled = jnp.append(self.space.scaled_control(control), 1.0)
        inputs = jnp.outer(jnp.append(fiber.local.embedding, 1.0), scaled).ravel()
        # The weights are split and not their products, whose gradients would have to be
        # joined again.
        hidden_weights, outer_weights = map(
            jnp.split, self._apply(params, "bilinear"), fiber.shared.ends
        )
        hidden = [weights @ inputs for weights in hidden_weights]
        outer = [weights @ inputs for weights in outer_weights]
        terms = self._joined(fiber, hidden, outer)
        local = fiber.local._replace(gains=(), offsets=())
        return fiber._replace(local=local, terms=terms)

    def _fiber(self, params: Params, env: Environment) -> SfkdFiber:
        """Return the fiber for scaled controls, with operators that are not summed."""
        shared = self.shared(params)
        scaled = self.space.scaled_env(env, self.environment)
        local = cast(PerEnvironment, self._apply(params, "per_environment", scaled))
        encoder = unfold(params)["encoder"] if self.encoder else shared.lift
        return SfkdFiber(
            A=Mixture(local.mixture, shared.vertices),
            local=local,
            shared=shared,
            encoder=encoder,
        )

    def encode(self, fiber: SfkdFiber, state: State) -> PosedLatent:
        """Return the latent of a state, beside its pose."""
        body = self.space.scaled_body(state)
        if self.encoder is None:
            z = fiber.encoder @ (body - fiber.shared.centre)
            return PosedLatent(state[POSE], z)
        z = self.encoder.apply({"params": fiber.encoder}, body, fiber.local.embedding)
        z = cast(jax.Array, z)
        # Rotated after the lift, so the z of two environments differ by an isometry.
        if self.learned.transport:
            z = rotate_planes(fiber.local.tangents, z)
        return PosedLatent(state[POSE], z)

    def step(
        self, fiber: SfkdFiber, latent: PosedLatent, control: Control
    ) -> PosedLatent:
        """Advance z and the pose by one sampling period."""
        terms = self._terms(fiber, control)
        shared = fiber.shared
        linear = terms.A @ latent.z
        z = linear + apply(shared.residual.matrices, terms.residual, latent.z)
        # Without a decoder there is no pose: that of the start stays.
        if not shared.decoder.matrices:
            return PosedLatent(latent.pose, z)
        # The motion during the period starts from z before the step.
        space = self.space
        motion = apply(shared.decoder.matrices, terms.decoder, latent.z)
        # An output of 0 is the average motion of the data.
        motion = space.increment_mean + space.increment_scale * motion
        return PosedLatent(compose(latent.pose, motion), z)

    def _terms(self, fiber: SfkdFiber, control: Control) -> Terms:
        """Return every function of u and e."""
        if fiber.terms is not None:
            return fiber.terms
        tables = _moved(fiber.local.gains, fiber.local.offsets, control)
        hidden, outer = map(jnp.split, tables, fiber.shared.ends)
        return self._joined(fiber, hidden, outer)

    def _joined(
        self, fiber: SfkdFiber, hidden: Sequence[Array], outer: Sequence[Array]
    ) -> Terms:
        """Return `Terms` from the biases of all layers, see `PerEnvironment`.

        Args:
            fiber: of e.
            hidden: biases before a tanh: of residual, decoder and forcing.
            outer: biases of outputs: of residual, decoder and mixture.
        """
        *biases, forcing = hidden
        direct, motion, logits = outer
        residual_layers = max(len(fiber.shared.residual.matrices) - 1, 0)
        A = fiber.A
        # The shapes of the weights decide this when the program is traced.
        if fiber.shared.forcing:
            direct += fiber.shared.forcing[0] @ jnp.tanh(forcing)
        if isinstance(A, Mixture) and A.weights is None:
            # The weights are on the simplex whatever u is, and no function of z, so a
            # step contracts as ever.
            A = A._replace(weights=jax.nn.softmax(logits))
        return Terms(
            A=A,
            residual=(*biases[:residual_layers], direct),
            decoder=(*biases[residual_layers:], motion),
        )

    def decode(self, fiber: SfkdFiber, latent: PosedLatent) -> State:
        """Return the state of a latent."""
        scaled = fiber.shared.readout @ latent.z + fiber.shared.centre
        body = self.space.body_mean + self.space.body_scale * scaled
        return jnp.concatenate([latent.pose, body])

    def transport(
        self, fiber: SfkdFiber, fiber_next: SfkdFiber, latent: PosedLatent
    ) -> PosedLatent:
        """Carry z from the fiber of e to that of e', T(e → e') z = Q(e') Q(e)' z."""
        if not self.learned.transport:
            return latent
        # Through the common coordinates, which gives a cocycle without a matrix.
        unrotated = rotate_planes(-fiber.local.tangents, latent.z)
        return latent._replace(z=rotate_planes(fiber_next.local.tangents, unrotated))

    def observe(
        self, fiber: SfkdFiber, latent: PosedLatent, state: State
    ) -> PosedLatent:
        """Return the latent of a state; z contains nothing of an earlier pose."""
        return self.encode(fiber, state)

    def vector(self, latent: PosedLatent) -> Float[Array, " rank"]:
        """Return z."""
        return latent.z

    def explicit(self, params: Params) -> Explicit:
        """Return the weights that a certificate is about."""
        shared = self.shared(params)
        learned = self.learned
        decoder = shared.decoder.matrices
        if learned.pose:
            # In physical units, so that a certificate needs no scales of the model.
            scale = jnp.asarray(self.space.increment_scale)[:, None]
            decoder = (*decoder[:-1], scale * decoder[-1])
        transport = "rotation" if learned.transport else "identity"
        return Explicit(
            # The vertices and not a mixture: what holds at all of them holds for every
            # e.
            operators=Polytope(shared.vertices),
            residual=shared.residual.matrices,
            residual_multipliers=shared.residual.multipliers,
            decoder=decoder,
            decoder_multipliers=shared.decoder.multipliers,
            readout=jnp.asarray(self.space.body_scale)[:, None] * shared.readout,
            declared=Declared("tanh", transport, learned.control),
        )

    def hinge(self, fiber: SfkdFiber, latent: PosedLatent, control: Control) -> Scalar:
        """Return the weighted penalty max(0, ||∂r/∂z||_2 − β)² (eq:contr_loss)."""
        terms = self._terms(fiber, control)
        matrices = fiber.shared.residual.matrices
        residual = partial(apply, matrices, terms.residual)
        jacobian = jax.jacobian(residual)(latent.z)
        # As in the paper this is a penalty at sampled points, which proves nothing.
        excess = jnp.linalg.norm(jacobian, 2) - self.beta
        return self.soft_penalty * jnp.maximum(0.0, excess) ** 2

    def model(self) -> Model:
        """Return the functions as a `Model`."""
        return Model(
            init=self.init,
            fiber=self.fiber,
            encode=self.encode,
            step=self.step,
            decode=self.decode,
            transport=self.transport,
            observe=self.observe,
            vector=self.vector,
            shared=self.shared,
            fitting=Fitting(
                penalty=self.hinge if self.soft_penalty else None,
                step_fiber=self.step_fiber,
            ),
            structure=Structure(
                explicit=self.explicit,
                # With a free residual a step may contract, but only a certificate can
                # tell.
                rate=self.rate if self.learned.bounded else None,
            ),
            frame=self.frame,
        )


def _moved(
    gains: Sequence[Array], offsets: Sequence[Array], u: Control
) -> tuple[Array, ...]:
    """Return gain u + offset for every table."""
    return tuple(gain @ u + offset for gain, offset in zip(gains, offsets, strict=True))


def rotate_planes(
    tangents: Float[Array, " plane"], z: Float[Array, " rank"]
) -> Float[Array, " rank"]:
    """Return Q z, where Q rotates plane i = (z_i, z_{i + r/2}) by 2 arctan t_i.

    Q = (I − S)⁻¹(I + S) is the Cayley transform of S = diag(t_i J), J = [[0, −1], [1,
    0]], in closed form; −t inverts t exactly. It is as general as a full orthogonal
    Q(e): in the coordinates Q(e)' z the transport is the identity, and A(e), B(e) and
    the networks are conjugated, which a model with free A(e), B(e) represents anyway.
    What matters is that T(e → e') is an isometry and a cocycle with T(e → e) = I.
    """
    first, second = jnp.split(z, 2)
    # Rational in t, without trigonometry, and c² + s² = 1 up to rounding.
    scale = 1.0 / (1.0 + tangents**2)
    cosine = (1.0 - tangents**2) * scale
    sine = 2.0 * tangents * scale
    return jnp.concatenate(
        [cosine * first - sine * second, sine * first + cosine * second]
    )
