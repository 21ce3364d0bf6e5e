"""The directory of a run: what identifies it, its policy, and its results."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sfkd_jax import evaluation, store
from sfkd_jax.data import Dataset
from sfkd_jax.experiment.data import boxes, source_of
from sfkd_jax.experiment.options import Settings
from sfkd_jax.settings import plain

IDENTITY = ("vehicle", "environment", "dataset", "model", "training", "seed")
"""Settings that determine the weights of a run; of the environment, its box."""
EPISODES = "episodes"
UNREADABLE = frozenset("[]")
"""Characters of a path that the checkpoint library writes, but reads as a pattern."""

T = TypeVar("T")


def exclusive(run: Callable[[Settings], T]) -> Callable[[Settings], T]:
    """Wrap `run(settings)` so that it holds the lock of the run directory."""

    @functools.wraps(run)
    def locked(settings: Settings) -> T:
        with store.locked(settings.run_dir):
            return run(settings)

    return locked


def identity(settings: Settings) -> dict[str, Any]:
    """Return the settings that determine the weights of a run, as plain values."""
    return source_of(settings).config | {
        "model": plain(settings.model),
        "training": plain(settings.training),
        "seed": settings.seed,
    }


def claim(settings: Settings) -> None:
    """Record the settings of a run in its directory, or check the recorded ones.

    Those of a run that failed before it kept anything are replaced.

    Raises:
        ArtefactError: the run was made with other settings; names the differences.
        ValueError: a path from which orbax cannot read.
    """
    path = settings.run_dir / "settings.json"
    if unreadable := UNREADABLE & set(str(path.resolve())):
        raise ValueError(
            "checkpoints cannot be read back from a path "
            f"with {' '.join(sorted(unreadable))}: {path}"
        )
    wanted = identity(settings)
    if path.exists():
        changed = store.differences(store.read_json(path), wanted)
        if not changed:
            return
        # Without weights the recorded settings made nothing that could be mistaken.
        if _has_weights(path.parent):
            raise store.ArtefactError(
                f"{path.parent} was made with other settings "
                f"({'; '.join(changed[:3])}); pass name=… for another run"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    store.write_json(path, wanted)


def _has_weights(run_dir: Path) -> bool:
    """Whether a run has trained weights or a checkpoint."""
    checkpoints = run_dir / "checkpoints"
    kept = checkpoints.is_dir() and any(checkpoints.iterdir())
    return kept or (run_dir / "policy.safetensors").is_file()


def policy_settings(settings: Settings, dataset: Dataset) -> dict[str, Any]:
    """Return the settings to store with a policy, as plain values.

    Those of logged data include E, and the limits of controls unless they were given.

    Args:
        settings: of the run.
        dataset: that the policy is trained on.
    """
    recorded = identity(settings) | {
        "controller": plain(settings.controller),
        "experiment": settings.name,
    }
    if source_of(settings).logs is None:
        return recorded
    # Of logs E is measured, and whoever loads the policy has no logs.
    box = {"low": dataset.env_low.tolist(), "high": dataset.env_high.tolist()}
    vehicle = recorded["vehicle"]
    if vehicle["name"] == "own" and not vehicle["control_low"]:
        low, high = boxes(dataset)["control"]
        vehicle |= {"control_low": low, "control_high": high}
    return recorded | {"environment": box}


def read_results(run_dir: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the rows and the episodes that a run already has.

    Raises:
        ArtefactError: they are damaged.
    """
    results, episodes = run_dir / "results.json", run_dir / "episodes.safetensors"
    rows, arrays = [], {}
    if results.exists():
        rows = store.read_json(results, keys=("rows",))["rows"]
    if episodes.is_file():
        arrays, _ = store.read_arrays(episodes, kind=EPISODES)
    with store.as_artefact_error(results):
        return evaluation.merge([], rows), dict(arrays)


def write_results(
    run_dir: Path,
    config: Mapping[str, Any],
    rows: list[dict[str, Any]],
    arrays: Mapping[str, Any],
    seconds: float,
) -> Path:
    """Add rows and episodes to those of a run, also while other processes add theirs.

    Args:
        run_dir: of the run.
        config: plain settings that made the rows, and the command that was typed.
        rows: replace earlier rows of the same identity.
        arrays: by the names of episodes.safetensors.
        seconds: that the evaluation took [s].

    Returns:
        The path of results.json.
    """
    about = {name: config[name] for name in ("vehicle", "controller", "evaluation")}
    # Read and written under one lock, or rows of another process would be lost.
    with store.locked(run_dir, wait=True):
        earlier, old = read_results(run_dir)
        added = {name: np.asarray(array) for name, array in arrays.items()}
        # Arrays first: a row that is listed then has its episodes.
        store.write_arrays(
            run_dir / "episodes.safetensors", old | added, kind=EPISODES, config=about
        )
        document = {
            "rows": evaluation.merge(earlier, rows),
            "config": config,
            "versions": store.versions(),
            "seconds": seconds,
        }
        store.write_json(run_dir / "results.json", document)
    return run_dir / "results.json"
