"""R2DN: a linear system in feedback with a 1-Lipschitz network."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._networks import (
    FRAMES,
    SMALL,
    Biases,
    Encoder,
    Sandwich,
    Weights,
    bounded,
)
from sfkd_jax.models.sfkd._learned import Networks, PerEnvironment, SharedWeights
from sfkd_jax.models.sfkd._model import LatentModel
from sfkd_jax.ranges import Fraction, check_choice
from sfkd_jax.types import Model, Scalar, Space


class Interconnection(Networks):
    """The linear system, the feedback φ and the decoder; ψ(e) = e; see `r2dn`."""

    hidden: Sequence[int]
    decoder_hidden: Sequence[int]
    alpha: float

    def setup(self) -> None:
        """Declare submodules and parameters, in the order in which keys are drawn."""
        square = (self.rank, self.rank)
        # The identity: slow dynamics, for a car changes little in 0.1 s.
        self.A = self.param("A", lambda key, shape: jnp.eye(*shape), square)
        self.B1 = self.param("B1", SMALL, square)
        self.C1 = self.param("C1", SMALL, square)
        self.phi = Sandwich(self.rank, self.hidden, self.rank)
        if self.pose:
            self.log_decoder_bound = self.param(
                "log_decoder_bound", nn.initializers.constant(1.0), ()
            )
            self.decoder = Sandwich(self.rank, self.decoder_hidden, 3)
            self.decoder_inputs = self._inputs(
                "decoder", sum(self.decoder_hidden) + 3, nn.initializers.lecun_normal()
            )
        self.feedback_inputs = self._inputs(
            "feedback", sum(self.hidden) + self.rank, SMALL
        )
        self.readout = self.param(
            "readout", nn.initializers.orthogonal(), (self.body, self.rank)
        )
        self.centre = self.param("centre", nn.initializers.zeros, (self.body,))

    def _inputs(
        self, name: str, size: int, spread: nn.initializers.Initializer
    ) -> tuple[Array, Array]:
        """The learned biases of all layers of a network, as [u; e] gain + offset."""
        gain = self.param(f"{name}_gain", spread, (self.control + self.embedding, size))
        return gain, self.param(f"{name}_offset", nn.initializers.zeros, (size,))

    def __call__(self, env: Array) -> tuple[SharedWeights, PerEnvironment]:
        """Evaluate every part once, so that init creates all parameters."""
        return self.shared(), self.per_environment(env)

    def rate(self) -> Scalar:
        """Return α, the same for all parameters."""
        return jnp.asarray(self.alpha)

    def shared(self) -> SharedWeights:
        """Return the explicit weights: W_1 = V_1 C₁, …, W_L = B₁ V_L with V of φ."""
        A, B1, C1 = contracting(self.A, self.B1, self.C1, self.alpha)
        # Bound 1: gains belong to B₁ and C₁, which the block above already bounds.
        phi = self.phi(1.0)
        first, *middle, last = phi.matrices
        return SharedWeights(
            # One vertex: e shifts biases only, so that A is the same for all e.
            vertices=A[None],
            # C₁ and B₁ folded in: the certificate is
            # about the very matrices of the step.
            residual=Weights((first @ C1, *middle, B1 @ last), phi.multipliers),
            # An exponential is positive, and a free bound then changes by factors.
            decoder=self.decoder(jnp.exp(self.log_decoder_bound))
            if self.pose
            else Weights(),
            forcing=(),
            readout=bounded(self.readout, 1.0),
            centre=self.centre,
        )

    def per_environment(self, env: Float[Array, " environment"]) -> PerEnvironment:
        """Return the biases at e, which enters linearly and shifts the offsets."""

        def biases(inputs: tuple[Array, Array], widths: Sequence[int]) -> Biases:
            gain, offset = inputs
            # e is constant along a rollout: its product is paid once, not every step.
            offsets = env @ gain[self.control :] + offset
            return Biases.cut(gain[: self.control].T, offsets, widths)

        return PerEnvironment(
            mixture=jnp.ones(1),
            # The bias of the last layer of the feedback is B₂ [u; e] + b.
            B=jnp.zeros((self.rank, self.control)),
            residual=biases(self.feedback_inputs, (*self.hidden, self.rank)),
            decoder=biases(self.decoder_inputs, (*self.decoder_hidden, 3))
            if self.pose
            else Biases(),
            forcing=Biases(),
            # The lift varies with e, but z is not rotated: its metric is common.
            tangents=jnp.zeros(0),
            embedding=env,
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
        rank: of z, and number of inputs and outputs of φ.
        alpha: α, below 1 for a certificate.
        hidden: hidden widths of φ.
        decoder_hidden: hidden widths of D.
        encoder_hidden: hidden width of the encoder.
        frame: "body", or "path" for path coordinates, which have no pose.
    """
    check_choice("model.frame", frame, FRAMES)
    learned = Interconnection(
        rank=rank,
        body=space.body_mean.shape[0],
        control=space.control_mean.shape[0],
        embedding=space.env_mean.shape[0],
        pose=frame == "body",
        transport=False,
        hidden=tuple(hidden),
        decoder_hidden=tuple(decoder_hidden),
        alpha=alpha,
    )
    encoder = Encoder(rank, encoder_hidden)
    return LatentModel(space, learned, encoder, environment).model()
