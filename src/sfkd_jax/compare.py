"""Evaluate every row of a table; the same command continues."""

from __future__ import annotations

import time
from typing import Any

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import store
from sfkd_jax.experiment import grid
from sfkd_jax.experiment.command import command_line, compose, hydra_command
from sfkd_jax.experiment.comparing import Comparison
from sfkd_jax.experiment.options import Settings
from sfkd_jax.report import write_results_page
from sfkd_jax.settings import plain, replace


def run(settings: Settings) -> dict[str, Any]:
    """Evaluate all cells that are not done, then collect, compare and draw all rows.

    With `comparison.share` only this share of the rows is evaluated, and nothing is
    collected.
    """
    began = time.perf_counter()

    def compose_cell(cell: grid.Cell) -> Settings:
        """The settings of a cell, under the name of the comparison."""
        try:
            composed = compose(*grid.overrides(cell, settings.comparison))
        except (HydraException, OmegaConfBaseException) as reason:
            line = " ".join(str(reason).split("\n")[0].split())
            raise ValueError(f"row {cell.label}: {line}") from None
        is_varied = settings.comparison.variations[cell.variation]
        variation = cell.variation if is_varied else None
        protocol = replace(composed.evaluation, variation=variation)
        return replace(composed, name=settings.name, evaluation=protocol)

    table = Comparison(settings, compose_cell)
    done = table.evaluate() if settings.comparison.drive else 0
    if settings.comparison.share is not None:
        return {"results": None, "rows": done, "failed": len(table.failed)}
    with store.locked(table.directory, wait=True):
        rows, results = table.rows(), table.directory / "results.json"
        document = {
            "rows": rows,
            "config": plain(settings) | {"command": command_line("compare")},
            "versions": store.versions(),
            "failed": table.failed,
            "seconds": time.perf_counter() - began if done else None,
        }
        store.write_json(results, document)
        with store.as_artefact_error(table.directory):
            pages = write_results_page(table.directory)
    summary = {"rows": len(rows), "failed": len(table.failed), **pages}
    return {"results": str(results)} | summary


if __name__ == "__main__":
    hydra_command(run)()
