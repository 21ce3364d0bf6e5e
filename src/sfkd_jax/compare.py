"""Evaluate every row of a table; the same command continues."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from jax.errors import JaxRuntimeError
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import store
from sfkd_jax.cli import messages
from sfkd_jax.cli.config import command_line, compose
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.paper import write_results_page
from sfkd_jax.pipeline import grid
from sfkd_jax.pipeline.comparison import (
    ComposeCell,
    cached_episodes,
    check_group,
    evaluate_group,
)
from sfkd_jax.training import TrainingStopped


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Evaluate all cells that are not done, then collect, compare and draw all rows.

    Every row is built before the first one is trained; those that cannot be built are
    named and left out. With `comparison.share` only this share of the rows is
    evaluated, and nothing is collected.
    """
    began, comparison = time.perf_counter(), settings["comparison"]
    cells = grid.list_cells(comparison)
    groups = (
        grid.take_share(grid.group_cells(cells), comparison["share"])
        if comparison["drive"]
        else []
    )
    compose_cell = functools.cache(functools.partial(_compose, comparison=comparison))
    make_episodes = cached_episodes()
    failed: dict[str, str] = {}
    for group in groups:
        with _named_if_it_fails(group, failed):
            check_group(group, comparison, compose_cell, make_episodes)
    groups = [group for group in groups if _name(group) not in failed]
    done = 0
    for number, group in enumerate(groups, 1):
        with _named_if_it_fails(group, failed):
            done += evaluate_group(group, comparison, compose_cell, make_episodes)
        if done:
            _print_estimate(number, len(groups), time.perf_counter() - began)
    if comparison["share"] is not None:
        return {"results": None, "rows": done, "failed": len(failed)}
    seconds = time.perf_counter() - began if done else None
    with store.locked(_directory(settings), wait=True):
        return _collect(cells, settings, compose_cell, failed, seconds)


@contextmanager
def _named_if_it_fails(
    group: list[grid.Cell], failed: dict[str, str]
) -> Iterator[None]:
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
        failed[_name(group)] = line
        store.print_message(f"failed: {line}")


def _name(group: list[grid.Cell]) -> str:
    """The name of a row under one controller."""
    return "/".join(map(str, group[0][:4]))


def _directory(settings: dict[str, Any]) -> Path:
    return Path(settings["root"]) / settings["name"]


def _collect(
    cells: list[grid.Cell],
    settings: dict[str, Any],
    compose_cell: ComposeCell,
    failed: dict[str, str],
    seconds: float | None,
) -> dict[str, Any]:
    """Write the results of all cells that are done, and their report."""
    directory = _directory(settings)
    with store.as_artefact_error(directory / "cells"):
        rows = grid.collect_rows(
            cells,
            settings,
            compose_cell,
            older=settings["comparison"]["older"],
        )
    if not rows:
        reasons = "; ".join(failed.values()) or "none was requested"
        raise ValueError(f"nothing to compare: no row came out ({reasons})")
    document = {
        "rows": rows,
        "config": settings | {"command": command_line("compare")},
        "versions": store.versions(),
        "failed": failed,
        "seconds": seconds,
    }
    store.write_json(directory / "results.json", document)
    with store.as_artefact_error(directory):
        pages = write_results_page(directory)
    return {
        "results": str(directory / "results.json"),
        "rows": len(rows),
        "failed": len(failed),
        **pages,
    }


def _compose(cell: grid.Cell, comparison: dict[str, Any]) -> dict[str, Any]:
    """The settings of a cell, under the name of the comparison.

    Raises:
        ValueError: naming the row, if it has an unknown setting or option.
    """
    overrides = grid.overrides(cell, comparison)
    try:
        settings = compose(*overrides)
    except (HydraException, OmegaConfBaseException) as reason:
        raise ValueError(
            f"row {cell.label}: {messages.one_line(reason, overrides)}"
        ) from None
    is_varied = comparison["variations"][cell.variation]
    settings["evaluation"]["variation"] = cell.variation if is_varied else None
    return settings


def _print_estimate(done: int, total: int, seconds: float) -> None:
    """Print how many groups are done, and how long the others may take."""
    left = seconds / done * (total - done)
    store.print_message(
        f"[{done}/{total}] {seconds / 60:.0f} min so far, "
        f"about {left / 60:.0f} min left"
    )


if __name__ == "__main__":
    hydra_command(run)()
