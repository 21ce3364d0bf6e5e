"""R2DN: a linear system in feedback with a 1-Lipschitz network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import compose
from sfkd_jax.models._networks import (
    SMALL,
    Biases,
    Encoder,
    PosedLatent,
    Sandwich,
    Weights,
    apply,
    bounded,
    has_pose,
    scaled_body,
    scaled_control,
    scaled_env,
)
from sfkd_jax.ranges import Fraction
from sfkd_jax.rollout import Folded, unfold
from sfkd_jax.types import (
    POSE,
    Control,
    Declared,
    Environment,
    Explicit,
    Key,
    Model,
    Params,
    Polytope,
    Scalar,
    Space,
    State,
    Structure,
)


class Affine(NamedTuple):
    """The biases of all layers of a network, concatenated, as [u; e] gain + offset."""

    gain: Float[Array, "inputs all"]
    offset: Float[Array, " all"]


class R2dnWeights(NamedTuple):
    """Plain weights, with all bounds enforced.

    Attributes:
        A: of z⁺ = A z + W_L tanh(… W_1 z …).
        feedback: W_1 = V_1 C₁, …, W_L = B₁ V_L with V of φ, and φ's multipliers, which
            prove α for the whole step.
        feedback_inputs: biases of the feedback; the last one is B₂ [u; e] + b.
        decoder: of the pose increment; empty without a pose.
        decoder_inputs: biases of the decoder; None without a pose.
        readout: C of the body state.
        centre: c of the body state.
    """

    A: Float[Array, "rank rank"]
    feedback: Weights
    feedback_inputs: Affine
    decoder: Weights
    decoder_inputs: Affine | None
    readout: Float[Array, "body rank"]
    centre: Float[Array, " body"]


class Interconnection(nn.Module):
    """Everything learned except the encoder.

    Attributes:
        rank: size of z.
        body: size of s.
        inputs: size of [u; e].
        hidden: hidden widths of φ.
        decoder_hidden: hidden widths of the decoder.
        alpha: α.
        pose: whether there is a decoder of the pose.
    """

    rank: int
    body: int
    inputs: int
    hidden: Sequence[int]
    decoder_hidden: Sequence[int]
    alpha: float
    pose: bool = True

    @nn.compact
    def __call__(self) -> R2dnWeights:
        """Return the explicit weights."""
        square = (self.rank, self.rank)
        A, B1, C1 = contracting(
            # The identity: slow dynamics, for a car changes little in 0.1 s.
            self.param("A", lambda key, shape: jnp.eye(*shape), square),
            self.param("B1", SMALL, square),
            self.param("C1", SMALL, square),
            self.alpha,
        )
        # Bound 1: gains belong to B₁ and C₁, which the block above already bounds.
        phi = Sandwich(self.rank, self.hidden, self.rank, name="phi")(1.0)
        first, *middle, last = phi.matrices
        decoder, decoder_inputs = self._decoder() if self.pose else (Weights(), None)
        return R2dnWeights(
            A=A,
            # C₁ and B₁ folded in: the certificate is
            # about the very matrices of the step.
            feedback=Weights((first @ C1, *middle, B1 @ last), phi.multipliers),
            feedback_inputs=self._affine(
                "feedback", sum(self.hidden) + self.rank, SMALL
            ),
            decoder=decoder,
            decoder_inputs=decoder_inputs,
            readout=bounded(
                self.param(
                    "readout", nn.initializers.orthogonal(), (self.body, self.rank)
                ),
                1.0,
            ),
            centre=self.param("centre", nn.initializers.zeros, (self.body,)),
        )

    def _decoder(self) -> tuple[Weights, Affine]:
        """Weights and biases of the decoder of the pose increment."""
        # An exponential is positive, and a free bound then changes by factors.
        bound = jnp.exp(
            self.param("log_decoder_bound", nn.initializers.constant(1.0), ())
        )
        weights = Sandwich(self.rank, self.decoder_hidden, 3, name="decoder")(bound)
        return weights, self._affine(
            "decoder", sum(self.decoder_hidden) + 3, nn.initializers.lecun_normal()
        )

    def _affine(
        self, name: str, size: int, spread: nn.initializers.Initializer
    ) -> Affine:
        """The learned biases of one network."""
        gain = self.param(f"{name}_gain", spread, (self.inputs, size))
        return Affine(
            gain, self.param(f"{name}_offset", nn.initializers.zeros, (size,))
        )


def contracting(
    A: Float[Array, "rank rank"],
    B1: Float[Array, "rank w"],
    C1: Float[Array, "v rank"],
    alpha: float,
) -> tuple[Float[Array, "rank rank"], Float[Array, "rank w"], Float[Array, "v rank"]]:
    """Return (α Ã, B̃₁, α C̃₁) from free matrices, with ‖[Ã B̃₁; C̃₁ 0]‖₂ ≤ 1.

    [Ã B̃₁; C̃₁ 0] = [A B₁; C₁ 0] / max(1, Gram bound of [A B₁; C₁ 0]).
    """
    # No direct term: φ may not feed its own input within a step.
    zeros = jnp.zeros((C1.shape[0], B1.shape[1]))
    # One bound for the whole block is less conservative than one for each part.
    block = bounded(jnp.block([[A, B1], [C1, zeros]]), 1.0)
    rows, columns = A.shape
    # No α at B₁: the inequality has α² at |Δz|² and 1 at |Δw|².
    return (
        alpha * block[:rows, :columns],
        block[:rows, columns:],
        alpha * block[rows:, :columns],
    )


class R2dnFiber(NamedTuple):
    """All that is constant along a rollout; only the biases and `env` depend on e."""

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
    alpha: Fraction = 0.995,
    hidden: tuple[int, ...] = (32, 32),
    decoder_hidden: tuple[int, ...] = (64, 32),
    encoder_hidden: int = 32,
    environment: bool = True,
    frame: str = "body",
) -> Model:
    """Robust recurrent deep network (R2DN), contracting by construction.

        z⁺ = A z + B₁ φ(C₁ z; u, e) + B₂ [u; e] + b
        g⁺ = g ∘ D(z; u, e),   s = C z + c

    An LTI system in feedback with a 1-Lipschitz network φ; the pose is composed on
    SE(2) outside z. φ is a sandwich network; u and e (scaled) are biases of each of its
    layers, so D₁₂ [u; e] of the paper is part of the first one. For two trajectories
    under the same u and e let Δz be their difference, Δv = C₁ Δz and Δw that of φ. By
    construction, without any search,

        |A Δz + B₁ Δw|² + |C₁ Δz|² ≤ α² |Δz|² + |Δw|²,
        that is  ‖[A/α  B₁; C₁/α  0]‖₂ ≤ 1,

    and |Δw| ≤ |Δv|. The sum of both is |Δz⁺| ≤ α |Δz|. The metric of the paper is P = I
    here: encoder, decoder and read-out absorb P^(1/2), and B₁, C₁ the multiplier of φ's
    bound. A single bound for A and the feedback together is less conservative than
    ρ + β. Source: Barbara, Wang and Manchester, arXiv 2504.01250; its controls and
    observations are ours, as for SFKD.

    Args:
        space: measured scales; fixes all sizes.
        rank: of z, and number of inputs and outputs of φ.
        alpha: α, below 1 for a certificate.
        hidden: hidden widths of φ.
        decoder_hidden: hidden widths of D.
        encoder_hidden: hidden width of the encoder.
        environment: whether e is used.
        frame: "body", or "path" for path coordinates, which have no pose.

    Raises:
        ValueError: an unknown frame, rank below 1, α outside (0, 1), or no hidden layer
            in φ or D.
    """
    _check(rank, alpha, hidden, decoder_hidden)
    pose = has_pose(frame)
    body = space.body_mean.shape[0]
    inputs = space.control_mean.shape[0] + space.env_mean.shape[0]
    weights = Interconnection(
        rank, body, inputs, tuple(hidden), tuple(decoder_hidden), alpha, pose
    )
    functions = _R2dn(space, weights, Encoder(rank, encoder_hidden), environment)
    return Model(
        init=functions.init,
        fiber=functions.fiber,
        encode=functions.encode,
        step=functions.step,
        decode=functions.decode,
        # The lift of a state varies with e, but z is not rotated: its metric is common.
        transport=lambda fiber, fiber_next, latent: latent,
        observe=lambda fiber, latent, state: functions.encode(fiber, state),
        vector=lambda latent: latent.z,
        shared=functions.shared,
        structure=Structure(explicit=functions.explicit, rate=functions.rate),
        along_path=not pose,
    )


@dataclass(frozen=True, eq=False)
class _R2dn:
    """The functions of the model.

    Attributes:
        space: measured scales.
        weights: everything learned except the encoder.
        encoder: of the body state.
        environment: whether e is used.
    """

    space: Space
    weights: Interconnection
    encoder: Encoder
    environment: bool

    def init(self, key: Key) -> Params:
        """Draw initial parameters."""
        weights_key, encoder_key = jax.random.split(key)
        body, env = (
            jnp.zeros(part.shape[0])
            for part in (self.space.body_mean, self.space.env_mean)
        )
        return {
            "weights": self.weights.init(weights_key)["params"],
            "encoder": self.encoder.init(encoder_key, body, env)["params"],
        }

    def shared(self, params: Params) -> R2dnWeights:
        """Return the explicit weights, as they are if folded."""
        # Bounded once before driving, not again at every control step.
        if isinstance(params, Folded):
            return params.shared
        return cast(R2dnWeights, self.weights.apply({"params": params["weights"]}))

    def fiber(self, params: Params, env: Environment) -> R2dnFiber:
        """Return the explicit weights with the biases of one environment."""
        shared = self.shared(params)
        scaled = scaled_env(self.space, env, self.environment)
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
            # Not shared: nothing in the encoder is bounded, so nothing is precomputed.
            encoder=unfold(params)["encoder"],
        )

    def encode(self, fiber: R2dnFiber, state: State) -> PosedLatent:
        """Return the latent of a state."""
        scaled = scaled_body(self.space, state)
        z = self.encoder.apply({"params": fiber.encoder}, scaled, fiber.env)
        return PosedLatent(state[POSE], cast(jax.Array, z))

    def step(
        self, fiber: R2dnFiber, latent: PosedLatent, control: Control
    ) -> PosedLatent:
        """Advance z and the pose by one sampling period."""
        space = self.space
        u = scaled_control(space, control)
        # The feedback holds C₁, φ and B₁ as one network, as it is certified.
        z = fiber.A @ latent.z + apply(
            fiber.feedback, fiber.feedback_biases.at(u), latent.z
        )
        # Path coordinates have no pose; the entry stays what it was.
        if not self.weights.pose:
            return PosedLatent(latent.pose, z)
        # From z before the step, together with u: the motion during the period.
        motion = apply(fiber.decoder, fiber.decoder_biases.at(u), latent.z)
        return PosedLatent(
            compose(latent.pose, space.increment_mean + space.increment_scale * motion),
            z,
        )

    def decode(self, fiber: R2dnFiber, latent: PosedLatent) -> State:
        """Return the state of a latent."""
        scaled = fiber.readout @ latent.z + fiber.centre
        return jnp.concatenate(
            [latent.pose, self.space.body_mean + self.space.body_scale * scaled]
        )

    def rate(self, params: Params) -> Scalar:
        """Return α, the same for all parameters."""
        # By construction, not learned: no parameter can change it.
        del params
        return jnp.asarray(self.weights.alpha)

    def explicit(self, params: Params) -> Explicit:
        """Return the weights that a certificate is about."""
        shared, space = self.shared(params), self.space
        # In physical units, as for SFKD.
        decoder = shared.decoder.matrices
        if self.weights.pose:
            decoder = (
                *decoder[:-1],
                jnp.asarray(space.increment_scale)[:, None] * decoder[-1],
            )
        return Explicit(
            # One vertex: e shifts biases only, so that A is the same for all e.
            operators=Polytope(shared.A[None]),
            residual=shared.feedback.matrices,
            residual_multipliers=shared.feedback.multipliers,
            decoder=decoder,
            decoder_multipliers=shared.decoder.multipliers,
            readout=jnp.asarray(space.body_scale)[:, None] * shared.readout,
            declared=Declared("tanh", "identity", space.control_mean.shape[0]),
        )


def _biases(
    inputs: Affine | None, matrices: tuple[Float[Array, "_ _"], ...], env: Environment
) -> Biases:
    """b_k(u, e) of every layer; e enters linearly and shifts the offsets."""
    if inputs is None:
        return Biases()
    widths = [matrix.shape[0] for matrix in matrices]
    # Inner edges only, as `split` wants them.
    edges = [sum(widths[: k + 1]) for k in range(len(widths) - 1)]
    controls = inputs.gain.shape[0] - env.shape[0]
    gains = jnp.split(inputs.gain[:controls].T, edges)
    # e is constant along a rollout: its product is paid once, not every step.
    offsets = jnp.split(env @ inputs.gain[controls:] + inputs.offset, edges)
    return Biases(tuple(gains), tuple(offsets))


def _check(
    rank: int, alpha: float, hidden: tuple[int, ...], decoder_hidden: tuple[int, ...]
) -> None:
    """Raise ValueError for invalid settings."""
    if rank < 1:
        raise ValueError(f"model.rank must be at least 1, got {rank}")
    # α = 1 would prove nothing, and a tube divides by 1 − α.
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"model.alpha must lie in (0, 1), got {alpha}")
    if not hidden or not decoder_hidden:
        raise ValueError(
            "model.hidden and model.decoder_hidden need a layer each, "
            f"got {hidden} and {decoder_hidden}"
        )
