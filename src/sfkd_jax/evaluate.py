"""Simulate and score paired episodes of every system."""

from __future__ import annotations

from typing import Any

from hydra.core.hydra_config import HydraConfig

from sfkd_jax.cli.config import command_line
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.pipeline.evaluate_run import evaluate_run


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Evaluate the systems of the run and add their rows to its results.

    Raises:
        ValueError: there is no system to evaluate.
    """
    if not settings["evaluation"]["systems"]:
        raise ValueError("evaluation.systems is empty: there is nothing to evaluate")
    typed = command_line("evaluate") if HydraConfig.initialized() else None
    return evaluate_run(settings, command=typed)


if __name__ == "__main__":
    hydra_command(run)()
