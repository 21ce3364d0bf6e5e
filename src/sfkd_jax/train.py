"""python -m sfkd_jax.train: the main job, from nothing to a certified controller, its score and a report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts, certify, evaluate, report, shelf, walk
from sfkd_jax.config import door


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Walk: data, weights, certificate, closed loop, report."""
    began = time.perf_counter()
    walk.ensure_policy(settings)
    place = shelf.run_directory(settings)
    certificate = certify.renew(settings)
    results = evaluate.run(settings)
    pages = report.run(settings)
    return {
        "run": str(place),
        "checkpoint": str(place / "checkpoints"),
        "certificate": str(certify.document_in(place)),
        "results": results["results"],
        "report": pages["report"],
        "open_loop_rmse_m": artefacts.read_json(place / "open_loop.json")["position_rmse_m"],
        "alpha": certificate.get("alpha"),
        "objective": _objective(place),
        "seconds": time.perf_counter() - began,
    }


def _objective(place: Path) -> float | None:
    """What a sweep minimises: the least validation loss; None for a model that is identified at once."""
    lines = artefacts.read_jsonl(place / "metrics.jsonl") if (place / "metrics.jsonl").exists() else []
    return min((line["validation_loss"] for line in lines if "validation_loss" in line), default=None)


if __name__ == "__main__":
    door(run)()
