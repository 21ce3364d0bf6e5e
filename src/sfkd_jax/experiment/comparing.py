"""Evaluate the rows of a table; train and certify the policies that they need."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import HydraException
from jax.errors import JaxRuntimeError
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import store
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.experiment import command, data, evaluating, grid, runs, stages
from sfkd_jax.experiment.grid import Cell
from sfkd_jax.experiment.options import Settings
from sfkd_jax.settings import plain, replace
from sfkd_jax.training import TrainingStopped


class Comparison:
    """The rows of one table on their scenarios.

    Attributes:
        directory: of its cells and its page.
        cells: of all rows.
        failed: why a row failed, by its name.
    """

    def __init__(self, settings: Settings) -> None:
        """List the cells of the comparison."""
        self.directory = Path(settings.root) / settings.name
        self.cells = grid.list_cells(settings.comparison)
        self.failed: dict[str, str] = {}
        self._settings = settings
        # Composed once: every cell is asked for its settings several times.
        self._compose = functools.cache(self._composed)
        self._episodes: dict[str, evaluating.EpisodeSet] = {}

    def evaluate(self) -> int:
        """Evaluate all cells that are not done, and return how many there were.

        Every row is built before the first one is trained; those that cannot be built
        are named and left out. With `comparison.share` only this share of the rows is
        evaluated.
        """
        began, done = time.perf_counter(), 0
        share = self._settings.comparison.share
        groups = grid.take_share(grid.group_cells(self.cells), share)
        for group in groups:
            with self._named_if_it_fails(group):
                self._check(group)
        groups = [group for group in groups if _name(group) not in self.failed]
        for number, group in enumerate(groups, 1):
            with self._named_if_it_fails(group):
                done += self._evaluate(group)
            if done:
                seconds = time.perf_counter() - began
                left = seconds / number * (len(groups) - number)
                store.print_message(
                    f"[{number}/{len(groups)}] {seconds / 60:.0f} min so far, "
                    f"about {left / 60:.0f} min left"
                )
        return done

    def rows(self) -> list[Row]:
        """Return the rows of all stored cells.

        Raises:
            ValueError: there is none.
        """
        with store.as_artefact_error(self.directory / "cells"):
            rows = grid.collect_rows(self.cells, self.directory, self._compose)
        if not rows:
            reasons = "; ".join(self.failed.values()) or "none was requested"
            raise ValueError(f"nothing to compare: no row came out ({reasons})")
        return rows

    def _composed(self, cell: Cell) -> Settings:
        """The settings of a cell, under the name of the comparison."""
        comparison = self._settings.comparison
        try:
            composed = command.compose(*grid.overrides(cell, comparison))
        except (HydraException, OmegaConfBaseException) as reason:
            line = " ".join(str(reason).split("\n")[0].split())
            raise ValueError(f"row {cell.label}: {line}") from None
        varied = cell.variation if comparison.variations[cell.variation] else None
        protocol = replace(composed.evaluation, variation=varied)
        return replace(composed, name=self._settings.name, evaluation=protocol)

    @contextmanager
    def _named_if_it_fails(self, group: list[Cell]) -> Iterator[None]:
        """Print and store why a row failed, and go on with the others."""
        try:
            yield
        except (
            TrainingStopped,
            ValueError,
            store.ArtefactError,
            JaxRuntimeError,  # such as memory that does not suffice
        ) as reason:
            line = next(iter(str(reason).splitlines()), type(reason).__name__)
            self.failed[_name(group)] = line
            store.print_message(f"failed: {line}")

    def _check(self, group: list[Cell]) -> None:
        """Build what the cells of one row need that are not done, without training."""
        checked: set[str] = set()
        for cell, settings, _ in self._pending(group):
            self._make_episodes(settings)
            # One check a program: cells that differ in scenario alone build the same.
            key = grid.compilation_key(settings)
            if "self" in settings.evaluation.systems and key not in checked:
                checked.add(key)
                stages.check_settings(self._run_settings(cell))

    def _evaluate(self, group: list[Cell]) -> int:
        """Evaluate the cells of one row under one controller that are not done.

        Raises:
            ValueError: settings that cannot be built.
            ArtefactError: damaged files, or a policy made with other settings.
            TrainingStopped: the training of the policy diverged.
        """
        evaluations: dict[str, evaluating.SystemEvaluation] = {}
        done = 0
        for cell, settings, path in self._pending(group):
            run_settings = self._run_settings(cell)
            episodes = self._make_episodes(settings)
            key = grid.compilation_key(run_settings)
            # Compiled once for all scenarios and variations that share a program.
            if key not in evaluations:
                evaluations[key] = _compile(run_settings)
            result = evaluations[key](episodes)
            grid.write_cell(path, self.directory, settings, episodes, result)
            error = 1e3 * result.row["rmse_m"]["mean"]
            store.print_message(f"{' '.join(map(str, cell))}: {error:.1f} mm")
            done += 1
        return done

    def _pending(self, group: list[Cell]) -> Iterator[tuple[Cell, Settings, Path]]:
        """The cells that are not done, their settings and their paths."""
        for cell in group:
            settings = self._compose(cell)
            path = grid.cell_path(cell, self.directory)
            if not grid.is_done(path, settings):
                yield cell, settings, path

    def _run_settings(self, cell: Cell) -> Settings:
        """The settings of a cell, under the name of the run of its policy."""
        settings, comparison = self._compose(cell), self._settings.comparison
        # The first variation is the usual protocol;
        # those that train alike reuse its policy.
        usual = cell._replace(variation=next(iter(comparison.variations)))
        retrained = runs.identity(settings) != runs.identity(self._compose(usual))
        name = grid.policy_name(cell, comparison, retrained=retrained)
        return replace(settings, name=name)

    def _make_episodes(self, settings: Settings) -> evaluating.EpisodeSet:
        """The episodes of a cell; rows that are compared share them."""
        # Not the controller: rows are paired because they meet the same episodes.
        parts = (settings.vehicle, settings.scenario, settings.environment)
        key = store.sha256(plain([*parts, settings.evaluation]))
        if key not in self._episodes:
            self._episodes[key] = evaluating.make_episodes(settings)
        return self._episodes[key]


def _name(group: list[Cell]) -> str:
    """The name of a row under one controller."""
    return "/".join(map(str, group[0][:4]))


def _compile(settings: Settings) -> evaluating.SystemEvaluation:
    """Compile the only system of a row; train and certify it first if it learns."""
    if "self" in settings.evaluation.systems:
        stages.ensure_certificate(settings)
    ((name, system),) = evaluating.load_systems(settings).items()
    dataset, _ = data.ensure_dataset(settings)
    return evaluating.SystemEvaluation(settings, name, system, dataset)
