"""Error tubes from a contraction factor and bounds on disturbances.

They follow from the corrected theorem on input-to-state stability of the paper
(thm:ISS).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from sfkd_jax.certificate import OutputBound, OutputMetric, OutputTube, StepErrors, Tube
from sfkd_jax.certification._claims import rows
from sfkd_jax.certification._measured import Residuals, conformal_quantile, coverage_of
from sfkd_jax.types import Frame


def latent_tube(
    alpha: float, d_bar: float, horizon: int
) -> Float[np.ndarray, " horizon"]:
    """Return the radii R_1 … R_T of a tube in latent coordinates.

    If ẑ_0 = z_0 and all |d_j| ≤ d̄, then |z_k − ẑ_k| ≤ R_k with

        R_k = α R_{k−1} + d̄ = d̄ (1 − α^k)/(1 − α),   R_0 = 0

    Args:
        alpha: contraction factor α.
        d_bar: bound of the disturbance of a step, d̄.
        horizon: T [steps].
    """
    # The recursion is used, because the closed form divides by 1 − α.
    radius = d_bar
    radii = []
    for _ in range(horizon):
        radii.append(radius)
        radius = alpha * radius + d_bar
    return np.asarray(radii)


def tubes(
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    frame: Frame,
    one_step: StepErrors,
    horizon: int,
    largest_increment: float | None,
) -> Tube:
    """Return the tubes of a certificate, for predictions that start at the true z_0.

    They are the radii R_1 … R_T of `latent_tube`, those of the outputs, and their
    limits. Without a pose all outputs are decoded from z, so that no error accumulates:

        |e_i,k| ≤ L_i α R_{k−1} + ε_i,   k = 1 … T

    Otherwise the pose is a sum of increments on SE(2), and its error is bounded by
    finite sums over j = 0 … k − 1 instead:

        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw)
        |e_p,k|   ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|)

    Args:
        alpha: contraction factor α.
        lipschitz: L of the outputs, by name.
        frame: whose outputs they are.
        one_step: measured bounds at the true latent: d̄, and ε of the outputs.
        horizon: T [steps].
        largest_increment: |dp|, the longest step [m]; None without a pose.
    """
    latent = latent_tube(alpha, one_step["latent"], horizon)
    # R_k → d̄ / (1 − α), the fixed point of R ↦ α R + d̄.
    ultimate = one_step["latent"] / (1 - alpha)
    # R_0 … R_{T−1}, and the limit. R_0 = 0: a prediction starts at the observed state.
    before = np.concatenate([[0.0], latent[:-1], [ultimate]])
    labels = frame.labels
    radii = {
        labels[output]: lipschitz[output] * alpha * before + one_step[output]
        for output in frame.outputs
    }
    limits = None
    if largest_increment is None:
        limits = {name: float(radius[-1]) for name, radius in radii.items()}
    else:
        # Errors of increments add up, so that the pose has no limit.
        yaw = np.cumsum(lipschitz["yaw"] * before + one_step["yaw"])
        # An error of yaw moves only the increments that come after it.
        yaw_before = np.concatenate([[0.0], yaw[:-1]])
        increments = lipschitz["position"] * before + one_step["position"]
        position = np.cumsum(increments + largest_increment * yaw_before)
        radii[labels["position"]] = position
        radii[labels["yaw"]] = yaw
    return Tube(
        latent=rows(latent),
        physical={name: rows(radius[:-1]) for name, radius in radii.items()},
        ultimate=ultimate,
        asymptotic=limits,
        largest_increment_m=largest_increment,
    )


FORMS = ("asymptotic", "vehicle_to_nominal")
"""Two bounds on |y_k − ŷ_k| of system and nominal model over a whole run. The first
follows from the largest disturbance alone, the second from the sequence of all
disturbances.
"""


def radii(
    measured: Residuals,
    name: str,
    claim: OutputMetric,
    start: Float[np.ndarray, "run rank"] | None = None,
) -> dict[str, Float[np.ndarray, " run"]]:
    """Return the bounds of one output for each run, by `FORMS`.

    With |z_k − ẑ_k|_P ≤ R_k and R_k = α R_{k−1} + |d_k|_P,

        |y_k − ŷ_k| ≤ |C (F(z_{k−1}) − F(ẑ_{k−1}))| + ε_k ≤ L α R_{k−1} + ε_k
                    ≤ L α max|d|_P / (1 − α) + max ε.

    Args:
        measured: errors of every step of the runs.
        name: of the output.
        claim: proved constants of the output.
        start: z_0 − ẑ_0; None if the nominal model starts at the state of the system.
    """
    # |d|_P is the 2-norm of d'L with P = L L'.
    factor = np.linalg.cholesky(np.asarray(claim.metric))
    disturbances = np.linalg.norm(measured.gaps @ factor, axis=-1)
    errors = measured.outputs[name]
    if start is None:
        initial = np.zeros(len(disturbances))
    else:
        initial = np.linalg.norm(start @ factor, axis=1)
    radius = initial
    farthest = np.zeros(len(disturbances))
    for step in range(disturbances.shape[1]):
        # The output is bounded by the radius before the disturbance of this step.
        distance = claim.lipschitz * claim.alpha * radius + errors[:, step]
        farthest = np.maximum(farthest, distance)
        radius = claim.alpha * radius + disturbances[:, step]
    # A start outside of the limit shrinks towards it, so that the larger of both bounds
    # R_k for all k.
    limit = np.max(disturbances, axis=1) / (1.0 - claim.alpha)
    ultimate = np.maximum(initial, limit)
    asymptotic = claim.lipschitz * claim.alpha * ultimate + np.max(errors, axis=1)
    return dict(zip(FORMS, (asymptotic, farthest), strict=True))


def measure_outputs(
    outputs: Mapping[str, OutputMetric],
    calibration: Residuals,
    test: Residuals,
    *,
    level: float,
) -> dict[str, OutputTube]:
    """Calibrate bounds on |y − ŷ| of the outputs that have a metric.

    Args:
        outputs: proved metrics by name.
        calibration: errors of runs that set the bounds.
        test: errors of runs on which coverage is counted.
        level: with which each bound holds for a whole new run.
    """
    count = len(test.gaps)

    def bound_of(scores: np.ndarray, unseen: np.ndarray) -> OutputBound:
        radius = conformal_quantile(scores, level)
        return OutputBound(radius=radius, coverage=coverage_of(unseen <= radius, count))

    measured = {}
    for name, claim in outputs.items():
        scores = radii(calibration, name, claim)
        unseen = radii(test, name, claim)
        bounds = {form: bound_of(scores[form], unseen[form]) for form in FORMS}
        measured[name] = OutputTube(**bounds)
    return measured
