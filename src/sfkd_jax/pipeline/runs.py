"""Run directories and data sets on disk, and the settings that identify them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import store
from sfkd_jax.data import Dataset, environment_box, fingerprint
from sfkd_jax.types import BODY, Trajectory

DATASET = "dataset"
LAW = "law"
PARTS = ("train", "validation", "calibration", "test")
IDENTITY = ("vehicle", "dataset", "model", "training", "seed")
"""Settings that determine the weights of a run."""
UNREADABLE = frozenset("[]")
"""Characters of a path that the checkpoint library writes, but reads as a pattern."""


def run_directory(settings: dict[str, Any]) -> Path:
    """Return the directory of a run, root/name/system/seed=N."""
    return (
        Path(settings["root"])
        / settings["name"]
        / settings["model"]["system"]
        / f"seed={settings['seed']}"
    )


def exclusive(run: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    """Wrap `run(settings)` so that it holds the lock of the run directory."""

    @functools.wraps(run)
    def locked(settings: dict[str, Any]) -> Any:
        with store.locked(run_directory(settings)):
            return run(settings)

    return locked


def dataset_path(settings: dict[str, Any]) -> Path:
    """Return the path of a data set, which runs of equal data settings share."""
    digest = store.sha256(dataset_config(settings))[:8]
    name = f"{settings['vehicle']['name']}-{digest}"
    return Path(settings["root"]) / "datasets" / name / "dataset.npz"


def dataset_config(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a data set, with the contents of logs for their path."""
    options = dict(settings["dataset"])
    if is_logged(settings):
        options |= {
            "contents": fingerprint(options.pop("path")),
            "environment_known": has_environment(settings),
        }
    return {"vehicle": settings["vehicle"], "dataset": options}


def is_logged(settings: dict[str, Any]) -> bool:
    """Whether the data set is read from logs instead of simulated."""
    return "path" in settings["dataset"]


def has_environment(settings: dict[str, Any]) -> bool:
    """Whether the environment is measured or estimated."""
    return settings.get("env_source") != "none"


def identity(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that determine the weights of a run."""
    return {name: settings[name] for name in IDENTITY} | dataset_config(settings)


def write_dataset(settings: dict[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Write the four parts of a data set and return the manifest."""
    arrays = {
        f"{part}/{name}": np.asarray(leaf)
        for part in PARTS
        for name, leaf in getattr(dataset, part)._asdict().items()
    }
    if dataset.drives is not None:
        arrays["drives"] = np.asarray([dataset.drives[part] for part in PARTS])
    if dataset.scenarios is not None:
        labels = dataset.scenarios
        arrays |= {f"{part}/scenario": np.asarray(labels[part]) for part in PARTS}
    path = dataset_path(settings)
    path.parent.mkdir(parents=True, exist_ok=True)
    return store.write_arrays(
        path, arrays, kind=DATASET, config=dataset_config(settings)
    )


def read_dataset(settings: dict[str, Any]) -> tuple[Dataset, str]:
    """Return a data set and its hash.

    Raises:
        ArtefactError: missing, damaged, made with other settings, or by an earlier
            version that did not store scenarios.
    """
    arrays, manifest = store.read_arrays(
        dataset_path(settings), kind=DATASET, config=dataset_config(settings)
    )
    with store.as_artefact_error(dataset_path(settings)):
        parts = [
            Trajectory(
                *(jnp.asarray(arrays[f"{part}/{name}"]) for name in Trajectory._fields)
            )
            for part in PARTS
        ]
    scenarios = None
    if not is_logged(settings):
        if f"{PARTS[0]}/scenario" not in arrays:
            raise store.ArtefactError(
                f"{dataset_path(settings)}: made by an earlier version, without the "
                "scenario of each segment; delete it and generate it again"
            )
        scenarios = {part: jnp.asarray(arrays[f"{part}/scenario"]) for part in PARTS}
    options = settings["dataset"]
    envs = np.concatenate([np.asarray(part.envs) for part in parts])
    low, high = environment_box(envs, options["env_low"], options["env_high"])
    counts = arrays.get("drives")
    drives = (
        None
        if counts is None
        else {part: int(count) for part, count in zip(PARTS, counts, strict=True)}
    )
    dataset = Dataset(
        *parts, env_low=low, env_high=high, drives=drives, scenarios=scenarios
    )
    return dataset, manifest["sha256"]


def write_law(settings: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write the law of a data set in path coordinates beside it."""
    path = law_path(settings)
    path.parent.mkdir(parents=True, exist_ok=True)
    plain = {name: np.asarray(array) for name, array in arrays.items()}
    store.write_arrays(path, plain, kind=LAW, config=dataset_config(settings))


def read_law(settings: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of the law."""
    return store.read_arrays(
        law_path(settings), kind=LAW, config=dataset_config(settings)
    )[0]


def law_path(settings: dict[str, Any]) -> Path:
    """Return the path of the law of a data set."""
    return dataset_path(settings).with_name("law.npz")


def is_along_path(settings: dict[str, Any]) -> bool:
    """Whether the data set is in path coordinates."""
    return "law" in settings["dataset"]


def claim(settings: dict[str, Any]) -> None:
    """Record the settings of a run in its directory, or check the recorded ones.

    Those of a run that failed before it kept anything are replaced.

    Raises:
        ArtefactError: the run was made with other settings; names the differences.
        ValueError: a path from which orbax cannot read.
    """
    path = run_directory(settings) / "settings.json"
    unreadable = UNREADABLE & set(str(path.resolve()))
    if unreadable:
        raise ValueError(
            "checkpoints cannot be read back from a path "
            f"with {' '.join(sorted(unreadable))}: {path}"
        )
    if path.exists():
        changed = store.differences(store.read_json(path), identity(settings))
        if not changed:
            return
        if _has_weights(path.parent):
            raise store.ArtefactError(
                f"{path.parent} was made with other settings "
                f"({'; '.join(changed[:3])}); pass name=… for another run"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    store.write_json(path, identity(settings))


def _has_weights(run_dir: Path) -> bool:
    """Whether a run has trained weights or a checkpoint."""
    checkpoints = run_dir / "checkpoints"
    kept = checkpoints.is_dir() and any(checkpoints.iterdir())
    return kept or store.exists(run_dir / "policy.npz")


def boxes(dataset: Dataset) -> dict[str, Any]:
    """Return the box of the measurements, as lower and upper corners.

    Those of body state and control are hulls over training and calibration parts; that
    of the environment is E.
    """

    def hull(pick: Callable[[Trajectory], jax.Array]) -> list[list[float]]:
        values = np.concatenate(
            [np.asarray(pick(part)) for part in (dataset.train, dataset.calibration)]
        )
        flat = values.reshape(-1, values.shape[-1])
        return [flat.min(axis=0).tolist(), flat.max(axis=0).tolist()]

    return {
        "state": hull(lambda part: part.states[..., BODY]),
        "control": hull(lambda part: part.controls),
        "env": [
            np.asarray(dataset.env_low).tolist(),
            np.asarray(dataset.env_high).tolist(),
        ],
    }


def policy_settings(settings: dict[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Return the settings to store with a policy.

    Those of logged data include E, and the limits of controls unless they were given.

    Args:
        settings: of the run.
        dataset: that the policy is trained on.
    """
    recorded = identity(settings)
    if not is_logged(settings):
        return recorded
    box = {"env_low": dataset.env_low.tolist(), "env_high": dataset.env_high.tolist()}
    if recorded["vehicle"]["name"] == "own" and not recorded["vehicle"]["control_low"]:
        low, high = boxes(dataset)["control"]
        recorded |= {
            "vehicle": recorded["vehicle"] | {"control_low": low, "control_high": high}
        }
    return recorded | {"dataset": recorded["dataset"] | box}


def channel_names(settings: dict[str, Any]) -> dict[str, list[str]]:
    """Return the columns of the logs by box; an unused environment has none."""
    columns = settings["dataset"]["columns"]
    return {
        "state": columns["state"][BODY],
        "control": columns["control"],
        "env": columns["environment"] if has_environment(settings) else [],
    }


def open_loop_document(
    errors: jax.Array,
    trajectories: Trajectory,
    dt: float,
    baselines: Mapping[str, jax.Array],
) -> dict[str, Any]:
    """Return the content of open_loop.json.

    Args:
        errors: RMSE by step and coordinate.
        trajectories: that were predicted.
        dt: sampling period [s].
        baselines: the same errors of naive predictors, by name.
    """
    return {
        "steps": list(range(1, len(errors) + 1)),
        "dt": dt,
        "trajectories": trajectories.controls.shape[0],
        **_error_columns(errors),
        "baselines": {
            name: _error_columns(values) for name, values in baselines.items()
        },
    }


def _error_columns(errors: jax.Array) -> dict[str, list[float]]:
    """Errors by coordinate as lists over the steps ahead."""
    columns = np.asarray(errors, dtype=np.float64).T
    return {
        "position_rmse_m": np.hypot(columns[0], columns[1]).tolist(),
        "longitudinal_rmse_m": columns[0].tolist(),
        "lateral_rmse_m": columns[1].tolist(),
        "yaw_rmse_rad": columns[2].tolist(),
        "speed_rmse_m_per_s": columns[3].tolist(),
    }
