"""Make the training data: drive the vehicle, or read logs."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.pipeline import runs, stages


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Make the data set, unless it is stored already."""
    began = time.perf_counter()
    dataset, _ = stages.ensure_dataset(settings)
    return {
        "dataset": str(runs.dataset_path(settings)),
        "segments": sum(len(getattr(dataset, part).controls) for part in runs.PARTS),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    hydra_command(run)()
