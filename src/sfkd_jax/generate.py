"""python -m sfkd_jax.generate: drive the training vehicle and store the data set."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax import shelf, walk
from sfkd_jax.config import door


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Generate the data set, unless it lies on the shelf already."""
    began = time.perf_counter()
    dataset, _ = walk.ensure_dataset(settings)
    return {
        "dataset": str(shelf.dataset_path(settings)),
        "segments": sum(getattr(dataset, part).controls.shape[0] for part in shelf.PARTS),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    door(run)()
