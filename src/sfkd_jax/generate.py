"""Make the training data: drive the vehicle, or read logs."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax.data import PARTS
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run


def main(run: Run) -> dict[str, Any]:
    """Make the data set, unless it is stored already."""
    began = time.perf_counter()
    dataset = run.source.dataset
    made = {
        "dataset": str(run.source.path),
        "segments": sum(len(getattr(dataset, part).controls) for part in PARTS),
        "seconds": time.perf_counter() - began,
    }
    lags = run.source.command_lags
    return {**made, "command_lags": lags} if lags else made


if __name__ == "__main__":
    hydra_command(main)()
