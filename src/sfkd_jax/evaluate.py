"""Simulate and score paired episodes of every system."""

from __future__ import annotations

from typing import Any

from sfkd_jax.experiment import stages
from sfkd_jax.experiment.command import command_line, hydra_command
from sfkd_jax.experiment.evaluating import evaluate_run
from sfkd_jax.experiment.run import Run


def main(run: Run) -> dict[str, Any]:
    """Evaluate the systems of the run and add their rows to its results."""
    systems = run.settings.evaluation.systems
    if not systems:
        raise ValueError("evaluation.systems is empty: there is nothing to evaluate")
    stages.check_settings(run)
    path, rows = evaluate_run(run, command=command_line("evaluate"))
    return {"results": str(path), "rows": len(rows)}


if __name__ == "__main__":
    hydra_command(main)()
