"""python -m sfkd_jax.report: a page, tables and figures from what lies in a run, or in many (`report.compare`)."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts
from sfkd_jax.cli.config import door
from sfkd_jax.pipeline import store
from sfkd_jax.paper import write_comparison
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
            else write_report(place)
        )
    artefacts.print_message(f"report: {pages['report']}")
    return pages


if __name__ == "__main__":
    door(run)()
