"""Make the training data: drive the vehicle, or read logs."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax.experiment import data
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings


def run(settings: Settings) -> dict[str, Any]:
    """Make the data set, unless it is stored already."""
    began = time.perf_counter()
    dataset, _ = data.ensure_dataset(settings)
    return {
        "dataset": str(data.dataset_path(settings)),
        "segments": sum(len(getattr(dataset, part).controls) for part in data.PARTS),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    hydra_command(run)()
