"""Search for multipliers and constants. Only the trusted core decides what holds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy  # its parts are imported where they are used, not to verify

from sfkd_jax.certificate import Claims, Witnesses
from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    decoders,
    hull_scope,
    readouts,
    rows,
)
from sfkd_jax.certification._core import (
    Matrix,
    Vector,
    check_witness,
    norm_upper,
    witness_matrix,
)
from sfkd_jax.certification._weights import Exported, one_thread, require
from sfkd_jax.types import Frame

SCALES = np.geomspace(0.25, 4.0, 33)
"""Common factors of the multipliers that are tried."""
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)
"""Relative slacks on a bound that are tried. The core accepts it with the smallest that
is above its rounding.
"""
NEGLIGIBLE = 1e-4
"""Bound that is tried last, for a network that is so small that rounding hides it."""
SHARPNESS = (8, 64, 512)
"""Exponents of the p-norm that smooths the largest eigenvalue, one L-BFGS run each."""
INFEASIBLE = 1e3
"""Value of the logarithmic objective where the multipliers prove nothing."""


@one_thread()
def prove_claims(weights: Exported, frame: Frame) -> Claims:
    """Search for the smallest constants that the core accepts.

    Args:
        weights: of the model.
        frame: of the model.

    Raises:
        CertificationRefused: no bound of the residual or of the decoder is proved.
    """
    unproved = "no multipliers prove a Lipschitz bound of the"
    residual_bound, multipliers = _best_multipliers(
        weights.residual, weights.residual_multipliers
    )
    beta = COMPILATION_SLACK * residual_bound
    require(np.isfinite(beta), f"{unproved} residual")
    rho = COMPILATION_SLACK * max(map(norm_upper, weights.operators.vertices))
    alpha_joint, joint_multipliers = joint_bound(weights, multipliers)
    lipschitz = {
        name: COMPILATION_SLACK * norm_upper(matrix)
        for name, matrix in readouts(weights, frame).items()
    }
    of_decoders = {}
    for name, network in decoders(weights).items():
        bound, proving = _best_multipliers(network, weights.decoder_multipliers)
        lipschitz[name] = COMPILATION_SLACK * bound
        of_decoders[name] = rows(proving)
    require(np.all(np.isfinite([*lipschitz.values()])), f"{unproved} decoder")
    alpha_separate = rho + beta
    return Claims(
        scope=hull_scope(weights),
        alpha=min(alpha_separate, alpha_joint),
        alpha_separate=alpha_separate,
        alpha_joint=alpha_joint,
        rho=rho,
        beta=beta,
        lipschitz=lipschitz,
        witnesses=Witnesses(
            residual=rows(multipliers),
            joint=rows(joint_multipliers),
            decoders=of_decoders,
        ),
    )


def joint_bound(
    weights: Exported, start: Sequence[Vector]
) -> tuple[float, list[list[Vector]]]:
    """Return α of z ↦ A z + r(z) as one map, and multipliers for each vertex.

    Args:
        weights: of the model.
        start: multipliers of the residual, where the search begins.
    """
    bounds = []
    witnesses = []
    for vertex in weights.operators.vertices:
        # The search at a vertex begins at the answer of the vertex before, since their
        # operators are similar.
        start = propose_multipliers(weights.residual, start, vertex)
        bound, start = lipschitz_upper(weights.residual, start, vertex)
        bounds.append(bound)
        witnesses.append(start)
    return COMPILATION_SLACK * max(bounds), witnesses


def _best_multipliers(
    weights: Sequence[Matrix], start: Sequence[Vector]
) -> tuple[float, list[Vector]]:
    """Return the smallest bound of a network, and the multipliers that prove it.

    Args:
        weights: W_1 … W_L; () for no network.
        start: multipliers that the model proposes, or ().
    """
    if not weights:
        return 0.0, []
    # A single layer is linear, and its norm is exact. A last layer of zeros makes the
    # network constant.
    if len(weights) < 2 or not np.any(weights[-1]):
        return norm_upper(weights[-1]), []
    searched = lipschitz_upper(weights, propose_multipliers(weights, start))
    if not start:
        return searched
    # The model's multipliers prove the bound that it was designed for, which L-BFGS may
    # miss.
    designed = lipschitz_upper(weights, start)
    return searched if searched[0] < designed[0] else designed


def lipschitz_upper(
    weights: Sequence[Matrix],
    multipliers: Sequence[Vector],
    linear: Matrix | None = None,
) -> tuple[float, list[Vector]]:
    """Return the smallest Lipschitz bound that scaled multipliers prove, or infinity.

    Args:
        weights: W_1 … W_L of a network with slopes in [0, 1].
        multipliers: λ of its hidden layers.
        linear: A of a map A z that is added to the network, or None.

    Returns:
        The bound, and the multipliers with the factor that proves it.
    """
    if not multipliers and len(weights) <= 1:
        matrices = [
            np.asarray(matrix, dtype=np.float64)
            for matrix in (*weights, linear)
            if matrix is not None
        ]
        total = sum(matrices[1:], matrices[0])
        # The rounding of the sum itself, which `norm_upper` does not know.
        rounding = (len(matrices) - 1) * 1e-12
        return norm_upper(total) * (1 + rounding), []
    if len(multipliers) != len(weights) - 1:
        return float("inf"), []
    best_bound = float("inf")
    best_multipliers: list[Vector] = []
    # A common factor of the multipliers changes the bound.
    for scale in SCALES:
        scaled = [scale * np.asarray(part, dtype=np.float64) for part in multipliers]
        eigenvalues, *_ = reduced(weights, scaled, linear)
        guess = float(np.sqrt(np.max(eigenvalues)))
        bounds = [guess * (1 + slack) for slack in SLACKS]
        for bound in (*bounds, max(NEGLIGIBLE, bounds[-1])):
            # A bound that is not better than the best is not made better by more slack.
            if not bound < best_bound:
                break
            # The eigenvalue is rounded. The core decides.
            if check_witness(weights, scaled, bound, linear):
                best_bound = bound
                best_multipliers = scaled
                break
    return best_bound, best_multipliers


def propose_multipliers(
    weights: Sequence[Matrix],
    start: Sequence[Vector] = (),
    linear: Matrix | None = None,
) -> list[Vector]:
    """Return multipliers near the LipSDP optimum, by L-BFGS over their logarithms.

    For fixed multipliers the best bound is the root of the largest eigenvalue of the
    Schur complement C'S⁻¹C − K. With a top eigenvector v and the hidden values
    y = −S⁻¹Cv, its gradient with respect to λ_k is −2 y_k ∘ (y_k − W_k y_{k−1}).

    Args:
        weights: W_1 … W_L of a network with slopes in [0, 1].
        start: multipliers where the search begins; () for those that prove the product
            of norms.
        linear: A of a map A z that is added to the network, or None.

    Returns:
        The multipliers; none for a linear network or one that is not finite.
    """
    weights = [np.asarray(weight, dtype=np.float64) for weight in weights]
    if len(weights) < 2 or not all(np.all(np.isfinite(part)) for part in weights):
        return []
    first = _starting_point(weights, start, linear)
    # A constant network needs no multipliers, and the search would drive them to zero.
    if not np.any(weights[-1]):
        return first
    widths = np.cumsum([len(part) for part in first])[:-1]
    logs = np.log(np.concatenate(first))

    def objective(logs: Vector, sharpness: int) -> tuple[float, Vector]:
        multipliers = np.split(np.exp(logs), widths)
        eigenvalues, vectors, hidden = reduced(weights, multipliers, linear)
        if not np.all(np.isfinite(eigenvalues)):
            return INFEASIBLE, np.zeros_like(logs)
        largest = eigenvalues[-1]
        # Eigenvalues below 0 count as 0, since their powers would be NaN.
        powers = np.maximum(eigenvalues / largest, 0.0) ** (sharpness - 1)
        total = np.sum(powers * eigenvalues / largest)
        gradient = []
        for k, (before, here) in enumerate(pairwise([vectors, *hidden])):
            slopes = -2.0 * here * (here - weights[k] @ before)
            gradient.append(multipliers[k] * (slopes @ powers) / (largest * total))
        value = 0.5 * (np.log(largest) + np.log(total) / sharpness)
        return value, 0.5 * np.concatenate(gradient)

    # From smooth to sharp: the gradient of a sharp p-norm knows the top vector alone.
    for sharpness in SHARPNESS:
        logs = scipy.optimize.minimize(
            objective,
            logs,
            args=(sharpness,),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 150, "maxcor": 30},
        ).x
    return np.split(np.exp(logs), widths)


def _starting_point(
    weights: list[Matrix], start: Sequence[Vector], linear: Matrix | None
) -> list[Vector]:
    """Return `start` if it proves anything, else λ_k = Π_{j>k} ||W_j||², rescaled."""
    squares = [max(float(np.linalg.norm(weight, 2)) ** 2, 1e-6) for weight in weights]
    # A thousandth above the product of norms, so that the inequality is strict.
    from_norms = [
        np.full(len(weights[k]), 1.001 * np.prod(squares[k + 1 :]))
        for k in range(len(weights) - 1)
    ]
    # `lipschitz_upper` finds the common factor with which they prove most.
    for multipliers in (start, from_norms):
        if multipliers:
            _, scaled = lipschitz_upper(weights, multipliers, linear)
            if scaled:
                return scaled
    return from_norms


def reduced(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], linear: Matrix | None
) -> tuple[Vector, Matrix, list[Matrix]]:
    """Return the eigenvalues and vectors of C'S⁻¹C − K, and y, as in LipSDP.

    [K, C'; C, S] are the blocks of `witness_matrix` without a bound, for the inputs and
    the hidden layers. Nothing here is rigorous.

    Returns:
        The eigenvalues in ascending order, the eigenvectors, and y of every hidden
        layer. The eigenvalues are infinite if the multipliers prove nothing.
    """
    matrix, _ = witness_matrix(weights, multipliers, 0.0, linear)
    widths = np.cumsum([len(part) for part in multipliers], dtype=int)
    inputs = len(matrix) - sum(len(part) for part in multipliers)
    coupling = matrix[inputs:, :inputs]
    lower = matrix[inputs:, inputs:]
    infeasible = np.full(inputs, np.inf), np.eye(inputs), []
    if not np.all(np.isfinite(matrix)):
        return infeasible
    try:
        hidden = scipy.linalg.cho_solve((np.linalg.cholesky(lower), True), coupling)
    except np.linalg.LinAlgError:
        return infeasible
    schur = coupling.T @ hidden - matrix[:inputs, :inputs]
    # Made symmetric, because rounding leaves it slightly asymmetric.
    eigenvalues, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
    return eigenvalues, vectors, np.split(-hidden @ vectors, widths[:-1])
