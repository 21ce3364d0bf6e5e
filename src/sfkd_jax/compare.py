"""Evaluate every row of a table; the same command continues."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax import store
from sfkd_jax.experiment.command import command_line, hydra_command
from sfkd_jax.experiment.comparing import Comparison
from sfkd_jax.experiment.run import Run
from sfkd_jax.report.run import write_results_page


def main(run: Run) -> dict[str, Any]:
    """Evaluate all cells that are not done, then collect, compare and draw all rows.

    With `comparison.share` only this share of the rows is evaluated, and no row is
    collected.
    """
    began = time.perf_counter()
    settings = run.settings
    table = Comparison(settings)
    evaluated = table.evaluate()
    if settings.comparison.share is not None:
        return {"results": None, "rows": evaluated, "failed": len(table.failed)}
    results = table.directory / "results.json"
    with store.locked(table.directory, wait=True):
        rows = table.rows()
        document = {
            "rows": rows,
            "config": {**store.plain(settings), "command": command_line("compare")},
            "versions": store.versions(),
            "failed": table.failed,
            "seconds": time.perf_counter() - began if evaluated else None,
        }
        store.write_json(results, document)
        with store.as_artefact_error(table.directory):
            pages = write_results_page(table.directory)
    return {
        "results": str(results),
        "rows": len(rows),
        "failed": len(table.failed),
        **pages,
    }


if __name__ == "__main__":
    hydra_command(main)()
