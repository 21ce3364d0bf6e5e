"""Pages about many rows: a comparison, and a sweep over run directories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.evaluation import SHARED
from sfkd_jax.evaluation.formats import dig, is_number, plain
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.report import figures, pages, style
from sfkd_jax.report import rows as tables
from sfkd_jax.report import run as runs
from sfkd_jax.report.episodes import of_rows
from sfkd_jax.report.film import film_of
from sfkd_jax.report.pages import Page, Part, Picture, Section, Text
from sfkd_jax.report.rows import cross_table, grouped, record_table, title_of

_TABLE = ("inner_loop", "sampling", "variation")
"""Rows of one table share these; its columns are vehicles and scenarios."""
_FIGURE = ("vehicle", *_TABLE)
"""Rows of one figure share these."""


def write_results_page(directory: Path) -> dict[str, Any]:
    """Write `directory/report/`: index.html, results.md, table1.tex, figures, films.

    Args:
        directory: of a comparison, with results.json; the arrays of its rows may be
            missing.

    Returns:
        `report`: path of the page. `figures`: paths of its images.

    Raises:
        ArtefactError: results.json is missing, not JSON or without usable rows; the
            arrays of a row are damaged; or the page cannot be written.
    """
    source, home = directory / "results.json", directory / "report"
    with store.as_artefact_error(source, ValueError):
        results = store.read_json(source, keys=("rows",))
        images = runs.empty_folder(home / "figures")
        page = _results(results, directory, images)
        captions = [
            (f"{title_of(group, _TABLE)}. {tables.MARKS}", table)
            for group in grouped(results["rows"], _TABLE)
            if (table := cross_table(group, tables.rmse_cell))
        ]
        store.write_bytes(home / "table1.tex", pages.to_latex(captions).encode())
        return pages.write_page(page, home / "index.html", home / "results.md")


def write_comparison(root: Path, pattern: str, name: str) -> dict[str, Any]:
    """Write index.html, report.md, comparison.json and a figure of many runs.

    The files are in `root/name/comparison/`. What is in a missing file of a run is
    null, except for settings.json.

    Args:
        root: of all artefacts.
        pattern: of run directories below it, as `contraction/*/*/seed=*`.
        name: of the page.

    Returns:
        `report`, `comparison`: paths of the page and of the records. `figures`: paths
        of the figures.

    Raises:
        ValueError: no run matches.
        ArtefactError: a file that is not JSON, or the disk refuses the page.
    """
    home = root / name / "comparison"
    with store.as_artefact_error(home):
        # Sorted, so that the same runs make the same page on every file system.
        found = sorted(path.parent for path in root.glob(f"{pattern}/settings.json"))
        if not found:
            raise ValueError(f"no run below {root} matches {pattern}")
        records = [_record(run, root) for run in found]
        images = runs.empty_folder(home / "figures")
        page = Page(f"Comparison of runs: {name}", _sweep(records, images))
        path = home / "comparison.json"
        store.write_json(path, {"pattern": pattern, "rows": records})
        written = pages.write_page(page, home / "index.html", home / "report.md")
        return written | {"comparison": str(path)}


def _results(results: dict[str, Any], directory: Path, images: Path) -> Page:
    """Tables first, then figures, then every metric and what made the results."""
    rows: list[Row] = results["rows"]
    config = results.get("config") or {}
    options = config.get("comparison") or {}
    first: list[Part] = [Text(tables.MARKS), Text(tables.amount(rows))]
    if isinstance(failed := results.get("failed"), dict) and failed:
        first.append(record_table("Failed", failed, "reason"))
    sections, metrics = [Section("", first)], []
    for number, group in enumerate(grouped(rows, _TABLE), 1):
        # One table over all vehicles and scenarios: a group shares all that is left.
        title, table = title_of(group, _TABLE), cross_table(group, tables.rmse_cell)
        parts: list[Part] = [table] if table else []
        panels = grouped(group, ("vehicle", "scenario"))
        path = style.save(images / f"rmse_{number}.png", figures.rmse_chart, panels)
        parts.append(Picture(path, f"RMSE of every row: {title}"))
        sections.append(Section(title, parts))
        for metric in tables.shown_metrics():
            if table := cross_table(group, metric.text):
                metrics.append(
                    Section(f"{metric.head()}: {title}", [table], folded=True)
                )
    for number, group in enumerate(grouped(rows, _FIGURE), 1):
        title, stem = title_of(group, _FIGURE), f"{number}"
        parts = _drawn(group, directory, images, title, stem)
        if table := tables.printed_table(group, options):
            parts += [Text("Beside the paper, which uses another simulator."), table]
        sections.append(Section(title, parts))
    # The printed numbers are beside ours already.
    config |= {"comparison": {k: v for k, v in options.items() if k != "paper"}}
    sections += [*metrics, *runs.made_with(config, results.get("versions"))]
    return Page(plain(config.get("name") or "Comparison"), sections)


def _drawn(
    group: list[Row], directory: Path, images: Path, title: str, stem: str
) -> list[Part]:
    """The paper's figures 1 and 2 and a film, of the last scenario that has them."""
    parts: list[Part] = []
    scenarios = grouped(group, ("scenario",))
    for rows in reversed(scenarios):
        where = style.scenario_label(str(rows[0].get("scenario")))
        if not parts and (driven := of_rows(directory, rows)):
            path = images / f"figure1_{stem}.png"
            style.save(path, figures.first_episode, driven)
            parts += [Text(f"{where}."), Picture(path, f"Lateral error: {title}")]
            film = film_of(images / f"film_{stem}.gif", driven)
            parts += [Picture(film, f"Film: {title}")] if film else []
    forced = [row for row in scenarios[-1] if dig(row, "disturbed", "0")]
    if forced:
        path = style.save(images / f"figure2_{stem}.png", figures.side_forces, forced)
        parts.append(Picture(path, f"RMSE by unmeasured side force: {title}"))
    return parts


def _record(run: Path, root: Path) -> dict[str, Any]:
    """The settings of a run, and the rows of its system."""
    settings, certificate = (
        store.read_json(run / "settings.json"),
        runs.read_certificate(run),
    )
    errors = runs.read_optional(run / "open_loop.json")
    with store.as_artefact_error(run / "results.json", ValueError):
        rows = runs.read_optional(run / "results.json").get("rows") or []
        own = [
            tables.row_of(group, tables.model_of(settings))
            for group in grouped(rows, SHARED)
        ]
    # A run that was not driven still has its predictions and its certificate.
    ahead = [errors.get(key) or [] for key in ("steps", "position_rmse_m")]
    about = {"open_loop_rmse_m": dict(zip(map(str, ahead[0]), ahead[1], strict=False))}
    about |= {"alpha": certificate.get("alpha"), "scenario": "not driven"}
    return {
        "run": str(run.relative_to(root)),
        "settings": _flat(settings),
        "refused": certificate.get("reason"),
        "rows": [row for row in own if row] or [about],
    }


def _flat(config: dict[str, Any], before: str = "") -> dict[str, Any]:
    """Nested settings by dotted names."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        nested = isinstance(value, dict)
        flat |= _flat(value, f"{before}{name}.") if nested else {before + name: value}
    return flat


def _sweep(records: list[dict[str, Any]], images: Path) -> list[Section]:
    """The settings that differ, one figure, and every metric of every run."""
    settings = {one["run"]: one["settings"] for one in records}
    names = dict.fromkeys(name for own in settings.values() for name in own)
    columns = {name: [own.get(name) for own in settings.values()] for name in names}
    # As shown: a setting that reads alike in all runs does not differ.
    differing = [n for n, own in columns.items() if len(set(map(plain, own))) > 1]
    cells = {run: [own.get(n) for n in differing] for run, own in settings.items()}
    cells = {run: own if own[1:] else plain(*own) for run, own in cells.items() if own}
    refused = {one["run"]: one["refused"] for one in records if one["refused"]}
    parts: list[Part] = [record_table("Run", cells, *differing)]
    if refused:
        parts.append(record_table("Without a certificate", refused, "reason"))
    # A figure needs an axis of numbers; the first such setting is the swept one.
    numeric = [name for name in differing if all(map(is_number, columns[name]))]
    for name in numeric[:1]:
        rows = [(one["settings"][name], one["rows"][-1]) for one in records]
        path = style.save(images / "rmse.png", figures.against_setting, name, rows)
        parts.append(Picture(path, f"RMSE by {name}"))
    sections = [Section("Settings that differ", parts)]
    places: dict[str, list[tuple[str, Row]]] = {}
    for one in records:
        for row in one["rows"]:
            places.setdefault(title_of([row], SHARED), []).append((one["run"], row))
    for title, group in places.items():
        sections.append(Section(title, [*tables.metric_tables(group, "Run")]))
    return sections
