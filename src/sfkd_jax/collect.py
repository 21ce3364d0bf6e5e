"""Calibrate the corridor of a policy again, on runs that the car drove under it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import policy, store
from sfkd_jax.certification.corridor import (
    calibrate_on_runs,
    closed_loop,
    scores_of_runs,
    supports,
)
from sfkd_jax.data import RecordedRuns, recorded_runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings
from sfkd_jax.types import BODY, Trajectory

COUNTS = (5, 10, 20)
"""Numbers of runs of which the corridor is printed."""
FITS, UNFIT = 0.01, 0.01
"""A control is that of the law if they differ by less than this share of the largest ν;
on so large a share of the steps it may be another.
"""


def run(settings: Settings) -> dict[str, Any]:
    """Write a certificate with the corridor of recorded runs beside that of the run."""
    folder, level = settings.run_dir, settings.certification.level
    trained = policy.restore(folder)
    document, reason = policy.read_certificate(folder, trained, (policy.CERTIFICATE,))
    if document is None or trained.law is None or "corridor" not in document:
        raise ValueError(
            f"{folder}: nothing to calibrate again, "
            f"{reason or 'its certificate has no corridor'}"
        )
    where, dt = settings.collect.path, trained.vehicle.dt
    recorded = recorded_runs(where, trained)
    runs = _under_law(recorded, trained)
    count, steps = runs.controls.shape[:2]
    if not supports(count, level):
        possible = int(100 * count / (count + 1)) / 100
        raise ValueError(
            f"{where}: {count} runs are too few for certification.level={level:g}: "
            f"record more, or pass certification.level={possible:g}"
        )
    store.print_message(f"{count} runs, cut to the shortest, {steps * dt:g} s")
    parts = trained.vehicle, trained.model, trained.params, trained.law
    scores, lateral = scores_of_runs(closed_loop(*parts, ()), document, runs)
    for some in (number for number in COUNTS if number <= count):
        at = some / (some + 1) - 1e-9
        made = calibrate_on_runs(document, scores[:some], at)
        store.print_message(
            f"after {some} runs: corridor {made['corridor_m']:.3f} m at level {at:.2f}"
        )
    made = calibrate_on_runs(document, scores, level)
    made["conditions"] = {
        "runs": count,
        "contents": recorded.contents,
        "duration_s": steps * dt,
        "lateral_m": float(np.max(np.abs(lateral))),
    }
    path = folder / policy.RECORDED
    if path.exists():
        store.print_message(f"{path} is replaced")
    store.write_json(path, document | {"recorded": made})
    return {"certificate": str(path), **made}


def _under_law(recorded: RecordedRuns, trained: policy.TrainedModel) -> Trajectory:
    """Return the runs with the ν that acted, if the law of the policy drove them."""
    law, plant, box = trained.law, trained.vehicle, trained.settings["environment"]
    assert law is not None
    low, high = jnp.asarray(box["low"]), jnp.asarray(box["high"])

    def control(xi: Any, inputs: Any, env: Any) -> Any:
        return law(xi, inputs[2], inputs[3], jnp.clip(env, low, high))

    states, inputs, envs = recorded.runs
    alone = jax.jit(jax.vmap(jax.vmap(control)))(states[:, :-1, BODY], inputs, envs)
    expected = np.clip(alone + inputs[..., :2], plant.control_low, plant.control_high)
    off = np.abs(recorded.controls - expected) > FITS * np.asarray(law.perturbation)
    off = np.any(off, axis=-1)
    worst = int(np.argmax(off.mean(axis=1)))
    if (share := off[worst].mean()) > UNFIT:
        raise ValueError(
            f"{recorded.sources[worst]}: in {share:.0%} of the steps the control is "
            "not that of the law of this policy plus nu: another law has driven"
        )
    nu = jnp.where(off[..., None], recorded.controls - alone, inputs[..., :2])
    return recorded.runs._replace(controls=inputs.at[..., :2].set(nu))


if __name__ == "__main__":
    hydra_command(run)()
