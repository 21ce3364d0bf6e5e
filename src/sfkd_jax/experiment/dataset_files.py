"""The file of a data set, and the settings that it depends on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import store
from sfkd_jax.assembly import LoggedVehicleSettings, VehicleSettings
from sfkd_jax.data import PARTS, Dataset, environment_box
from sfkd_jax.driving.logs import fingerprint
from sfkd_jax.experiment.options import DatasetSettings, EnvironmentSettings
from sfkd_jax.types import Trajectory

DATASET = "dataset"
"""The kind of the file of a data set."""


def config(
    vehicle: VehicleSettings,
    environment: EnvironmentSettings,
    dataset: DatasetSettings,
) -> dict[str, Any]:
    """Return the settings that a data set depends on, as plain values.

    Runs of equal values share one data set.
    """
    of_dataset = store.plain(dataset)
    if logs := dataset.logs:
        # Contents instead of the path: the same logs elsewhere make the same data set.
        del of_dataset["path"]
        of_dataset["contents"] = fingerprint(logs.path)
        of_dataset["environment_known"] = environment.is_known
    of_vehicle = store.plain(vehicle)
    if isinstance(vehicle, LoggedVehicleSettings):
        # `contents` say what the vehicle is; where that lies is no matter.
        del of_vehicle["path"]
        del of_vehicle["identified"]
    box = {"low": environment.low, "high": environment.high}
    return store.plain(
        {"vehicle": of_vehicle, "environment": box, "dataset": of_dataset}
    )


def write(path: Path, dataset: Dataset, config: dict[str, Any]) -> None:
    """Write the four parts of a data set, with the settings that it depends on."""
    arrays: dict[str, Any] = {
        f"{part}/{name}": leaf
        for part in PARTS
        for name, leaf in getattr(dataset, part)._asdict().items()
    }
    if dataset.runs is not None:
        arrays["runs"] = [dataset.runs[part] for part in PARTS]
    if dataset.scenarios is not None:
        for part in PARTS:
            arrays[f"{part}/scenario"] = dataset.scenarios[part]
    store.write_arrays(path, arrays, kind=DATASET, config=config)


def read(
    path: Path,
    config: dict[str, Any],
    environment: EnvironmentSettings,
    *,
    logged: bool,
) -> tuple[Dataset, str]:
    """Return a data set and its hash.

    Args:
        path: of the file.
        config: the settings that it must have been made with.
        environment: settings of E, whose corners the logs give if they state none.
        logged: whether the data were read from logs, and have no scenarios.
    """
    arrays, manifest = store.read_arrays(path, kind=DATASET, config=config)

    def of_all_parts(name: str) -> list[jax.Array]:
        return jax.device_put([arrays[f"{part}/{name}"] for part in PARTS])

    scenarios = None
    with store.as_artefact_error(path):
        fields = map(of_all_parts, Trajectory._fields)
        parts = [Trajectory(*leaves) for leaves in zip(*fields, strict=True)]
        if not logged:
            scenarios = dict(zip(PARTS, of_all_parts("scenario"), strict=True))
    # Over all parts: E does not depend on how they were split.
    envs = np.concatenate([np.asarray(part.envs) for part in parts])
    if logged and not environment.is_known:
        env_low, env_high = environment_box(envs, None, None, known=False)
    else:
        low = environment.low
        high = environment.high
        env_low, env_high = environment_box(envs, low, high, known=True)
    runs = None
    counts = arrays.get("runs")
    if counts is not None:
        runs = dict(zip(PARTS, map(int, counts), strict=True))
    dataset = Dataset(
        *parts, env_low=env_low, env_high=env_high, runs=runs, scenarios=scenarios
    )
    return dataset, manifest["sha256"]
