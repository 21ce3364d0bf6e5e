"""The cells of a comparison: what is driven by whom, with which settings, and where each result is kept."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfkd_jax import artefacts, evaluation
from sfkd_jax.pipeline import store
from sfkd_jax.pipeline.evaluate_system import EpisodeSet, SystemResult

KIND = "cell"
NUM_STORED_EPISODES = 2
"""Episodes of a cell whose arrays are kept for figures; the measures of all are in its
row.
"""


class Cell(NamedTuple):
    """One row on one scenario.

    Attributes:
        vehicle, seed, controller, scenario: as in the settings.
        label: of the row.
        variation: of the protocol.
    """

    vehicle: str
    label: str
    seed: int
    controller: str
    variation: str
    scenario: str


def plan(comparison: dict[str, Any]) -> list[Cell]:
    """All cells in the order in which they are driven: what one driver does lies together.

    Raises:
        ValueError: `only` names a row that there is not.
    """
    unknown = set(comparison["only"]) - set(comparison["rows"])
    if unknown:
        known = ", ".join(comparison["rows"])
        raise ValueError(
            f"unknown comparison.only {', '.join(sorted(unknown))}; choose of {known or 'none'}"
        )
    labels = [
        label
        for label in comparison["rows"]
        if label in (comparison["only"] or comparison["rows"])
    ]
    cells = []
    for vehicle, seed, label in itertools.product(
        comparison["vehicles"], comparison["seeds"], labels
    ):
        for common, scenarios in comparison["controllers"].items():
            own = comparison["own_controllers"].get(label, {}).get(common, common)
            drives = itertools.product(
                comparison["variations"], scenarios if own else ()
            )
            cells += [Cell(vehicle, label, seed, own, *drive) for drive in drives]
    return cells


def drivers(wanted: list[Cell]) -> list[list[Cell]]:
    """Cells that differ in the road, or in what is told about it, alone."""
    return [
        list(group) for _, group in itertools.groupby(wanted, key=lambda cell: cell[:4])
    ]


def take_share(groups: list[list[Cell]], share: list[int] | None) -> list[list[Cell]]:
    """Those of every n-th row from the k-th on, share = [k, n]; all for None.

    All controllers and cells of a row lie in one share, for they share its policy.

    Raises:
        ValueError: a share that there is not.
    """
    if share is None:
        return groups
    first, count = share
    if not 0 <= first < count:
        raise ValueError(
            f"comparison.share must be [k, n] with 0 <= k < n, got {share}"
        )
    rows = {
        row: number
        for number, row in enumerate(dict.fromkeys(group[0][:3] for group in groups))
    }
    return [group for group in groups if rows[group[0][:3]] % count == first]


def overrides(cell: Cell, comparison: dict[str, Any]) -> list[str]:
    """What must be composed for a cell, beyond what the command asked for."""
    row, variation = (
        comparison["rows"][cell.label],
        comparison["variations"][cell.variation],
    )
    chosen = [
        f"vehicle={cell.vehicle}",
        f"scenario={cell.scenario}",
        f"controller={cell.controller}",
    ]
    return [
        *chosen,
        f"seed={cell.seed}",
        *(row or "").split(),
        *(variation or "").split(),
    ]


def policy_name(cell: Cell, comparison: dict[str, Any], *, retrained: bool) -> str:
    """The name of the run that holds a cell's policy; a variation that changes the training has its own."""
    parts = [comparison["policies"], cell.vehicle, cell.label]
    return "/".join([*parts, _slug(cell.variation)] if retrained else parts)


def place(cell: Cell, settings: dict[str, Any]) -> Path:
    """root/name/cells/vehicle/variation/scenario/controller/label-seed=N, without an ending."""
    folders = (cell.vehicle, _slug(cell.variation), cell.scenario, cell.controller)
    return Path(
        settings["root"],
        settings["name"],
        "cells",
        *folders,
        f"{cell.label}-seed={cell.seed}",
    )


def compilation_key(settings: dict[str, Any]) -> str:
    """The hash of what a driver is compiled from: cells that share it share the driver."""
    protocol = {
        name: value
        for name, value in settings["evaluation"].items()
        if name not in ("env_sensor", "variation")
    }
    asked = {
        name: settings[name]
        for name in (*store.IDENTITY, "controller", "certification", "name")
    } | {"env": settings["env_source"]}
    return artefacts.sha256(asked | {"evaluation": protocol})


def settings_hash(settings: dict[str, Any]) -> str:
    """The hash of the settings that a cell comes from; neither the code nor where the artefacts lie is in it."""
    asked = {
        name: settings[name]
        for name in (*store.IDENTITY, "controller", "scenario")
    } | {"env": settings["env_source"]}
    asked["evaluation"] = {  # stored cells were hashed under an earlier key
        "told" if name == "env_sensor" else name: value
        for name, value in settings["evaluation"].items()
    }
    return artefacts.sha256(asked | {"certification": settings["certification"]})


def is_done(path: Path, settings: dict[str, Any]) -> bool:
    """Whether a cell was driven with exactly these settings; a damaged one was not."""
    try:
        return artefacts.read_json(_row_file(path), keys=("row",))[
            "made_with"
        ] == settings_hash(settings)
    except (artefacts.ArtefactError, OSError, KeyError):
        return False


def write(
    path: Path, settings: dict[str, Any], track: EpisodeSet, driven: SystemResult
) -> dict[str, Any]:
    """Store arrays of the first episodes, then the row, which is returned: a kill between leaves a cell not done."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = driven.arrays | {"envs": track.scenarios.envs, "path": track.scenarios.path.points}
    kept = {name: np.asarray(array)[:NUM_STORED_EPISODES] for name, array in arrays.items()}
    kept["dt"] = np.asarray(settings["vehicle"]["dt"])
    file = path.with_name(f"{path.name}.npz")
    artefacts.write_arrays(file, kept, kind=KIND, config=settings["scenario"])
    row = driven.row | {
        "arrays": str(file.relative_to(Path(settings["root"], settings["name"])))
    }
    artefacts.write_json(
        _row_file(path), {"row": row, "made_with": settings_hash(settings)}
    )
    return row


def collect(
    cells: list[Cell],
    settings: dict[str, Any],
    expected: Callable[[Cell], str],
    *,
    older: bool = False,
) -> list[dict[str, Any]]:
    """The rows of all cells that are done, seeds pooled, systems compared; how many were left out is said.

    Args:
        cells: of the plan.
        settings: of the comparison.
        expected: what `made_with` is for a cell.
        older: take rows of cells made with other settings as well.
    """
    found: dict[Cell, list[dict[str, Any]]] = {}
    others = []
    for cell in cells:
        path = _row_file(place(cell, settings))
        if not path.exists():
            continue
        kept = artefacts.read_json(path, keys=("row", "made_with"))
        if kept["made_with"] != expected(cell):
            others.append(path)
        if older or kept["made_with"] == expected(cell):
            found.setdefault(cell._replace(seed=0), []).append(kept["row"])
    if others:
        done = (
            "taken all the same"
            if older
            else "left out; comparison.older=true takes them"
        )
        artefacts.print_message(
            f"{len(others)} cells were made with other settings, such as {others[0]}: {done}"
        )
    return evaluation.compare([evaluation.pool(rows) for rows in found.values()])


def _row_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.row.json")


def _slug(words: str) -> str:
    """Words as a name for a folder."""
    return "_".join(words.split()) or "none"
