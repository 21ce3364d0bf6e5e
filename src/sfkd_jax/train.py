"""Train, certify and evaluate a policy, and write its report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from sfkd_jax import artefacts, build
from sfkd_jax.cli.config import command_line
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.paper import beside_the_paper
from sfkd_jax.pipeline import certificates, dry_run, stages, store
from sfkd_jax.pipeline.evaluate_run import evaluate_run
from sfkd_jax.reporting import write_report
from sfkd_jax.vehicle import check_step


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Make data, policy, certificate, closed-loop results and report of a run.

    A vehicle without a step function is not evaluated in closed loop.
    """
    began = time.perf_counter()
    plant = build.build_vehicle(settings["vehicle"])
    if plant.simulated:
        check_step(plant)
    dry_run.check_settings(settings, plant)
    document = _run_stages(settings)
    return document | {"seconds": time.perf_counter() - began}


@store.exclusive
def _run_stages(settings: dict[str, Any]) -> dict[str, Any]:
    """Run all stages in the run directory."""
    stages.ensure_policy(settings)
    run_dir = store.run_directory(settings)
    certificate = certificates.certify_policy(settings)
    if build.build_vehicle(settings["vehicle"]).simulated:
        typed = command_line("train") if HydraConfig.initialized() else None
        results = evaluate_run(settings, command=typed)["results"]
    else:
        results = None
        artefacts.print_message(
            "not driven: vehicle=own is known from logs alone; "
            "vehicle.step=package.module:function drives it"
        )
    with artefacts.as_artefact_error(run_dir):
        pages = write_report(run_dir, studies=beside_the_paper)
    artefacts.print_message(f"report: {pages['report']}")
    return {
        "run": str(run_dir),
        "checkpoint": str(run_dir / "checkpoints"),
        "certificate": str(certificates.certificate_path(run_dir)),
        "results": results,
        "report": pages["report"],
        "open_loop_rmse_m": _position_errors(run_dir),
        "alpha": certificate.get("alpha"),
        "objective": _objective(run_dir),
    }


def _position_errors(run_dir: Path) -> list[float]:
    """Position errors of open-loop predictions by steps ahead [m]."""
    key = "position_rmse_m"
    return artefacts.read_json(run_dir / "open_loop.json", keys=(key,))[key]


def _objective(run_dir: Path) -> float | None:
    """The lowest validation loss, which a sweep minimises; None if none was logged."""
    log = run_dir / "metrics.jsonl"
    if not log.exists():
        return None
    lines = artefacts.read_jsonl(log, damaged=artefacts.print_message)
    losses = [line["validation_loss"] for line in lines if "validation_loss" in line]
    return min(losses, default=None)


if __name__ == "__main__":
    hydra_command(run)()
