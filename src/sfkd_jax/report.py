"""Write the page, tables and figures of a run, or of many runs."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.paper import beside_the_paper, write_comparison
from sfkd_jax.pipeline import store
from sfkd_jax.reporting import write_report


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Draw; nothing is recomputed."""
    pattern = settings["report"]["compare"]
    place = Path(settings["root"]) if pattern else store.run_directory(settings)
    alone = (
        artefacts.locked(place) if place.exists() else nullcontext()
    )  # or it makes what it then finds empty
    with alone, artefacts.as_artefact_error(place):
        pages = (
            write_comparison(place, pattern, settings["name"])
            if pattern
            else write_report(place, studies=beside_the_paper)
        )
    artefacts.print_message(f"report: {pages['report']}")
    return pages


if __name__ == "__main__":
    hydra_command(run)()
