"""Evaluate the rows of a table; train and certify the policies that they need."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from hydra.errors import HydraException
from jax.errors import JaxRuntimeError
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import store
from sfkd_jax.driving import simulation
from sfkd_jax.driving.simulation.metrics import Row
from sfkd_jax.experiment import command, evaluating, run_directory, stages
from sfkd_jax.experiment.evaluating import EpisodeSet, SystemResult
from sfkd_jax.experiment.options import ComparisonSettings, Settings
from sfkd_jax.experiment.run import Run
from sfkd_jax.experiment.source import DataSource
from sfkd_jax.settings import replace
from sfkd_jax.training import TrainingStopped

OF_A_ROW = (TrainingStopped, ValueError, store.ArtefactError, JaxRuntimeError)
"""Errors that end a row and not the table; JAX raises its own if memory runs out."""
NUM_STORED_EPISODES = 2
"""Episodes of a cell whose arrays are stored for figures; its row covers them all."""


class Cell(NamedTuple):
    """One row of the comparison on one scenario.

    Attributes:
        vehicle: option of the group `vehicle`.
        label: of the row.
        seed: of the training.
        controller: option of the group `controller`.
        scenario: option of the group `scenario`.
    """

    vehicle: str
    label: str
    seed: int
    controller: str
    scenario: str

    def path(self, directory: Path) -> Path:
        """Return the path of the cell's files in a comparison, without suffixes."""
        folder = directory / "cells" / self.vehicle / self.scenario / self.controller
        return folder / f"{self.label}-seed={self.seed}"


def list_cells(comparison: ComparisonSettings) -> list[Cell]:
    """Return all cells in the order of evaluation; those of one system are adjacent.

    Seed by seed, so that a table that was interrupted still compares all rows.
    """
    rows = comparison.rows
    seeds = comparison.seeds
    for name in ("only", "one_seed"):
        if unknown := set(getattr(comparison, name)) - set(rows):
            raise ValueError(
                f"unknown comparison.{name} {', '.join(sorted(unknown))}; "
                f"choose of {', '.join(rows) or 'none'}"
            )
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"comparison.seeds={list(seeds)} repeats a seed")
    labels = [label for label in rows if label in (comparison.only or rows)]
    cells = []
    for seed, vehicle, label in itertools.product(seeds, comparison.vehicles, labels):
        if label in comparison.one_seed and seed != seeds[0]:
            continue
        replacements = comparison.own_controllers.get(label, {})
        for common, scenarios in comparison.controllers.items():
            controller = replacements.get(common, common)
            # A row may have no controller in place of a common one.
            if not controller:
                continue
            for scenario in scenarios:
                cells.append(Cell(vehicle, label, seed, controller, scenario))
    return cells


def group_cells(cells: list[Cell]) -> list[list[Cell]]:
    """Group cells that differ only in the scenario: one program evaluates them."""
    return [list(group) for _, group in itertools.groupby(cells, key=_without_scenario)]


def _without_scenario(cell: Cell) -> tuple[Any, ...]:
    """Return all of a cell but its scenario."""
    return cell[:4]


def take_share(
    groups: list[list[Cell]], share: tuple[int, int] | None
) -> list[list[Cell]]:
    """Return the groups of every n-th row from the k-th on, share = [k, n].

    All groups of a row are in one share, because they use the same policy.
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
    return [
        f"vehicle={cell.vehicle}",
        f"scenario={cell.scenario}",
        f"controller={cell.controller}",
        f"seed={cell.seed}",
        *(comparison.rows[cell.label] or "").split(),
        *(comparison.tuned.get(cell.vehicle, {}).get(cell.label) or "").split(),
    ]


def settings_hash(run: Run) -> str:
    """Hash the settings that the result of a cell depends on, not the code."""
    groups = ("environment", "controller", "scenario", "certification", "evaluation")
    further = {group: getattr(run.settings, group) for group in groups}
    return store.sha256({**run.identity, **further})


def episodes_hash(settings: Settings) -> str:
    """Hash what the roads and the plant of a cell depend on.

    Rows with another hash met other episodes, and are not paired with it.
    """
    protocol = settings.evaluation
    return store.sha256(
        [
            protocol.seed,
            protocol.episodes,
            protocol.episode_s,
            settings.vehicle,
            settings.scenario,
        ]
    )


def is_done(path: Path, run: Run) -> bool:
    """Return whether an undamaged cell with exactly these settings is stored."""
    try:
        document = store.read_json(_row_file(path), keys=("row",))
        return document["made_with"] == settings_hash(run)
    # Damaged, missing or unfinished: the cell is evaluated again.
    except (store.ArtefactError, OSError, KeyError):
        return False


def write_cell(path: Path, directory: Path, run: Run, result: SystemResult) -> Row:
    """Write the arrays of the first episodes, then the row, and return the row.

    Args:
        path: of the cell, without a suffix.
        directory: of the comparison.
        run: of the cell.
        result: of the system that the cell evaluates.
    """
    stored = {
        name: array[:NUM_STORED_EPISODES] if array.ndim else array
        for name, array in result.arrays.items()
    }
    name = str(path.with_name(f"{path.name}{store.SUFFIX}").relative_to(directory))
    row = run_directory.keep_episodes(directory, name, result.row, stored)
    row["provenance"] = run_directory.provenance()
    # The row last: its file is what marks a cell as done.
    document = {"row": row, "made_with": settings_hash(run)}
    store.write_json(_row_file(path), document)
    return row


def collect_rows(
    cells: list[Cell], directory: Path, run_of: Callable[[Cell], Run]
) -> list[Row]:
    """Return the rows of all stored cells, with seeds pooled and systems compared."""
    pooled: dict[Cell, list[Row]] = {cell._replace(seed=0): [] for cell in cells}
    with_other_settings = []
    by_other_code = []
    for cell in cells:
        path = _row_file(cell.path(directory))
        if not path.exists():
            continue
        document = store.read_json(path, keys=("row", "made_with"))
        run = run_of(cell)
        if document["made_with"] != settings_hash(run):
            with_other_settings.append(path)
            continue
        row = {**document["row"], "drives": episodes_hash(run.settings)}
        # Seeds of a row are pooled under one key.
        pooled[cell._replace(seed=0)].append(row)
        if row.get("provenance") != run_directory.provenance():
            by_other_code.append(path)
    _print_count(with_other_settings, "other settings: left out")
    _print_count(by_other_code, "other code: used")
    rows = []
    for cell, trainings in pooled.items():
        if trainings:
            with store.as_artefact_error(cell.path(directory)):
                rows.append(simulation.pool(trainings))
    return simulation.compare(rows, missing=len(pooled) - len(rows))


def _print_count(paths: list[Path], reason: str) -> None:
    """Print how many cells were made by something else, if there are any."""
    if paths:
        store.print_message(
            f"{len(paths)} cells were made by {reason}, such as {paths[0]}"
        )


def _row_file(path: Path) -> Path:
    """Return the path of the row of a cell, whose path has no suffix."""
    return path.with_name(f"{path.name}.row.json")


class Comparison:
    """The rows of one table on their scenarios; `failed` says why a row has none."""

    def __init__(self, settings: Settings) -> None:
        """List the cells of the comparison."""
        self.directory = Path(settings.root) / settings.name
        self.cells = list_cells(settings.comparison)
        self.failed: dict[str, str] = {}
        self._settings = settings
        # Composed once: every cell is asked for its run several times.
        self._run_of = functools.cache(self._compose)
        self._sources: dict[str, DataSource] = {}
        self._episodes: dict[str, EpisodeSet] = {}

    def evaluate(self) -> int:
        """Evaluate all cells that are not done, and return how many there were."""
        groups = take_share(group_cells(self.cells), self._settings.comparison.share)
        # Every row is built before the first one is trained.
        for group in groups:
            with self._recorded_if_it_fails(group):
                self._check(group)
        sound = [group for group in groups if _name(group) not in self.failed]
        evaluated = 0
        for group in sound:
            with self._recorded_if_it_fails(group):
                evaluated += self._evaluate(group)
        return evaluated

    def rows(self) -> list[Row]:
        """Return the rows of all stored cells; a ValueError if there is none."""
        with store.as_artefact_error(self.directory / "cells"):
            rows = collect_rows(self.cells, self.directory, self._run_of)
        if not rows:
            reasons = "; ".join(self.failed.values()) or "none was requested"
            raise ValueError(f"nothing to compare: no row came out ({reasons})")
        return rows

    def _compose(self, cell: Cell) -> Run:
        """Return the run of a cell, under the name of the comparison."""
        try:
            composed = command.compose(*overrides(cell, self._settings.comparison))
        except (HydraException, OmegaConfBaseException) as reason:
            line = " ".join(str(reason).split("\n")[0].split())
            raise ValueError(f"row {cell.label}: {line}") from None
        run = Run.of(replace(composed, name=self._settings.name))
        # Rows on the same data read them, and simulate runs of S3, once.
        key = store.sha256([str(run.source.path), run.source.environment])
        return Run(run.settings, self._sources.setdefault(key, run.source))

    @contextmanager
    def _recorded_if_it_fails(self, group: list[Cell]) -> Iterator[None]:
        """Print and store why a row failed, and go on with the others."""
        try:
            yield
        except OF_A_ROW as reason:
            line = next(iter(str(reason).splitlines()), type(reason).__name__)
            self.failed[_name(group)] = line
            store.print_message(f"failed: {line}")

    def _check(self, group: list[Cell]) -> None:
        """Build what the cells of one row need that are not done, without training."""
        pending = list(self._pending(group))
        for _, run, _ in pending:
            self._make_episodes(run)
        # One check a row: its cells differ in scenario alone, and build the same.
        for cell, run, _ in pending[:1]:
            systems = run.settings.evaluation.systems
            if len(systems) != 1:
                raise ValueError(
                    f"row {cell.label}: evaluation.systems must be one system, "
                    f"got {list(systems)}"
                )
            if "self" in systems:
                stages.check_settings(self._of_policy(cell, run))

    def _evaluate(self, group: list[Cell]) -> int:
        """Evaluate the cells of one row under one controller that are not done.

        Returns how many there were.
        """
        evaluate = None
        evaluated = 0
        for cell, run, path in self._pending(group):
            episodes = self._make_episodes(run)
            # Compiled once for all scenarios.
            if evaluate is None:
                evaluate = self._compiled(cell, run)
            result = evaluate(episodes)
            write_cell(path, self.directory, run, result)
            error = 1e3 * result.row["rmse_m"]["mean"]
            store.print_message(f"{' '.join(map(str, cell))}: {error:.1f} mm")
            evaluated += 1
        return evaluated

    def _pending(self, group: list[Cell]) -> Iterator[tuple[Cell, Run, Path]]:
        """Yield the cells that are not done, with their runs and their paths."""
        for cell in group:
            run = self._run_of(cell)
            path = cell.path(self.directory)
            if not is_done(path, run):
                yield cell, run, path

    def _of_policy(self, cell: Cell, run: Run) -> Run:
        """Return the run that trains the policy of a cell."""
        policies = self._settings.comparison.policies
        return run.named(f"{policies}/{cell.vehicle}/{cell.label}")

    def _compiled(self, cell: Cell, run: Run) -> evaluating.SystemEvaluation:
        """Compile the system of a row; train and certify it first if it learns."""
        run = self._of_policy(cell, run)
        if "self" in run.settings.evaluation.systems:
            stages.ensure_certificate(run)
        ((name, system),) = evaluating.load_systems(run).items()
        return evaluating.SystemEvaluation(run, name, system)

    def _make_episodes(self, run: Run) -> EpisodeSet:
        """Return the episodes of a cell; rows that are compared share them."""
        settings = run.settings
        # Not the controller: rows are paired because they meet the same episodes.
        key = store.sha256(
            [
                settings.vehicle,
                settings.scenario,
                settings.environment,
                settings.evaluation,
            ]
        )
        if key not in self._episodes:
            self._episodes[key] = evaluating.make_episodes(run)
        return self._episodes[key]


def _name(group: list[Cell]) -> str:
    """Return the name of a row under one controller."""
    return "/".join(map(str, _without_scenario(group[0])))
