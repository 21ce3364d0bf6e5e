"""Where the data set of a run lies, and the settings that it depends on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.build import LoggedVehicleSettings
from sfkd_jax.data import fingerprint
from sfkd_jax.experiment.options import Settings


def dataset_config(settings: Settings) -> dict[str, Any]:
    """Return the settings that the data set of a run depends on, as plain values.

    Runs of equal values share one data set.
    """
    dataset = store.plain(settings.dataset)
    environment = settings.environment
    if logs := settings.logs:
        # Contents instead of the path: the same logs elsewhere make the same data set.
        del dataset["path"]
        dataset["contents"] = fingerprint(logs.path)
        dataset["environment_known"] = environment.is_known
    vehicle = store.plain(settings.vehicle)
    if isinstance(settings.vehicle, LoggedVehicleSettings):
        # `contents` say what the vehicle is; where that lies is no matter.
        del vehicle["path"]
        del vehicle["identified"]
    box = {"low": environment.low, "high": environment.high}
    return store.plain({"vehicle": vehicle, "environment": box, "dataset": dataset})


def dataset_path(settings: Settings) -> Path:
    """Return the path of the data set of a run."""
    digest = store.sha256(dataset_config(settings))[:8]
    folder = f"{settings.vehicle.name}-{digest}"
    return Path(settings.root) / "datasets" / folder / "dataset.safetensors"
