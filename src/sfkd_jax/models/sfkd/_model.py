"""Stable Fiber-Koopman Residual Dynamics, assembled as a `Model`."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp

from sfkd_jax.models.sfkd._dynamics import Dynamics
from sfkd_jax.models.sfkd._networks import Encoder, Networks
from sfkd_jax.models.sfkd._settings import check_settings
from sfkd_jax.models.sfkd._start import identify_start
from sfkd_jax.ranges import Fraction, NonNegativeInt
from sfkd_jax.types import Fitting, Model, Space, Structure

SEGMENT_STEPS = 20.0
"""Pose increments per unit of the segment-frame pose: the paper's horizon."""


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
    embedding: int = 16,
    frame: str = "body",
    residual: str = "sandwich",
    budget: str = "joint",
    transport: bool = True,
    environment: bool = True,
    soft_penalty: float = 0.0,
    learn_alpha: bool = False,
    forcing_hidden: NonNegativeInt = 0,
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
        space: measured scales; fixes all sizes.
        rank: r, even.
        rho: ρ; ρ + β < 1 for a certificate. Of a joint budget only the sum counts.
        beta: β.
        vertices: number of operators A_j.
        residual_hidden: hidden widths of r.
        decoder_hidden: hidden widths of D.
        encoder_hidden: hidden width of φ.
        linear_lift: whether φ contains W_0 s, see `Encoder`.
        embedding: size of ψ(e).
        frame: "body" composes the pose on SE(2) outside z; "segment" is the paper's
            reading, the pose relative to the start of the window inside z; "path" has
            path coordinates as body (see `geometry`) and no pose.
        residual: "sandwich", "free" (no bound by construction; ||A_j|| ≤ ρ) or "none"
            (||A_j|| ≤ ρ).
        budget: "joint" or "sum", of a sandwich residual.
        transport: learn Q(e); otherwise it is the identity.
        environment: whether e is used.
        soft_penalty: weight of the paper's hinge max(0, ||∂r/∂z||_2 − β)² in the
            training loss (eq:contr_loss).
        learn_alpha: let training choose α of a joint budget between `LOWEST_RATE` and ρ
            + β, starting close to the latter.
        forcing_hidden: width of f(u, e) = V tanh(G(e) u + h(e)), added to B(e) u; 0 for
            none. It is no function of z, so every bound still holds.

    Raises:
        ValueError: unknown frame or residual, odd rank, or bounds outside (0, 1).
    """
    check_settings(rank, rho, beta, frame, residual, budget, learn_alpha)
    body, control = space.body_mean.shape[0], space.control_mean.shape[0]
    pose = frame != "path"
    hidden = tuple(residual_hidden), tuple(decoder_hidden)
    bounds = (rho, beta, residual, transport, budget, pose, learn_alpha, forcing_hidden)
    networks = Networks(rank, body, control, vertices, *hidden, embedding, *bounds)
    dynamics = Dynamics(
        space,
        networks,
        Encoder(rank, encoder_hidden, linear_lift),
        pose_scale=jnp.asarray(space.increment_scale) * SEGMENT_STEPS,
        segment=frame == "segment",
        environment=environment,
        soft_penalty=soft_penalty,
    )
    model = Model(
        init=dynamics.init,
        fiber=dynamics.fiber,
        encode=dynamics.encode,
        step=dynamics.step,
        decode=dynamics.decode,
        transport=dynamics.transport,
        observe=dynamics.observe,
        vector=lambda latent: latent.z,
        shared=dynamics.shared,
        structure=Structure(
            explicit=dynamics.explicit,
            rate=dynamics.rate if residual != "free" else None,
        ),
        along_path=not pose,
    )
    return model._replace(
        fitting=Fitting(
            start=partial(identify_start, model, dynamics),
            penalty=dynamics.hinge if soft_penalty else None,
        )
    )
