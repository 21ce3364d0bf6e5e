"""What a certificate measures on data that training never saw."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from sfkd_jax.certificate import Box, Boxes, Measured, Proof, StepBounds
from sfkd_jax.certification._measured import (
    Residuals,
    conformal_bounds,
    coverage,
    holds_for,
    residuals,
)
from sfkd_jax.certification._tubes import measure_outputs, tubes
from sfkd_jax.certification._weights import CertificationRefused
from sfkd_jax.data import Dataset
from sfkd_jax.ranges import Fraction
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import BODY, Model, Params, Trajectory


def measure(
    model: Model,
    params: Params,
    proof: Proof,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Mapping[str, Trajectory],
    boxes: Boxes,
    runs: Mapping[str, int] | None = None,
    horizon: int = 20,
    level: Fraction = 0.95,
) -> Measured:
    """Measure the errors of a model, and the tubes that follow from them and a proof.

    Args:
        model: that is certified.
        params: its weights as exported.
        proof: about these weights.
        validation: trajectories that fix the units of the scores.
        calibration: trajectories that set d̄.
        held_out: trajectories by name, on which coverage is counted. "test" is
            exchangeable with `calibration`.
        boxes: domain of the measurements; nothing measured is claimed outside.
        runs: number of independent runs that the trajectories of "calibration" and
            "test" were cut from. By default every trajectory is a run. Guarantees are
            about new runs only if there are enough of them.
        horizon: of the tubes [steps].
        level: 1 − δ of the conformal bounds.

    Raises:
        CertificationRefused: the data are too few for the level, or not finite.
    """
    # Folded for the measurements alone. The proof is about the stored weights.
    errors_of = partial(residuals, model, fold(model, params, on_host))
    reference = errors_of(validation)
    scores = errors_of(calibration)
    unseen = {name: errors_of(part) for name, part in held_out.items()}
    try:
        d_bar = _step_bounds(reference, scores, unseen, level, runs or {})
        outputs = measure_outputs(proof.outputs, scores, unseen["test"], level=level)
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    tube = tubes(
        alpha=proof.alpha,
        lipschitz=proof.lipschitz,
        frame=model.frame,
        one_step=d_bar.one_step,
        horizon=horizon,
        largest_increment=_longest_step(calibration) if model.frame.has_pose else None,
    )
    return Measured(boxes=boxes, d_bar=d_bar, tube=tube, outputs=outputs)


def boxes_of(dataset: Dataset) -> Boxes:
    """Return the boxes of body state, control and environment.

    Those of body state and control are hulls over training and calibration parts; that
    of the environment is E.
    """
    train = dataset.train
    calibration = dataset.calibration
    return Boxes(
        state=_hull(train.states[..., BODY], calibration.states[..., BODY]),
        control=_hull(train.controls, calibration.controls),
        env=_hull(dataset.env_low, dataset.env_high),
    )


def _hull(*arrays: Any) -> Box:
    """Return the smallest and the largest value of each entry of the last axis."""
    rows = [np.reshape(array, (-1, array.shape[-1])) for array in arrays]
    flat = np.concatenate(rows)
    return tuple(flat.min(axis=0).tolist()), tuple(flat.max(axis=0).tolist())


def _longest_step(runs: Trajectory) -> float:
    """Return the longest way of a step in the runs [m].

    An error of yaw moves the body by at most this length times the angle.
    """
    moves = np.diff(np.asarray(runs.states, np.float64)[..., :2], axis=-2)
    return float(np.max(np.linalg.norm(moves, axis=-1)))


def _step_bounds(
    reference: Residuals,
    measured: Residuals,
    unseen: Mapping[str, Residuals],
    level: float,
    runs: Mapping[str, int],
) -> StepBounds:
    """Return the bounds on the errors of single steps.

    Args:
        reference: of the validation part, which fixes the units.
        measured: of the calibration part.
        unseen: of parts on which the coverage is counted, by name.
        level: with which the bounds hold for a whole trajectory.
        runs: number of independent runs of "calibration" and "test".
    """
    # If the scores of the calibration fixed their own units, they would not be
    # exchangeable with a new score.
    units = reference.largest()
    scores = measured.largest()
    bounds = conformal_bounds(units, scores, level=level)
    shares = {}
    for name, part in unseen.items():
        # Only of the test part it is known how many runs it was cut from.
        count = runs.get("test") if name == "test" else None
        shares[name] = coverage(bounds, part.largest(), count)
    independent = runs.get("calibration", len(scores))
    return StepBounds(
        one_step=dict(zip(measured.names, bounds.tolist(), strict=True)),
        level=level,
        trajectories=len(scores),
        runs=independent,
        # With too few runs the bound is about these runs alone, and this text says so.
        holds_for=holds_for(independent, level),
        coverage=shares.pop("test"),
        by_scenario=shares,
        validation=float(np.quantile(units[:, 0], level)),
    )
