"""python -m sfkd_jax.report: a page, tables and figures from what lies in a run."""

from __future__ import annotations

from typing import Any

from sfkd_jax import shelf
from sfkd_jax.config import door
from sfkd_jax.reporting import write_report


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Draw; nothing is recomputed."""
    pages = write_report(shelf.run_directory(settings))
    shelf.say(f"report: {pages['report']}")
    return {"report": str(pages["report"]), "figures": [str(figure) for figure in pages["figures"]]}


if __name__ == "__main__":
    door(run)()
