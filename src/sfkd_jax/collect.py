"""Calibrate the corridor of a policy again, on runs that the car drove under it."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfkd_jax import assembly, policy, store
from sfkd_jax.certification.corridor import (
    calibrate_on_runs,
    check_count,
    closed_loop,
    corridor_coverage,
    scores_of_runs,
)
from sfkd_jax.data import recorded_runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run

COUNTS = (5, 10, 20)
"""The corridor of so many of the first runs is printed as well."""


def main(run: Run) -> dict[str, Any]:
    """Write a certificate with the corridor of recorded runs beside that of the run."""
    folder = run.directory
    level = run.settings.certification.level
    trained = policy.restore(folder)
    document, reason = policy.read_certificate(folder, trained)
    if document is None or trained.law is None or "corridor" not in document:
        reason = reason or "its certificate has no corridor"
        raise ValueError(f"{folder}: nothing to calibrate again, {reason}")
    runs, contents = recorded_runs(run.settings.collect.path, trained)
    count, steps = runs.controls.shape[:2]
    seconds = steps * trained.vehicle.dt
    check_count(count, level, "runs")
    loop = closed_loop(trained.vehicle, trained.model, trained.params, trained.law, ())
    scores, lateral = scores_of_runs(loop, document, runs)
    coverage = corridor_coverage(assembly.corridor_of(document)["bounds"], scores)
    store.print_message(
        f"{count} runs, cut to the shortest, {seconds:g} s: "
        f"{1e3 * np.sqrt(np.mean(lateral**2)):.1f} mm (RMS) from the path, "
        f"{coverage['coverage']:.0%} of them inside the corridor that was known before"
    )
    for number in COUNTS:
        if number > count:
            continue
        # The highest level that so many runs can promise.
        highest = number / (number + 1) - 1e-9
        recorded = calibrate_on_runs(document, scores[:number], highest)
        store.print_message(
            f"after {number} runs: corridor {recorded['corridor_m']:.3f} m "
            f"at level {highest:.2f}"
        )
    recorded = calibrate_on_runs(document, scores, level)
    recorded["conditions"] = {
        "runs": count,
        "contents": contents,
        "duration_s": seconds,
        "lateral_m": float(np.max(np.abs(lateral))),
    }
    path = folder / policy.RECORDED
    if path.exists():
        store.print_message(f"{path} is replaced")
    store.write_json(path, {**document, "recorded": recorded})
    return {"certificate": str(path), **recorded}


if __name__ == "__main__":
    hydra_command(main)()
