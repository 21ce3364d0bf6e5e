"""Write the page, tables and figures of a run."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

from sfkd_jax import store
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run
from sfkd_jax.report.run import write_report
from sfkd_jax.report.system import write_system_report


def main(run: Run) -> dict[str, Any]:
    """Write the report of the run."""
    directory = run.directory
    write = write_report if run.settings.system is None else write_system_report
    # A lock would make a directory that does not exist.
    exclusive = store.locked(directory) if directory.exists() else nullcontext()
    with exclusive, store.as_artefact_error(directory):
        pages = write(directory)
    store.print_message(f"report: {pages['report']}")
    return pages


if __name__ == "__main__":
    hydra_command(main, of_systems=True)()
