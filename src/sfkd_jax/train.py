"""python -m sfkd_jax.train: the main job, from nothing to a certified controller, its score and a report."""

from __future__ import annotations

import time
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
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    door(run)()
