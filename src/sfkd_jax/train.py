"""Train, certify and evaluate a policy, and write its report."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax import store
from sfkd_jax.certificate import Refusal
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.simulation.metrics import Row
from sfkd_jax.experiment import stages
from sfkd_jax.experiment.command import command_line, hydra_command
from sfkd_jax.experiment.duration import work_of
from sfkd_jax.experiment.evaluating import evaluate_run
from sfkd_jax.experiment.named_system import train_system
from sfkd_jax.experiment.run import Run
from sfkd_jax.report import style
from sfkd_jax.report.run import write_report
from sfkd_jax.report.tables import name_of


def main(run: Run) -> dict[str, Any]:
    """Make data, policy, certificate, closed-loop results and report of a run.

    With `system` it certifies a system of the user, see `certify_system`. A vehicle
    without a step function is not evaluated in closed loop. With
    `evaluation.systems=[]` the model is trained and nothing else is done, as a search
    needs it.
    """
    if run.settings.system is not None:
        return train_system(run)
    began = time.perf_counter()
    stages.check_settings(run)
    if run.settings.evaluation.systems:
        store.print_message(f"{run.settings.name}: {work_of(run)}")
    with store.locked(run.directory):
        summary = _run_stages(run)
    summary["seconds"] = time.perf_counter() - began
    return summary


def _run_stages(run: Run) -> dict[str, Any]:
    """Run all stages in the run directory; return what was made, by name."""
    settings = run.settings
    run_dir = run.directory
    trained = run.policy
    # A policy that exists is not written again, and `load` builds what it says.
    controller = store.plain(settings.controller)
    if store.differences(trained.settings["controller"], controller):
        store.print_message(
            f"{run_dir}: the policy keeps the controller that it was trained with; "
            "`load(…, controller=…)` takes another"
        )
    key = "position_rmse_m"
    errors = store.read_json(run_dir / "open_loop.json", keys=(key,))
    summary = {
        "run": str(run_dir),
        "checkpoint": str(run_dir / "checkpoints"),
        "open_loop_rmse_m": errors[key],
        "objective": errors.get("validation_score"),
    }
    if not settings.evaluation.systems:
        return summary
    certificate = stages.certify_policy(run)
    results = None
    rows: list[Row] = []
    if run.plant.simulated:
        path, rows = evaluate_run(run, command=command_line("train"))
        results = str(path)
    else:
        store.print_message(
            "not driven: vehicle=own is known from logs alone; "
            "vehicle.step=package.module:function drives it"
        )
    with store.as_artefact_error(run_dir):
        pages = write_report(run_dir)
    _print_findings(certificate, rows)
    store.print_message(f"report: {pages['report']}")
    summary["certificate"] = str(run.certificate_path)
    summary["results"] = results
    summary["report"] = pages["report"]
    is_certified = isinstance(certificate, DrivingCertificate)
    summary["alpha"] = certificate.proof.alpha if is_certified else None
    return summary


def _print_findings(certificate: DrivingCertificate | Refusal, rows: list[Row]) -> None:
    """Print what a person wants to know of a run: its corridor, and who drove how."""
    corridor = getattr(certificate, "corridor", None)
    if corridor is not None:
        coverage = corridor.coverage
        store.print_message(
            f"corridor: {corridor.corridor_m:.3f} m to each side, kept in "
            f"{100 * coverage.share:.1f} % of {coverage.runs} fresh runs"
        )
    if rows:
        errors = [f"{name_of(row)} {1e3 * row['rmse_m']['mean']:.1f}" for row in rows]
        scenario = style.scenario_label(str(rows[0]["scenario"]))
        store.print_message(f"RMSE on {scenario} [mm]: {', '.join(errors)}")


if __name__ == "__main__":
    hydra_command(main, of_systems=True)()
