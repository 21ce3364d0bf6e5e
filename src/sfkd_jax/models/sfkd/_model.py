"""Stable Fiber-Koopman Residual Dynamics: its settings, and the `Model` of them."""

from __future__ import annotations

from dataclasses import replace

from sfkd_jax.models._networks import Encoder
from sfkd_jax.models._planning import Planning
from sfkd_jax.models.sfkd._latent_model import LatentModel
from sfkd_jax.models.sfkd._learned import LOWEST_RATE, Learned
from sfkd_jax.models.sfkd._residual import BUDGETS, RESIDUALS
from sfkd_jax.ranges import Fraction, NonNegativeInt, check_choice
from sfkd_jax.types import BODY_FRAME, Frame, Model, Space

LIFTS = ("network", "state")


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
    frame: Frame = BODY_FRAME,
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

    The model has Koopman operators A(e), a residual with a Lipschitz bound, and an
    isometric transport between environments. For every e, by construction and in
    float32,

    - A(e) = Σ_j w_j(e) A_j with w on the simplex, and z ↦ A_j z + r is α-Lipschitz for
      every j, hence for every mixture, with α = ρ + β;
    - Q is orthogonal, Lip_z D is bounded, and ||C||_2 ≤ 1 in scaled units.

    With `budget="sum"` ||A_j||_2 ≤ ρ by the Gram bound, and Lip_z r ≤ β by sandwich
    layers, whose biases depend on u and e. With "joint" the two share α as one map (see
    `share_budget`). Those maps contain all of the former and more.

    Args:
        space: measured scales, which fix all sizes.
        rank: r; it must be even for a transport. With `lift="state"` it is the size of
            s instead.
        rho: ρ; a certificate needs ρ + β < 1. Of a joint budget only the sum counts.
        beta: β.
        vertices: number of operators A_j.
        residual_hidden: hidden widths of r.
        decoder_hidden: hidden widths of D.
        encoder_hidden: hidden width of φ.
        linear_lift: whether φ contains W_0 s, see `Encoder`.
        lift: "network" for φ, or "state" for z = C⁻¹ (s − c), coordinates in which a
            step contracts. The error of a step is then that of the state alone.
        embedding: size of ψ(e).
        frame: the coordinates of states. A pose is composed on SE(2) outside z; without
            one the body state is all.
        residual: "sandwich", "free" (without a bound by construction; ||A_j|| ≤ ρ) or
            "none" (||A_j|| ≤ ρ).
        budget: "joint" or "sum", of a sandwich residual.
        transport: whether Q(e) is learned; otherwise it is the identity.
        environment: whether e is used.
        soft_penalty: weight of the paper's hinge max(0, ||∂r/∂z||_2 − β)² in the
            training loss (eq:contr_loss).
        learn_alpha: whether training chooses α of a joint budget between `LOWEST_RATE`
            and ρ + β, starting close to the latter.
        forcing_hidden: width of f(u, e) = V tanh(G(e) u + h(e)), which is added to
            B(e) u; 0 for none. It is no function of z, so every bound still holds.
        scheduled: whether the mixture of the A_j reads u as well as e. A closed loop
            depends most on its inputs from the reference, which are part of u.
        planning_residual: whether planners add a residual g to F, see `Planning`. No
            certificate is about g: F alone is certified, and the shield uses F.
    """
    _check_choices(residual, budget, lift)
    state_lift = lift == "state"
    if state_lift:
        rank = space.body_mean.shape[0]
    residual_class = RESIDUALS[residual]
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
        residual_class=residual_class,
        # A residual without a bound has none that the operators could share.
        joint=budget == "joint"
        and residual_class is not None
        and residual_class.is_bounded,
        transport=transport,
        pose=frame.has_pose,
        learn_alpha=learn_alpha,
        forcing_hidden=forcing_hidden,
        state_lift=state_lift,
        scheduled=scheduled,
    )
    _check_combinations(learned, soft_penalty)
    encoder = None if state_lift else Encoder(rank, encoder_hidden, linear_lift)
    latent_model = LatentModel(space, learned, encoder, environment, frame)
    model = replace(latent_model, soft_penalty=soft_penalty, beta=beta).model()
    if planning_residual:
        return Planning(model, space, environment).model()
    return model


def _check_choices(residual: str, budget: str, lift: str) -> None:
    """Raise a ValueError that names a setting with an unknown value."""
    check_choice("model.residual", residual, RESIDUALS)
    check_choice("model.budget", budget, BUDGETS)
    check_choice("model.lift", lift, LIFTS)


def _check_combinations(learned: Learned, soft_penalty: float) -> None:
    """Raise a ValueError for settings that exclude each other."""
    # Planes are pairs of coordinates; of an odd number one would be left over.
    if learned.transport and learned.rank % 2:
        raise ValueError(f"model.transport needs an even rank, got {learned.rank}")
    if soft_penalty and learned.residual_class is None:
        raise ValueError("model.soft_penalty needs a residual, got model.residual=none")
    largest = learned.rho + learned.beta
    # A separate budget has α = ρ + β, with nothing to learn.
    if learned.learn_alpha and (not learned.joint or largest <= LOWEST_RATE):
        raise ValueError(
            "model.learn_alpha needs model.residual=sandwich, model.budget=joint and "
            f"model.rho + model.beta above {LOWEST_RATE}, got {largest}"
        )
