"""Stable Fiber-Koopman Residual Dynamics: its functions, and the `Model` of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import compose
from sfkd_jax.models._networks import FRAMES, Encoder, Sandwich, apply
from sfkd_jax.models._planning import Planning
from sfkd_jax.models.sfkd._learned import (
    LOWEST_RATE,
    Learned,
    PerEnvironment,
    SharedWeights,
)
from sfkd_jax.models.sfkd._residual import BUDGETS, RESIDUALS
from sfkd_jax.ranges import Fraction, NonNegativeInt, check_choice
from sfkd_jax.rollout import Folded, unfold
from sfkd_jax.types import (
    POSE,
    Control,
    Declared,
    Environment,
    Explicit,
    Fitting,
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

LIFTS = ("network", "state")


class PosedLatent(NamedTuple):
    """State of a rollout: z and the pose."""

    pose: Pose
    z: Float[Array, " rank"]


class Mixture(NamedTuple):
    """A(e) = Σ_j w_j A_j, not summed.

    In training every step of every window has its own e. Without the sum, the gradient
    with respect to the A_j needs no matrix for each e.
    """

    weights: Any  # (vertex,); None for A(e, u), of which they are known with u
    vertices: Float[Array, "vertex rank rank"]

    def __matmul__(self, z: Float[Array, " rank"]) -> Float[Array, " rank"]:
        """Return A(e) z."""
        # [A_1 … A_n] [w_1 z; …; w_n z]: one product, and never a matrix for this e.
        beside = jnp.moveaxis(self.vertices, 0, 1).reshape(z.shape[0], -1)
        return beside @ (self.weights[:, None] * z).ravel()

    def summed(self) -> Float[Array, "rank rank"]:
        """Return A(e), for many steps under one e."""
        return jnp.tensordot(self.weights, self.vertices, axes=1)


class SfkdFiber(NamedTuple):
    """All that a step needs."""

    A: Mixture | Float[Array, "rank rank"]
    local: PerEnvironment
    shared: SharedWeights
    # Weights of φ, or C⁻¹ where z is the state.
    encoder: Any
    # Of one control, see `LatentModel.step_fiber`; else None.
    terms: tuple[Any, Any, Any] | None = None


@dataclass(frozen=True, eq=False)
class LatentModel:
    """The functions of `Model`.

    `learned` is all that is learned but the encoder, which is None where z is the
    state; the last two are of `hinge`.
    """

    space: Space
    learned: Learned
    encoder: Encoder | None
    environment: bool
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
        """Return the bounded weights, as they are if folded."""
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
        # For controls as they are: a rollout then scales none of its own.
        gains = tuple(gain / self.space.control_scale for gain in local.gains)
        offsets = _moved(gains, local.offsets, -self.space.control_mean)
        local = local._replace(gains=gains, offsets=offsets)
        return fiber._replace(A=A if A.weights is None else A.summed(), local=local)

    def step_fiber(
        self, params: Params, env: Environment, control: Control
    ) -> SfkdFiber:
        """Return the fiber of one step, for training: its e and u are its own.

        What depends on both is a product of weights and ψ(e) ⊗ u, without a gain.
        """
        fiber = self._fiber(params, env)
        scaled = jnp.append(self.space.scaled_control(control), 1.0)
        read = jnp.outer(jnp.append(fiber.local.embedding, 1.0), scaled).ravel()
        # Weights are split, since gradients of split products would be joined.
        tables = map(jnp.split, self._apply(params, "bilinear"), fiber.shared.ends)
        terms = self._joined(fiber, *([part @ read for part in at] for at in tables))
        local = fiber.local._replace(gains=(), offsets=())
        return fiber._replace(local=local, terms=terms)

    def _fiber(self, params: Params, env: Environment) -> SfkdFiber:
        """What fibers are made from, for scaled controls."""
        shared = self.shared(params)
        scaled = self.space.scaled_env(env, self.environment)
        local = cast(PerEnvironment, self._apply(params, "per_environment", scaled))
        encoder = unfold(params)["encoder"] if self.encoder else shared.lift
        return SfkdFiber(
            Mixture(local.mixture, shared.vertices), local, shared, encoder
        )

    def encode(self, fiber: SfkdFiber, state: State) -> PosedLatent:
        """Return the latent of a state, beside its pose."""
        body = self.space.scaled_body(state)
        if self.encoder is None:
            return PosedLatent(
                state[POSE], fiber.encoder @ (body - fiber.shared.centre)
            )
        z = self.encoder.apply({"params": fiber.encoder}, body, fiber.local.embedding)
        z = cast(jax.Array, z)
        # Rotated after the lift, so that z of two environments differ by an isometry.
        if self.learned.transport:
            z = rotate_planes(fiber.local.tangents, z)
        return PosedLatent(state[POSE], z)

    def step(
        self, fiber: SfkdFiber, latent: PosedLatent, control: Control
    ) -> PosedLatent:
        """Advance z and the pose by one sampling period."""
        A, residual, decoder = self._terms(fiber, control)
        shared = fiber.shared
        z = A @ latent.z + apply(shared.residual.matrices, residual, latent.z)
        # Along a path there is no pose: that of the start stays.
        if not shared.decoder.matrices:
            return PosedLatent(latent.pose, z)
        # From z before the step: the motion during the period starts there.
        space = self.space
        motion = apply(shared.decoder.matrices, decoder, latent.z)
        # Mean plus scale: an output of 0 is the average motion of the data.
        motion = space.increment_mean + space.increment_scale * motion
        return PosedLatent(compose(latent.pose, motion), z)

    def _terms(self, fiber: SfkdFiber, control: Control) -> tuple[Any, Any, Any]:
        """Return A and the biases of residual and decoder: every function of u and e.

        The residual's last bias includes B(e) u + f(u, e). No bound in z sees a bias.
        """
        if fiber.terms is not None:
            return fiber.terms
        known = _moved(fiber.local.gains, fiber.local.offsets, control)
        return self._joined(fiber, *map(jnp.split, known, fiber.shared.ends))

    def _joined(
        self, fiber: SfkdFiber, hidden: Sequence[Array], outer: Sequence[Array]
    ) -> tuple[Any, Any, Any]:
        """`_terms` from the biases of every layer."""
        *biases, forcing = hidden
        direct, motion, logits = outer
        inner = max(len(fiber.shared.residual.matrices) - 1, 0)
        A = fiber.A
        # Decided by the shape of the weights, that is, when the program is traced.
        if fiber.shared.forcing:
            direct += fiber.shared.forcing[0] @ jnp.tanh(forcing)
        if isinstance(A, Mixture) and A.weights is None:
            # On the simplex whatever u is, and no function of z: it contracts as ever.
            A = A._replace(weights=jax.nn.softmax(logits))
        return A, (*biases[:inner], direct), (*biases[inner:], motion)

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
        # There and back through the common coordinates: a cocycle without a matrix.
        unrotated = rotate_planes(-fiber.local.tangents, latent.z)
        return latent._replace(z=rotate_planes(fiber_next.local.tangents, unrotated))

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
            # The vertices, not a mixture: what holds at each of them holds for every e.
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
        _, at, _ = self._terms(fiber, control)
        matrices = fiber.shared.residual.matrices
        jacobian = jax.jacobian(lambda z: apply(matrices, at, z))(latent.z)
        # As the paper has it: a penalty at sampled points, which proves nothing.
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
            # z holds nothing of an earlier pose.
            observe=lambda fiber, latent, state: self.encode(fiber, state),
            vector=lambda latent: latent.z,
            shared=self.shared,
            fitting=Fitting(
                penalty=self.hinge if self.soft_penalty else None,
                step_fiber=self.step_fiber,
            ),
            # A free residual may contract, but only a certificate can tell.
            structure=Structure(
                self.explicit, self.rate if self.learned.bounded else None
            ),
            along_path=not self.learned.pose,
        )


def sfkd(
    space: Space,
    *,
    rank: int = 32,
    rho: Fraction = 0.895,
    beta: Fraction = 0.1,
    vertices: int = 8,
    residual_hidden: tuple[int, ...] = (32, 32),
    decoder_hidden: tuple[int, ...] = (64, 32),
    encoder_hidden: int = 32,
    linear_lift: bool = True,
    lift: str = "network",
    embedding: int = 16,
    frame: str = "body",
    residual: str = "sandwich",
    budget: str = "joint",
    transport: bool = True,
    environment: bool = True,
    soft_penalty: float = 0.0,
    learn_alpha: bool = False,
    forcing_hidden: NonNegativeInt = 0,
    scheduled: bool = False,
    planning_residual: bool = False,
) -> Model:
    """Stable Fiber-Koopman Residual Dynamics (eq:sfkd).

        z = Q(e) φ(s, ψ(e)),   z⁺ = A(e) z + B(e) u + r(z; u, e),
        z ← T(e → e') z on a switch,   g⁺ = g ∘ D(z; u, e),   s = C z + c

    Koopman operators A(e), a residual with a Lipschitz bound, and isometric transport.
    For every e, by construction and in float32: A(e) = Σ_j w_j(e) A_j with w on the
    simplex, and z ↦ A_j z + r is α-Lipschitz for every j, hence for every mixture, α =
    ρ + β; Q orthogonal; Lip_z D bounded; ||C||_2 ≤ 1 in scaled units. With
    `budget="sum"` ||A_j||_2 ≤ ρ by the Gram bound and Lip_z r ≤ β (sandwich layers; u
    and e are biases); with "joint" the two share α as one map (see `share_budget`),
    which contains all of those and more.

    Args:
        rank: r, even where there is transport; with `lift="state"` it is the size of s
            instead.
        rho: ρ; ρ + β < 1 for a certificate. Of a joint budget only the sum counts.
        beta: β.
        vertices: number of operators A_j.
        residual_hidden: hidden widths of r.
        decoder_hidden: hidden widths of D.
        encoder_hidden: hidden width of φ.
        linear_lift: whether φ contains W_0 s, see `Encoder`.
        lift: "network" is φ; "state" is z = C⁻¹ (s − c), coordinates in which a step
            contracts: its error is then that of the state alone.
        embedding: size of ψ(e).
        frame: "body" composes the pose on SE(2) outside z; "path" has path coordinates
            as body (see `geometry`) and no pose.
        residual: "sandwich", "free" (no bound by construction; ||A_j|| ≤ ρ) or "none"
            (||A_j|| ≤ ρ).
        budget: "joint" or "sum", of a sandwich residual.
        transport: learn Q(e); otherwise it is the identity.
        soft_penalty: weight of the paper's hinge max(0, ||∂r/∂z||_2 − β)² in the
            training loss (eq:contr_loss).
        learn_alpha: let training choose α of a joint budget between `LOWEST_RATE` and ρ
            + β, starting close to the latter.
        forcing_hidden: width of f(u, e) = V tanh(G(e) u + h(e)), added to B(e) u; 0 for
            none. It is no function of z, so every bound still holds.
        scheduled: let the mixture of the A_j read u as well as e: along a path its
            reference speed and curvature, on which the loop's dynamics depend most.
        planning_residual: whether planners add to F a residual g that no certificate is
            about, see `Planning`: F stays what is certified, guarded and compared with.
    """
    check_choice("model.frame", frame, FRAMES)
    check_choice("model.residual", residual, RESIDUALS)
    check_choice("model.budget", budget, BUDGETS)
    check_choice("model.lift", lift, LIFTS)
    kind = RESIDUALS[residual]
    state_lift = lift == "state"
    if state_lift:
        rank = space.body_mean.shape[0]
    # Planes are pairs of coordinates; of an odd number one would be left over.
    if transport and rank % 2:
        raise ValueError(f"model.transport needs an even rank, got {rank}")
    if soft_penalty and kind is None:
        raise ValueError("model.soft_penalty needs a residual, got model.residual=none")
    learned = Learned(
        rank=rank,
        body=space.body_mean.shape[0],
        control=space.control_mean.shape[0],
        vertices=vertices,
        residual_hidden=tuple(residual_hidden),
        decoder_hidden=tuple(decoder_hidden),
        embedding=embedding,
        rho=rho,
        beta=beta,
        kind=kind,
        # A residual without a bound has none that could be shared.
        joint=budget == "joint" and kind is Sandwich,
        transport=transport,
        # Along a path the offsets are part of s, and there is no pose to decode.
        pose=frame != "path",
        learn_alpha=learn_alpha,
        forcing_hidden=forcing_hidden,
        state_lift=state_lift,
        scheduled=scheduled,
    )
    # A separate budget has α = ρ + β, with nothing to learn.
    if learn_alpha and (not learned.joint or rho + beta <= LOWEST_RATE):
        raise ValueError(
            "model.learn_alpha needs model.residual=sandwich, model.budget=joint and "
            f"model.rho + model.beta above {LOWEST_RATE}, got {rho + beta}"
        )
    encoder = None if state_lift else Encoder(rank, encoder_hidden, linear_lift)
    model = LatentModel(
        space, learned, encoder, environment, soft_penalty, beta
    ).model()
    return Planning(model, space, environment).model() if planning_residual else model


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
    Q(e): in the coordinates Q(e)' z the transport is the identity and A(e), B(e) and
    the networks are conjugated, which a model with free A(e), B(e) represents anyway.
    What matters is that T(e → e') is an isometry, T(e → e) = I, and a cocycle.
    """
    first, second = jnp.split(z, 2)
    # Rational in t: no trigonometry, and c² + s² = 1 up to rounding.
    scale = 1.0 / (1.0 + tangents**2)
    cosine = (1.0 - tangents**2) * scale
    sine = 2.0 * tangents * scale
    return jnp.concatenate(
        [cosine * first - sine * second, sine * first + cosine * second]
    )
