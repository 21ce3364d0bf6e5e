"""python -m sfkd_jax.evaluate: drive paired episodes with every system and score them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig

from sfkd_jax import artefacts, build, evaluation
from sfkd_jax.cli.config import command, door
from sfkd_jax.pipeline import dry_run, evaluate_system, stages, store

KIND = "episodes"


def run(settings: dict[str, Any], asked_by: str = "evaluate") -> dict[str, Any]:
    """Rows of results.json and the episodes behind them; rows of other drives in the same run stay.

    `asked_by` is the door that was opened; its command is kept with the results.
    """
    began = time.perf_counter()
    place, protocol = store.run_directory(settings), settings["evaluation"]
    plant = build.build_vehicle(settings["vehicle"])
    track = evaluate_system.make_episodes(
        settings, plant
    )  # first: a vehicle that nothing can drive is refused before anything is trained
    dry_run.check(settings, plant)
    _kept(
        place
    )  # first: nobody drives for an hour to hear that the earlier rows are damaged
    systems = stages.systems(settings, plant)
    dataset, _ = stages.ensure_dataset(settings)
    rows: list[dict[str, Any]] = []
    roads = dict(
        zip(artefacts.ROAD, (track.scenarios.envs, track.scenarios.path.points), strict=True)
    )
    arrays: dict[str, Any] = {}
    for name, system in systems.items():
        length = f"{protocol['episodes']} episodes of {protocol['episode_s']:.0f} s"
        artefacts.print_message(f"driving {length}: {name} on {track.name}")
        driven = evaluate_system.compile_system(settings, plant, name, system, dataset)(track)
        rows.append(driven.row)
        drive_name = artefacts.drive_name(driven.row)
        arrays |= {
            f"{drive_name}/{part}": array
            for part, array in (driven.arrays | roads).items()
        }
        artefacts.print_message(
            f"  rmse {driven.row['rmse_m']['mean']:.4f} m, worst {driven.row['max_deviation_m']:.3f} m"
        )
    arrays["dt"] = np.asarray(plant.dt)
    made_by = settings | (
        {"command": command(asked_by)} if HydraConfig.initialized() else {}
    )
    _write(
        place, made_by, evaluation.compare(rows), arrays, time.perf_counter() - began
    )
    return {"results": str(place / "results.json"), "rows": len(rows)}


def _kept(place: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and episodes that lie in a run."""
    results, episodes = place / "results.json", place / "episodes.npz"
    rows = (
        artefacts.read_json(results, keys=("rows",))["rows"] if results.exists() else []
    )
    arrays = (
        artefacts.read_arrays(episodes, kind=KIND)[0]
        if artefacts.exists(episodes)
        else {}
    )
    with artefacts.as_artefact_error(results):
        return artefacts.merge([], rows), artefacts.with_current_names(arrays, rows)


def _write(
    place: Path,
    settings: dict[str, Any],
    rows: list,
    arrays: dict[str, Any],
    seconds: float,
) -> None:
    """Store rows and episodes; what other drives left in this run stays, whoever writes it meanwhile."""
    config = {name: settings[name] for name in ("vehicle", "controller", "evaluation")}
    with artefacts.locked(place, wait=True):
        kept, old = _kept(place)
        arrays = old | {name: np.asarray(array) for name, array in arrays.items()}
        artefacts.write_arrays(place / "episodes.npz", arrays, kind=KIND, config=config)
        document = {
            "rows": artefacts.merge(kept, rows),
            "config": settings,
            "versions": artefacts.versions(),
        }
        artefacts.write_json(place / "results.json", document | {"seconds": seconds})


if __name__ == "__main__":
    door(run)()
