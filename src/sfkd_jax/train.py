"""python -m sfkd_jax.train: the main job, from nothing to a certified controller, its score and a report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts, build, certify, evaluate, report
from sfkd_jax.cli.config import door
from sfkd_jax.pipeline import dry_run, stages, store
from sfkd_jax.vehicle import check_step


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Walk: data, weights, certificate, closed loop if there is a step to drive with, report."""
    began = time.perf_counter()
    plant = build.build_vehicle(settings["vehicle"])
    if plant.simulated:
        check_step(plant)
    dry_run.check(settings, plant)
    return _walk(settings) | {"seconds": time.perf_counter() - began}


@store.exclusive
def _walk(settings: dict[str, Any]) -> dict[str, Any]:
    """All steps in the run directory."""
    stages.ensure_policy(settings)
    place = store.run_directory(settings)
    certificate = certify.renew(settings)
    if build.build_vehicle(settings["vehicle"]).simulated:
        results = evaluate.run(settings, asked_by="train")
    else:
        results = {"results": None}
        artefacts.print_message(
            "not driven: vehicle=own is known from logs alone; vehicle.step=package.module:function drives it"
        )
    pages = report.run(settings)
    return {
        "run": str(place),
        "checkpoint": str(place / "checkpoints"),
        "certificate": str(certify.certificate_path(place)),
        "results": results["results"],
        "report": pages["report"],
        "open_loop_rmse_m": _errors(place),
        "alpha": certificate.get("alpha"),
        "objective": _objective(place),
    }


def _errors(place: Path) -> list[float]:
    """Error of free-running predictions by steps ahead [m]."""
    return artefacts.read_json(place / "open_loop.json", keys=("position_rmse_m",))[
        "position_rmse_m"
    ]


def _objective(place: Path) -> float | None:
    """What a sweep minimises: the least validation loss; None for a model that is identified at once."""
    log = place / "metrics.jsonl"
    lines = artefacts.read_jsonl(log, damaged=artefacts.print_message) if log.exists() else []
    return min(
        (line["validation_loss"] for line in lines if "validation_loss" in line),
        default=None,
    )


if __name__ == "__main__":
    door(run)()
