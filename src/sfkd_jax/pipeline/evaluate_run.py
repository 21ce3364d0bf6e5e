"""Evaluate the systems of a run, and write results.json and episodes.npz."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from sfkd_jax import build, evaluation, store
from sfkd_jax.pipeline import dry_run, evaluate_system, runs, stages, systems

KIND = "episodes"


def evaluate_run(
    settings: dict[str, Any], *, command: str | None = None
) -> dict[str, Any]:
    """Evaluate every system of `evaluation.systems` and add its rows to the results.

    Rows of other drives in the same run stay.

    Args:
        settings: of the run.
        command: that was typed; it is stored with the results.

    Returns:
        `results`, the path of results.json, and the number of new `rows`.

    Raises:
        ValueError: settings that cannot be built, or a vehicle that cannot be
            simulated.
        ArtefactError: the earlier results are damaged.
    """
    began = time.perf_counter()
    run_dir = runs.run_directory(settings)
    plant = build.build_vehicle(settings["vehicle"])
    # Vehicle, settings and earlier results are checked before anything is trained.
    episodes = evaluate_system.make_episodes(settings, plant)
    dry_run.check_settings(settings, plant)
    read_results(run_dir)
    compared = systems.load_systems(settings, plant)
    dataset, _ = stages.ensure_dataset(settings)
    rows: list[dict[str, Any]] = []
    arrays: dict[str, Any] = {}
    for name, system in compared.items():
        _announce(settings, name, episodes.name)
        evaluate = evaluate_system.compile_system(
            settings, plant, name, system, dataset
        )
        result = evaluate(episodes)
        rows.append(result.row)
        arrays |= _named_arrays(result, episodes)
        error, worst = result.row["rmse_m"]["mean"], result.row["max_deviation_m"]
        store.print_message(f"  rmse {error:.4f} m, worst {worst:.3f} m")
    arrays["dt"] = np.asarray(plant.dt)
    recorded = settings | ({} if command is None else {"command": command})
    seconds = time.perf_counter() - began
    write_results(run_dir, recorded, evaluation.compare(rows), arrays, seconds)
    return {"results": str(run_dir / "results.json"), "rows": len(rows)}


def _announce(settings: dict[str, Any], name: str, scenario: str) -> None:
    """Print which system is evaluated, and for how long."""
    protocol = settings["evaluation"]
    length = f"{protocol['episodes']} episodes of {protocol['episode_s']:.0f} s"
    store.print_message(f"driving {length}: {name} on {scenario}")


def _named_arrays(
    result: evaluate_system.SystemResult, episodes: evaluate_system.EpisodeSet
) -> dict[str, Any]:
    """The arrays of a drive under the names of episodes.npz."""
    scenarios = episodes.scenarios
    road = dict(zip(store.ROAD, (scenarios.envs, scenarios.path.points), strict=True))
    prefix = store.drive_name(result.row)
    return {f"{prefix}/{part}": array for part, array in (result.arrays | road).items()}


def read_results(run_dir: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the rows and the episodes that a run already has.

    Raises:
        ArtefactError: they are damaged.
    """
    results, episodes = run_dir / "results.json", run_dir / "episodes.npz"
    rows, arrays = [], {}
    if results.exists():
        rows = store.read_json(results, keys=("rows",))["rows"]
    if store.exists(episodes):
        arrays, _ = store.read_arrays(episodes, kind=KIND)
    with store.as_artefact_error(results):
        return store.merge([], rows), store.with_current_names(arrays, rows)


def write_results(
    run_dir: Path,
    settings: dict[str, Any],
    rows: list[dict[str, Any]],
    arrays: dict[str, Any],
    seconds: float,
) -> None:
    """Add rows and episodes to those of a run, also while other processes add theirs.

    Args:
        run_dir: of the run.
        settings: that made the rows.
        rows: replace earlier rows of the same identity.
        arrays: by the names of episodes.npz.
        seconds: that the evaluation took [s].
    """
    config = {name: settings[name] for name in ("vehicle", "controller", "evaluation")}
    with store.locked(run_dir, wait=True):
        earlier, old = read_results(run_dir)
        arrays = old | {name: np.asarray(array) for name, array in arrays.items()}
        store.write_arrays(run_dir / "episodes.npz", arrays, kind=KIND, config=config)
        document = {
            "rows": store.merge(earlier, rows),
            "config": settings,
            "versions": store.versions(),
            "seconds": seconds,
        }
        store.write_json(run_dir / "results.json", document)
