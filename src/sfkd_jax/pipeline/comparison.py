"""Evaluate the cells of a comparison; train and certify the policies they need."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from sfkd_jax import build, store
from sfkd_jax.pipeline import (
    certificates,
    dry_run,
    evaluate_system,
    grid,
    runs,
    stages,
    systems,
)
from sfkd_jax.plants import Vehicle

ComposeCell: TypeAlias = Callable[[grid.Cell], dict[str, Any]]
"""cell -> its settings, under the name of the comparison."""
MakeEpisodes: TypeAlias = Callable[
    [dict[str, Any], Vehicle], evaluate_system.EpisodeSet
]
"""(settings, vehicle) -> the episodes of a cell."""


def cached_episodes() -> MakeEpisodes:
    """Return `evaluate_system.make_episodes` with a cache, shared by compared rows."""
    cache: dict[str, evaluate_system.EpisodeSet] = {}

    def make_episodes(
        settings: dict[str, Any], plant: Vehicle
    ) -> evaluate_system.EpisodeSet:
        key = store.sha256(
            {name: settings[name] for name in ("vehicle", "scenario", "evaluation")}
        )
        if key not in cache:
            cache[key] = evaluate_system.make_episodes(settings, plant)
        return cache[key]

    return make_episodes


def check_group(
    group: list[grid.Cell],
    comparison: dict[str, Any],
    compose_cell: ComposeCell,
    make_episodes: MakeEpisodes,
) -> None:
    """Build what the cells of one row need that are not done, without training.

    Args:
        group: of `grid.group_cells`.
        comparison: its settings.
        compose_cell: for the settings of a cell.
        make_episodes: of `cached_episodes`.

    Raises:
        ValueError: settings that cannot be built.
    """
    for cell, settings, _ in _pending(group, compose_cell):
        plant = build.build_vehicle(settings["vehicle"])
        make_episodes(settings, plant)
        if "self" in settings["evaluation"]["systems"]:
            run_settings = _run_settings(cell, comparison, compose_cell)
            dry_run.check_settings(run_settings, plant)


def evaluate_group(
    group: list[grid.Cell],
    comparison: dict[str, Any],
    compose_cell: ComposeCell,
    make_episodes: MakeEpisodes,
) -> int:
    """Evaluate the cells of one row under one controller that are not done.

    Args:
        group: of `grid.group_cells`.
        comparison: its settings.
        compose_cell: for the settings of a cell.
        make_episodes: of `cached_episodes`.

    Returns:
        How many cells were evaluated.

    Raises:
        ValueError: settings that cannot be built.
        ArtefactError: damaged files, or a policy made with other settings.
        TrainingStopped: the training of the policy diverged.
    """
    evaluators: dict[str, evaluate_system.Evaluator] = {}
    done = 0
    for cell, settings, path in _pending(group, compose_cell):
        run_settings = _run_settings(cell, comparison, compose_cell)
        plant = build.build_vehicle(settings["vehicle"])
        episodes = make_episodes(settings, plant)
        key = grid.compilation_key(run_settings)
        if key not in evaluators:
            evaluators[key] = _compile_evaluator(run_settings, plant)
        result = evaluators[key](episodes)
        grid.write_cell(path, settings, episodes, result)
        error = 1e3 * result.row["rmse_m"]["mean"]
        store.print_message(f"{' '.join(map(str, cell))}: {error:.1f} mm")
        done += 1
    return done


def _pending(
    group: list[grid.Cell], compose_cell: ComposeCell
) -> Iterator[tuple[grid.Cell, dict[str, Any], Path]]:
    """The cells that are not done, their settings and their paths."""
    for cell in group:
        settings = compose_cell(cell)
        path = grid.cell_path(cell, settings)
        if not grid.is_done(path, settings):
            yield cell, settings, path


def _run_settings(
    cell: grid.Cell, comparison: dict[str, Any], compose_cell: ComposeCell
) -> dict[str, Any]:
    """The settings of a cell, under the name of the run of its policy."""
    settings = compose_cell(cell)
    usual = cell._replace(variation=next(iter(comparison["variations"])))
    retrained = runs.identity(settings) != runs.identity(compose_cell(usual))
    return settings | {"name": grid.policy_name(cell, comparison, retrained=retrained)}


def _compile_evaluator(
    settings: dict[str, Any], plant: Vehicle
) -> evaluate_system.Evaluator:
    """Compile the only system of a row; train and certify it first if it learns."""
    if "self" in settings["evaluation"]["systems"]:
        certificates.ensure_certificate(settings)
    ((name, system),) = systems.load_systems(settings, plant).items()
    return evaluate_system.compile_system(
        settings, plant, name, system, stages.ensure_dataset(settings)[0]
    )
