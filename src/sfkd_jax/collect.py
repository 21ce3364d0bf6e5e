"""Calibrate the corridor of a policy again, on runs that the car drove under it."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfkd_jax import build, policy, store
from sfkd_jax.certification.corridor import (
    calibrate_on_runs,
    check_count,
    closed_loop,
    corridor_coverage,
    scores_of_runs,
)
from sfkd_jax.data import recorded_runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings

COUNTS = (5, 10, 20)
"""Numbers of runs of which the corridor is printed."""


def run(settings: Settings) -> dict[str, Any]:
    """Write a certificate with the corridor of recorded runs beside that of the run."""
    folder, level = settings.run_dir, settings.certification.level
    trained = policy.restore(folder)
    document, reason = policy.read_certificate(folder, trained)
    if document is None or trained.law is None or "corridor" not in document:
        reason = reason or "its certificate has no corridor"
        raise ValueError(f"{folder}: nothing to calibrate again, {reason}")
    runs, contents = recorded_runs(settings.collect.path, trained)
    count, steps = runs.controls.shape[:2]
    seconds = steps * trained.vehicle.dt
    check_count(count, level, "runs")
    parts = trained.vehicle, trained.model, trained.params, trained.law
    scores, lateral = scores_of_runs(closed_loop(*parts, ()), document, runs)
    known = corridor_coverage(build.corridor_of(document)["bounds"], scores)
    store.print_message(
        f"{count} runs, cut to the shortest, {seconds:g} s: "
        f"{1e3 * np.sqrt(np.mean(lateral**2)):.1f} mm (RMS) from the path, "
        f"{known['coverage']:.0%} of them inside the corridor that was known before"
    )
    for some in (number for number in COUNTS if number <= count):
        at = some / (some + 1) - 1e-9
        made = calibrate_on_runs(document, scores[:some], at)
        store.print_message(
            f"after {some} runs: corridor {made['corridor_m']:.3f} m at level {at:.2f}"
        )
    made = calibrate_on_runs(document, scores, level)
    made["conditions"] = {
        "runs": count,
        "contents": contents,
        "duration_s": seconds,
        "lateral_m": float(np.max(np.abs(lateral))),
    }
    path = folder / policy.RECORDED
    if path.exists():
        store.print_message(f"{path} is replaced")
    store.write_json(path, document | {"recorded": made})
    return {"certificate": str(path), **made}


if __name__ == "__main__":
    hydra_command(run)()
