"""What a certificate proves, with the witnesses that the trusted core checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias


class Corners:
    """The entries are the lower and the upper corner of a box."""


Row: TypeAlias = tuple[float, ...]
Matrix: TypeAlias = tuple[Row, ...]
Multipliers: TypeAlias = tuple[Row, ...]
"""λ of every hidden layer of a network."""
Box: TypeAlias = Annotated[tuple[Row, Row], Corners()]
"""Lower and upper corner; equal ends are allowed, since a condition may be constant."""


@dataclass(frozen=True, kw_only=True)
class Witnesses:
    """Multipliers with which the core checks `Claims` without a search.

    Attributes:
        residual: of β.
        joint: of the joint α, for every vertex of the operators.
        decoders: of the Lipschitz constants of networks, by output.
    """

    residual: Multipliers
    joint: tuple[Multipliers, ...]
    decoders: dict[str, Multipliers]


@dataclass(frozen=True, kw_only=True)
class Claims:
    """Constants of one step in the 2-norm, with their witnesses.

    Attributes:
        scope: the environments, and how all of them are covered.
        alpha: contraction factor of a step, |F(z) − F(z')| ≤ α |z − z'| for all z, z',
            u and all e of the scope. It is the smaller of the next two.
        alpha_separate: ρ + β.
        alpha_joint: of z ↦ A(e) z + r(z; u, e) as one map.
        rho: ρ = sup_e ||A(e)||.
        beta: β, the Lipschitz constant of the residual r in z.
        lipschitz: Lipschitz constants of the outputs of the frame, by name, and of
            "decoder", position and yaw together, if a decoder gives the pose.
        witnesses: multipliers of all proofs.
    """

    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float
    rho: float
    beta: float
    lipschitz: dict[str, float]
    witnesses: Witnesses


@dataclass(frozen=True, kw_only=True)
class OutputMetric:
    """Constants in the metric of one output.

    The 2-norm weighs all directions of the latent alike, but an output depends on some
    of them only. With a P chosen for its rows C of the read-out, the tube
    |C z| ≤ |C|_{P⁻¹} R of the same weights is several times tighter. This is the
    closed-loop tube of Singh et al. 2017, for one output at a time.

    Attributes:
        alpha: α, with |F(z) − F(z')|_P ≤ α |z − z'|_P for all z, z', w and e.
        lipschitz: L, with |C z| ≤ L |z|_P for the output C z, in its unit.
        metric: P, (rank, rank), of the size 1.
        joint: multipliers of every vertex that prove α.
    """

    alpha: float
    lipschitz: float
    metric: Matrix
    joint: tuple[Multipliers, ...]


@dataclass(frozen=True, kw_only=True)
class LyapunovClaim:
    """A common quadratic Lyapunov function of all operators, as in the paper's theorem.

        A(e)' P A(e) ≤ ρ² P for all e,   λ_max(P) ≤ κ λ_min(P)

    With α < 1 and |d_k| ≤ d̄ in the 2-norm, the theorem follows as

        |e_k| ≤ c_1 α^k |e_0| + c_2 d̄ / (1 − α),   c_1 = c_2 = √κ.

    The paper prints c_2 = 1/√λ_min(P), which depends on the scale of P, although that
    scale is free.

    Attributes:
        rho: ρ.
        condition: κ.
        alpha: α of the whole step with its residual, |F(z) − F(z')|_P ≤ α |z − z'|_P.
        c_1: of the theorem.
        c_2: of the theorem.
        metric: P, (rank, rank), with λ_min(P) = 1.
        joint: multipliers of every vertex that prove α.
    """

    rho: float
    condition: float
    alpha: float
    c_1: float
    c_2: float
    metric: Matrix
    joint: tuple[Multipliers, ...]


@dataclass(frozen=True, kw_only=True)
class Proof(Claims):
    """All that is proved about a model; `certification.verify` checks each entry.

    Attributes:
        transport_lipschitz: Lipschitz constant of T(e → e').
        lyapunov: common Lyapunov function of the operators, or None.
        lyapunov_refused: reason why there is none, or None.
        outputs: metrics of all outputs but "body", by name, or none. With a pose there
            are none.
        env_box: E.
        params_sha256: hash of the weights.
        precision: how the rounding of numbers is accounted for.
        attacks: slopes that attacks reached, by name. They are lower bounds of the
            proved constants.
        tightness: α over the largest slope of a step that an attack on the float32
            model reached; None without such an attack.
    """

    transport_lipschitz: float
    lyapunov: LyapunovClaim | None
    lyapunov_refused: str | None
    outputs: dict[str, OutputMetric]
    env_box: Box
    params_sha256: str
    precision: str
    attacks: dict[str, float]
    tightness: float | None
