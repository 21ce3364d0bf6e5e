"""Calibrate the corridor of a policy again, on runs that the car drove under it."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from sfkd_jax import certificate as certificates
from sfkd_jax import policy, store
from sfkd_jax.certification import check_count
from sfkd_jax.driving.certificate import RecordedConditions
from sfkd_jax.driving.corridor import (
    calibrate_on_runs,
    closed_loop,
    corridor_coverage,
    scores_of_runs,
)
from sfkd_jax.driving.logs import recorded_runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run

COUNTS = (5, 10, 20)
"""The corridor of so many of the first runs is printed as well."""


def main(run: Run) -> dict[str, Any]:
    """Write a certificate with the corridor of recorded runs beside that of the run."""
    folder = run.directory
    level = run.settings.certification.level
    trained = policy.restore(folder)
    certificate, reason = policy.read_certificate(folder, trained)
    corridor = certificate.corridor if certificate else None
    if certificate is None or trained.law is None or corridor is None:
        reason = reason or "its certificate has no corridor"
        raise ValueError(f"{folder}: nothing to calibrate again, {reason}")
    latency = corridor.conditions.latency
    runs, contents = recorded_runs(run.settings.collect.path, trained, latency)
    count, steps = runs.controls.shape[:2]
    seconds = steps * trained.vehicle.dt
    check_count(count, level, "runs")
    loop = closed_loop(trained.vehicle, trained.model, trained.params, trained.law, ())
    scores, lateral = scores_of_runs(loop, certificate.proof.outputs, runs)
    coverage = corridor_coverage(corridor.in_force().bounds, scores)
    store.print_message(
        f"{count} runs, cut to the shortest, {seconds:g} s: "
        f"{1e3 * np.sqrt(np.mean(lateral**2)):.1f} mm (RMS) from the path, "
        f"{coverage.share:.0%} of them inside the corridor that was known before"
    )
    conditions = RecordedConditions(
        runs=count,
        contents=contents,
        duration_s=seconds,
        lateral_m=float(np.max(np.abs(lateral))),
    )
    calibrate = partial(calibrate_on_runs, corridor.bounds, conditions=conditions)
    for number in COUNTS:
        if number > count:
            continue
        # The highest level that so many runs can promise.
        highest = number / (number + 1) - 1e-9
        of_first = calibrate(scores[:number], highest)
        store.print_message(
            f"after {number} runs: corridor {of_first.corridor_m:.3f} m "
            f"at level {highest:.2f}"
        )
    recorded = calibrate(scores, level)
    path = folder / policy.RECORDED
    if path.exists():
        store.print_message(f"{path} is replaced")
    certificates.write(
        path,
        replace(certificate, corridor=replace(corridor, recorded=recorded)),
        signing_key=run.settings.certification.signing_key,
    )
    return {"certificate": str(path), **store.plain(asdict(recorded))}


if __name__ == "__main__":
    hydra_command(main)()
