"""python -m sfkd_jax.evaluate: simulate and score paired episodes of every system."""

from __future__ import annotations

from typing import Any

from hydra.core.hydra_config import HydraConfig

from sfkd_jax.cli.config import command, door
from sfkd_jax.pipeline.evaluate_run import evaluate_run


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Evaluate the systems of the run and add their rows to its results."""
    typed = command("evaluate") if HydraConfig.initialized() else None
    return evaluate_run(settings, command=typed)


if __name__ == "__main__":
    door(run)()
