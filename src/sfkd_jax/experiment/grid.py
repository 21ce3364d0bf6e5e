"""The cells of a comparison: which there are, their settings and stored results."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sfkd_jax import evaluation, store
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.experiment import runs
from sfkd_jax.experiment.evaluating import EpisodeSet, SystemResult
from sfkd_jax.experiment.options import ComparisonSettings, Settings
from sfkd_jax.settings import plain, replace

KIND = "cell"
NUM_STORED_EPISODES = 2
"""Episodes of a cell whose arrays are stored for figures; its row covers them all."""


class Cell(NamedTuple):
    """One row of the comparison on one scenario.

    Attributes:
        vehicle: as in the settings.
        label: of the row.
        seed: as in the settings.
        controller: as in the settings.
        variation: of the protocol.
        scenario: as in the settings.
    """

    vehicle: str
    label: str
    seed: int
    controller: str
    variation: str
    scenario: str


ComposeCell: TypeAlias = Callable[[Cell], Settings]
"""cell -> its settings, under the name of the comparison."""


def list_cells(comparison: ComparisonSettings) -> list[Cell]:
    """Return all cells in the order of evaluation; those of one system are adjacent.

    Every row is evaluated from one seed before any from the next, so that a table that
    was interrupted still compares all rows.

    Raises:
        ValueError: `only`, `untrained` or `trained_once` names an unknown row, or a
            seed is repeated.
    """
    rows, seeds = comparison.rows, comparison.seeds
    for name in ("only", "untrained", "trained_once"):
        if unknown := set(getattr(comparison, name)) - set(rows):
            raise ValueError(
                f"unknown comparison.{name} {', '.join(sorted(unknown))}; "
                f"choose of {', '.join(rows) or 'none'}"
            )
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"comparison.seeds={list(seeds)} repeats a seed")
    labels = [label for label in rows if label in (comparison.only or rows)]
    first_seed_only = {*comparison.untrained, *comparison.trained_once}
    cells = []
    for seed, vehicle, label in itertools.product(seeds, comparison.vehicles, labels):
        # Untrained rows have no seed; those trained once are rows of the first alone.
        if label in first_seed_only and seed != seeds[0]:
            continue
        for common, scenarios in comparison.controllers.items():
            own = comparison.own_controllers.get(label, {}).get(common, common)
            # A row may have no controller of its own for a common one.
            varied = itertools.product(comparison.variations, scenarios if own else ())
            cells += [Cell(vehicle, label, seed, str(own), *entry) for entry in varied]
    return cells


def group_cells(cells: list[Cell]) -> list[list[Cell]]:
    """Group cells that differ only in variation and scenario."""
    return [
        list(group) for _, group in itertools.groupby(cells, key=lambda cell: cell[:4])
    ]


def take_share(
    groups: list[list[Cell]], share: tuple[int, int] | None
) -> list[list[Cell]]:
    """Return the groups of every n-th row from the k-th on, share = [k, n].

    All groups of a row are in one share, because they use the same policy.

    Raises:
        ValueError: not 0 ≤ k < n.
    """
    if share is None:
        return groups
    first, count = share
    if not 0 <= first < count:
        raise ValueError(
            f"comparison.share must be [k, n] with 0 <= k < n, got {list(share)}"
        )
    # In order of appearance, so that every process counts the rows alike.
    rows = list(dict.fromkeys(group[0][:3] for group in groups))
    return [group for group in groups if rows.index(group[0][:3]) % count == first]


def overrides(cell: Cell, comparison: ComparisonSettings) -> list[str]:
    """Return the overrides of a cell, beyond those of the command."""
    tuned = comparison.tuned.get(cell.vehicle, {}).get(cell.label)
    words = comparison.rows[cell.label], tuned, comparison.variations[cell.variation]
    return [
        f"vehicle={cell.vehicle}",
        f"scenario={cell.scenario}",
        f"controller={cell.controller}",
        f"seed={cell.seed}",
        *(word for text in words for word in (text or "").split()),
    ]


def policy_name(cell: Cell, comparison: ComparisonSettings, *, retrained: bool) -> str:
    """Return the name of the run that trains the policy of a cell.

    A variation that is `retrained`, with other weights, needs a run of its own.
    """
    parts = [comparison.policies, cell.vehicle, cell.label]
    return "/".join([*parts, _slug(cell.variation)] if retrained else parts)


def cell_path(cell: Cell, directory: Path) -> Path:
    """Return the path of a cell's files, without their suffixes.

    It is cells/vehicle/variation/scenario/controller/label-seed=N.
    """
    folders = (cell.vehicle, _slug(cell.variation), cell.scenario, cell.controller)
    return directory.joinpath("cells", *folders, f"{cell.label}-seed={cell.seed}")


def compilation_key(settings: Settings) -> str:
    """Hash the settings that a compiled evaluation depends on; equal keys share it."""
    # Neither the sensor of e nor the name of a variation is compiled in.
    compiled = replace(
        settings,
        environment=replace(settings.environment, sensor={}),
        evaluation=replace(settings.evaluation, variation=None),
    )
    about = {"name": settings.name, "scenario": None}
    return store.sha256(_evaluated(compiled) | about)


def settings_hash(settings: Settings) -> str:
    """Hash the settings that the result of a cell depends on.

    Neither the code nor the location of the artefacts enters.
    """
    return store.sha256(_evaluated(settings))


def _evaluated(settings: Settings) -> dict[str, Any]:
    names = ("environment", "controller", "scenario", "certification", "evaluation")
    chosen = {name: plain(getattr(settings, name)) for name in names}
    return runs.identity(settings) | chosen


def episodes_hash(settings: Settings) -> str:
    """Hash what the roads and the plant of a cell depend on.

    Rows with another hash met other episodes, and are not paired with it.
    """
    protocol = settings.evaluation
    names = ("seed", "episodes", "episode_s")
    return store.sha256(
        {name: getattr(protocol, name) for name in names}
        | {"vehicle": plain(settings.vehicle), "scenario": plain(settings.scenario)}
    )


def is_done(path: Path, settings: Settings) -> bool:
    """Whether an undamaged cell with exactly these settings is stored."""
    try:
        document = store.read_json(_row_file(path), keys=("row",))
        return document["made_with"] == settings_hash(settings)
    # Damaged, missing or unfinished: the cell is evaluated again.
    except (store.ArtefactError, OSError, KeyError):
        return False


def write_cell(
    path: Path,
    directory: Path,
    settings: Settings,
    episodes: EpisodeSet,
    result: SystemResult,
) -> Row:
    """Write the arrays of the first episodes, then the row, and return the row.

    Args:
        path: of the cell, without suffix.
        directory: of the comparison.
        settings: of the cell.
        episodes: that were simulated.
        result: row and arrays.
    """
    scenarios = episodes.scenarios
    arrays = result.arrays | {"envs": scenarios.envs, "path": scenarios.path.points}
    # Copied to the host first: slices on a device would be compiled.
    stored = {
        name: np.asarray(array)[:NUM_STORED_EPISODES] for name, array in arrays.items()
    }
    stored["dt"] = np.asarray(settings.vehicle.dt)
    file = path.with_name(f"{path.name}.safetensors")
    store.write_arrays(file, stored, kind=KIND, config=plain(settings.scenario))
    row = result.row | {
        "arrays": str(file.relative_to(directory)),
        "provenance": runs.provenance(),
    }
    # The row last: its file is what marks a cell as done.
    document = {"row": row, "made_with": settings_hash(settings)}
    store.write_json(_row_file(path), document)
    return row


def collect_rows(
    cells: list[Cell], directory: Path, compose_cell: ComposeCell
) -> list[Row]:
    """Return the rows of all stored cells, with seeds pooled and systems compared.

    Prints how many cells were made with other settings, and how many by other code.
    """
    pooled: dict[Cell, list[Row]] = {cell._replace(seed=0): [] for cell in cells}
    others, by_other_code = [], []
    for cell in cells:
        path = _row_file(cell_path(cell, directory))
        if not path.exists():
            continue
        document = store.read_json(path, keys=("row", "made_with"))
        settings = compose_cell(cell)
        if document["made_with"] != settings_hash(settings):
            others.append(path)
            continue
        row = document["row"] | {"drives": episodes_hash(settings)}
        # Seeds of a row are pooled under one key.
        pooled[cell._replace(seed=0)].append(row)
        if row.get("provenance", {}).get("source") != runs.source_hash():
            by_other_code.append(path)
    for paths, who, what in (
        (others, "with other settings", "left out"),
        (by_other_code, "by other code", "used, and marked on the page"),
    ):
        if paths:
            store.print_message(
                f"{len(paths)} cells were made {who}, such as {paths[0]}: {what}"
            )
    rows = []
    for cell, trainings in pooled.items():
        if trainings:
            with store.as_artefact_error(cell_path(cell, directory)):
                rows.append(evaluation.pool(trainings))
    return evaluation.compare(rows, missing=len(pooled) - len(rows))


def _row_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.row.json")


def _slug(words: str) -> str:
    """Words as the name of a folder."""
    return "_".join(words.split()) or "none"
