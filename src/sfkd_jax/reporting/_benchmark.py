"""The comparison of all rows of the paper's table: page, Markdown, LaTeX, figures and film."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from matplotlib.figure import Figure

from sfkd_jax.artefacts import read_json
from sfkd_jax.reporting import _benchmark_notes as notes
from sfkd_jax.reporting import _benchmark_tables as tables
from sfkd_jax.reporting._animation import film
from sfkd_jax.reporting._benchmark_figures import FIGURED, overview, through_switches
from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Row,
    contests,
    drawn_for,
    paper_of,
    stem,
    title,
    together,
    vehicle_title,
)
from sfkd_jax.reporting._benchmark_words import beaten, words
from sfkd_jax.reporting._blocks import Block, Heading, Picture, Text, to_html, to_markdown
from sfkd_jax.reporting._latex import latex
from sfkd_jax.reporting._robustness import caption, robustness, robustness_table, studies
from sfkd_jax.reporting._style import save
from sfkd_jax.reporting._violations import disturbed, violations

_Ink: TypeAlias = Callable[..., Picture]
"""(name of the file, caption, how to draw it, from what) -> the picture."""

TITLE = "The paper's table, row by row"
FILES = "results_files"
MOST_BYTES = 5_000_000
"""Of the page."""


def benchmark_report(directory: Path) -> dict[str, Any]:
    """Write `directory/report/`: index.html (one self-contained page), results.md, table1.tex and results_files/.

    Reads results.json and the arrays of the rows' cells. The only arithmetic is on printed means: RMSE relative to
    another row's in percent, and over the same row's without a variation.

    Args:
        directory: of a comparison. Of its files only results.json must be there.

    Returns:
        `report`: path of the page. `figures`: paths of the figures and films, in the order of the page.

    Raises:
        ArtefactError: results.json is missing or not JSON, or a cell's arrays are damaged.
    """
    results = read_json(directory / "results.json", keys=("rows",))
    place = directory / "report" / FILES
    place.mkdir(parents=True, exist_ok=True)
    for stale in (*place.glob("*.png"), *place.glob("*.gif")):
        stale.unlink()

    def drawn(name: str, says: str, draw: Callable[..., Figure], *inputs: Any) -> Picture:
        return Picture(save(place / f"{name}.png", draw, *inputs), says)

    page = _page(results, drawn, directory)
    report = place.with_name("index.html")
    report.write_text(_html(page), encoding="utf-8")
    report.with_name("results.md").write_text(benchmark_markdown(results), encoding="utf-8")
    table = latex(contests(results["rows"]), paper_of(results))
    report.with_name("table1.tex").write_text(table, encoding="utf-8")
    return {"report": str(report), "figures": [str(block.path) for block in page if isinstance(block, Picture)]}


def benchmark_markdown(results: dict[str, Any]) -> str:
    """The page as Markdown, from the content of results.json alone; figures are linked from `results_files/`."""

    def named(name: str, says: str, *_: Any) -> Picture:
        return Picture(Path(f"{name}.png"), says)

    return to_markdown(_page(results, named, None)).replace("](figures/", f"]({FILES}/")


def _html(page: list[Block]) -> str:
    """The page; its films, from the last one on, as names where it would become too heavy."""
    text, films = to_html(TITLE, page), [block for block in page if isinstance(block, Picture) and _moves(block)]
    while len(text.encode()) > MOST_BYTES and films:
        heavy = films.pop()
        page = [_named(heavy) if block is heavy else block for block in page]
        text = to_html(TITLE, page)
    return text


def _moves(picture: Picture) -> bool:
    return picture.path.suffix == ".gif"


def _named(picture: Picture) -> Text:
    return Text(f"{picture.caption} It lies in {FILES}/{picture.path.name}.", kind="note")


def _page(results: dict[str, Any], ink: _Ink, directory: Path | None) -> list[Block]:
    rows: list[Row] = results["rows"]
    found, paper = contests(rows), paper_of(results)
    page: list[Block] = [Heading(1, TITLE), Text(notes.lead(results, found), kind="lead"), *notes.failures(results)]
    page += words(found, paper)
    groups: dict[str, list[Contest]] = {vehicle_title(contest): [] for contest in found}
    for contest in found:
        groups[vehicle_title(contest)].append(contest)
    for name, group in groups.items():
        page += [Heading(2, name), ink(f"rmse_{stem(group[0])}", notes.OVERVIEW, overview, group, paper)]
        page += _driven(group[0], ink, directory)
        for contest in group:
            page += _contest(contest, paper, ink)
        page += [Heading(3, "Prediction without feedback, position error"), tables.prediction(together(group))]
        page += [Heading(3, "Cost and certificate"), tables.cost(group), Text(notes.COST, kind="note")]
        for contest in group:
            page += _robust(rows, contest, ink)
    return [*page, *notes.provenance(results)]


def _driven(contest: Contest, ink: _Ink, directory: Path | None) -> list[Block]:
    """Figure 1 and the film."""
    if not any(FIGURED in line.rows for line in contest.lines):
        return []
    name = f"{FIGURED}_{stem(contest)}"
    said = f"{title(contest)}: {notes.FIGURE_1}"
    blocks: list[Block] = [ink(f"figure1_{stem(contest)}", said, through_switches, directory, contest)]
    made = film(directory, contest, directory / "report" / FILES / f"{name}.gif") if directory else None
    if made:
        blocks.append(Picture(made[0], f"{FIGURED.upper()} in real time: {', '.join(made[1])}."))
    return blocks


def _contest(contest: Contest, paper: tables.Paper, ink: _Ink) -> list[Block]:
    """The tables of a contest, each with what its marks mean, and Figure 2."""
    blocks: list[Block] = [
        Heading(3, f"Tracking: {title(contest)}"),
        tables.tracking(contest, paper),
        Text(notes.TRACKING, kind="note"),
        Heading(3, f"Against SFKD and the oracle: {title(contest)}"),
        tables.against(contest),
        Text(notes.AGAINST, kind="note"),
        Heading(3, f"Extremes and smoothness: {title(contest)}"),
        tables.extremes(contest, paper),
        Heading(3, f"Claims: {title(contest)}"),
        tables.claims(contest),
        Text(notes.CLAIMS, kind="note"),
        Heading(3, f"Threshold and planner: {title(contest)}"),
        tables.limits(contest, paper),
        Text(notes.LIMITS, kind="note"),
        Heading(3, f"Rows that beat SFKD: {title(contest)}"),
        *beaten(contest),
    ]
    for env, told in (("measured", "told friction and wind"), ("none", "told neither")):
        pushed = [row for row in _under_forces(contest) if row.get("env") == env]
        if pushed:
            name = f"figure2_{stem(contest)}_{contest.sampling or 'qp'}_{env}"
            said = f"{title(contest)}, rows that are {told}: {notes.FIGURE_2}"
            blocks.append(ink(name, said, violations, pushed))
    return blocks


def _under_forces(contest: Contest) -> list[Row]:
    """The rows that were pushed, on the hardest scenario on which any was, one access to the environment at a time."""
    found = [(name, line, row) for line in contest.lines for name, row in line.rows.items() if disturbed([row])]
    hardest = max((name for name, *_ in found), default=None)
    pushed = [(line, row) for name, line, row in found if name == hardest]
    return drawn_for(contest, [row for _, row in pushed])


def _robust(rows: list[Row], contest: Contest, ink: _Ink) -> list[Block]:
    blocks: list[Block] = []
    for study in studies(rows, contest):
        name = f"{study.name.replace(' ', '_')}_{stem(contest)}_{contest.sampling or 'qp'}"
        blocks += [
            Heading(3, f"{study.name.capitalize()}: {title(contest)}"),
            ink(name, caption(study), robustness, study),
            robustness_table(study),
        ]
    return blocks
