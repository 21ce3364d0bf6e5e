"""The page of a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from sfkd_jax import store
from sfkd_jax.evaluation.formats import dig, plain
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.report import figures, pages, style, tables
from sfkd_jax.report import run as runs
from sfkd_jax.report.episodes import of_rows
from sfkd_jax.report.pages import Part, Picture, Section
from sfkd_jax.report.tables import grouped, record_table, title_of

_TABLE = ("inner_loop", "sampling")
"""Rows of one table share these; its columns are vehicles and scenarios."""
_FIGURE = ("vehicle", *_TABLE)
"""Rows of one figure share these."""


def write_results_page(directory: Path) -> dict[str, Any]:
    """Write `directory/report/`: index.html, table1.tex, figures, films.

    `directory` is that of a comparison, with results.json; the arrays of its rows may
    be missing. Returns the paths of the page and of its images.
    """
    source, home = directory / "results.json", directory / "report"
    with store.as_artefact_error(home), store.as_artefact_error(source, ValueError):
        results = store.read_json(source, keys=("rows",))
        images = runs.empty_folder(home / "figures")
        sections, captions = _results(results, directory, images)
        store.write_bytes(home / "table1.tex", pages.to_latex(captions).encode())
        title = plain(dig(results, "config", "name") or "Comparison")
        return pages.write_page(title, sections, home)


def _results(
    results: dict[str, Any], directory: Path, images: Path
) -> tuple[list[Section], list[tuple[str, pd.DataFrame]]]:
    """Tables, figures, every metric, what made them; then tables with captions."""
    rows: list[Row] = results["rows"]
    first: list[Part] = [tables.MARKS, tables.amount(rows)]
    if failed := results.get("failed"):
        first.append(record_table("Failed", failed, "reason"))
    # What the paper prints, of another simulator: not in one table with ours.
    paper = dict(dig(results, "config", "comparison", "paper") or {})
    heads = paper.pop("columns", [])
    if paper:
        printed = {style.label(name): numbers for name, numbers in paper.items()}
        first.append(record_table("Printed in the paper", printed, *heads))
    sections, metrics, captions = [Section("", first)], [], []
    for group in grouped(rows, _TABLE):
        # One table over all vehicles and scenarios: a group shares all that is left.
        title = title_of(group, _TABLE)
        table = tables.cross_table(group, tables.rmse_cell)
        if table is not None:
            sections.append(Section(title, [table]))
            captions.append((f"{title}. {tables.MARKS}", table))
        for metric in tables.shown_metrics():
            table = tables.cross_table(group, metric.text)
            if table is not None:
                head = f"{metric.head()}: {title}"
                metrics.append(Section(head, [table], folded=True))
    for number, group in enumerate(grouped(rows, _FIGURE), 1):
        drawn = _drawn(group, directory, images, number)
        sections.append(Section(title_of(group, _FIGURE), drawn))
    made = runs.made_with(results.get("config") or {}, results.get("versions"))
    return [*sections, *metrics, made], captions


def _drawn(group: list[Row], directory: Path, images: Path, number: int) -> list[Part]:
    """The paper's figures 1 and 2 and a film, of the last scenario that has them."""
    scenarios = grouped(group, ("scenario",))
    found = (of_rows(directory, rows) for rows in reversed(scenarios))
    episodes = next((one for one in found if one), [])
    parts: list[Part] = []
    if episodes:
        title = title_of([episodes[0].row], ("scenario", *_FIGURE))
        parts += runs.draw_episodes(episodes, images, title, number)
    forced = [row for row in scenarios[-1] if dig(row, "disturbed", "0")]
    if forced:
        path = style.save(images / f"forces_{number}.png", figures.side_forces, forced)
        parts.append(Picture(path, "RMSE by unmeasured side force"))
    return parts
