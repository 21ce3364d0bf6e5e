"""python -m sfkd_jax.compare: train and drive every row of a table, cell by cell; the same command continues."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from sfkd_jax import artefacts, build, certify
from sfkd_jax.cli.config import command, compose, door
from sfkd_jax.pipeline import dry_run, evaluate_system, grid, stages, store
from sfkd_jax.reporting import benchmark_report
from sfkd_jax.training import TrainingStopped
from sfkd_jax.vehicle import Vehicle

_Composed: TypeAlias = Callable[[grid.Cell], dict[str, Any]]
"""The settings of a cell, under the name of the comparison."""
_Lay: TypeAlias = Callable[[dict[str, Any], Vehicle], evaluate_system.EpisodeSet]
"""The episodes of a cell's settings."""


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Whatever is missing is made; then all rows are collected, compared and drawn."""
    began, comparison = time.perf_counter(), settings["comparison"]
    wanted = grid.plan(comparison)
    groups = (
        grid.take_share(grid.drivers(wanted), comparison["share"])
        if comparison["drive"]
        else []
    )
    driven, failed = 0, {}
    composed, lay = (
        functools.cache(functools.partial(_compose, comparison=comparison)),
        _surveyor(),
    )
    for number, group in enumerate(groups):
        try:
            driven += _drive(group, comparison, composed, lay)
        except (TrainingStopped, ValueError, artefacts.ArtefactError) as reason:
            failed["/".join(map(str, group[0][:4]))] = str(reason)
            artefacts.print_message(f"failed: {reason}")
        if driven:
            _estimate(number + 1, len(groups), time.perf_counter() - began)
    if (
        comparison["share"] is not None
    ):  # others drive the rest: whoever comes last collects
        return {"results": None, "rows": driven, "failed": len(failed)}
    place = Path(settings["root"]) / settings["name"]
    with artefacts.locked(place, wait=True):
        return _collect(
            wanted,
            settings,
            composed,
            failed,
            time.perf_counter() - began if driven else None,
        )


def _collect(
    wanted: list[grid.Cell],
    settings: dict[str, Any],
    composed: _Composed,
    failed: dict[str, str],
    seconds: float | None,
) -> dict[str, Any]:
    """Write the results of all cells that are done, and what is drawn of them."""
    comparison, place = (
        settings["comparison"],
        Path(settings["root"]) / settings["name"],
    )
    with artefacts.as_artefact_error(place / "cells"):
        rows = grid.collect(
            wanted,
            settings,
            lambda cell: grid.settings_hash(composed(cell)),
            older=comparison["older"],
        )
    if not rows:
        raise ValueError(
            f"nothing to compare: no row came out ({'; '.join(failed.values()) or 'none was asked for'})"
        )
    made_by = settings | {"command": command("compare")}
    document = {
        "rows": rows,
        "config": made_by,
        "versions": artefacts.versions(),
        "failed": failed,
    }
    artefacts.write_json(place / "results.json", document | {"seconds": seconds})
    with artefacts.as_artefact_error(place):
        pages = benchmark_report(place)
    return {
        "results": str(place / "results.json"),
        "rows": len(rows),
        "failed": len(failed),
        **pages,
    }


def _drive(
    group: list[grid.Cell], comparison: dict[str, Any], composed: _Composed, lay: _Lay
) -> int:
    """Drive what is missing of one row under one controller; returns how many cells that were."""
    drivers: dict[str, evaluate_system.Evaluator] = {}
    done = 0
    for cell in group:
        settings = composed(cell)
        path, of_policy = (
            grid.place(cell, settings),
            _of_policy(cell, comparison, composed),
        )
        if grid.is_done(path, settings):
            continue
        plant, key = build.build_vehicle(settings["vehicle"]), grid.compilation_key(of_policy)
        track = lay(
            settings, plant
        )  # first: a road that there is not is refused before anything is trained
        if key not in drivers:
            drivers[key] = _driver(of_policy, plant)
        found = drivers[key](track)
        grid.write(path, settings, track, found)
        artefacts.print_message(
            f"{' '.join(map(str, cell))}: {1e3 * found.row['rmse_m']['mean']:.1f} mm"
        )
        done += 1
    return done


def _surveyor() -> _Lay:
    """`evaluate_system.make_episodes` with a memory: rows that are compared meet the same roads."""
    known: dict[str, evaluate_system.EpisodeSet] = {}

    def lay(settings: dict[str, Any], plant: Vehicle) -> evaluate_system.EpisodeSet:
        place = artefacts.sha256(
            {name: settings[name] for name in ("vehicle", "scenario", "evaluation")}
        )
        if place not in known:
            known[place] = evaluate_system.make_episodes(settings, plant)
        return known[place]

    return lay


def _driver(settings: dict[str, Any], plant: Vehicle) -> evaluate_system.Evaluator:
    """A row's only system, trained and certified if it learns."""
    if "self" in settings["evaluation"]["systems"]:
        dry_run.check(settings, plant)
        _certified(settings)
    ((name, system),) = stages.systems(settings, plant).items()
    return evaluate_system.compile_system(
        settings, plant, name, system, stages.ensure_dataset(settings)[0]
    )


def _certified(settings: dict[str, Any]) -> None:
    """A policy with what can be proved about it beside it."""
    place = store.run_directory(settings)
    if artefacts.exists(place / "policy.npz") and certify.certificate_path(place).exists():
        stages.ensure_policy(settings)
        return
    with artefacts.locked(
        place, wait=True
    ):  # a process with another share may train it for us
        stages.ensure_policy(settings)
        if not certify.certificate_path(place).exists():
            certify.renew(settings)


def _compose(cell: grid.Cell, comparison: dict[str, Any]) -> dict[str, Any]:
    """The settings of a cell, under the name of the comparison."""
    asked = compose(*grid.overrides(cell, comparison))
    asked["evaluation"]["variation"] = (
        None if not comparison["variations"][cell.variation] else cell.variation
    )
    return asked


def _of_policy(
    cell: grid.Cell, comparison: dict[str, Any], composed: _Composed
) -> dict[str, Any]:
    """The settings of a cell, under the name of its policy's run."""
    asked, usual = (
        composed(cell),
        cell._replace(variation=next(iter(comparison["variations"]))),
    )
    retrained = store.identity(asked) != store.identity(composed(usual))
    return asked | {"name": grid.policy_name(cell, comparison, retrained=retrained)}


def _estimate(done: int, total: int, seconds: float) -> None:
    """How far it is and how long it may take."""
    left = seconds / done * (total - done)
    artefacts.print_message(
        f"[{done}/{total}] {seconds / 60:.0f} min so far, about {left / 60:.0f} min left"
    )


if __name__ == "__main__":
    door(run)()
