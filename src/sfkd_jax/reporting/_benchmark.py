"""The comparison of all rows of the paper's table: page, Markdown, LaTeX, figures and film."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from matplotlib.figure import Figure

from sfkd_jax.artefacts import read_json, understood, write_bytes, writing
from sfkd_jax.reporting import _benchmark_notes as notes
from sfkd_jax.reporting import _benchmark_tables as tables
from sfkd_jax.reporting._animation import film
from sfkd_jax.reporting._benchmark_figures import FIGURED, overview, through_switches
from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Row,
    contests,
    is_quoted,
    paper_of,
    stem,
    title,
    together,
    vehicle_title,
)
from sfkd_jax.reporting._benchmark_seeds import apart
from sfkd_jax.reporting._benchmark_tables import slashed
from sfkd_jax.reporting._benchmark_words import beaten, words
from sfkd_jax.reporting._blocks import (
    Block,
    Heading,
    Picture,
    Text,
    to_html,
    to_markdown,
)
from sfkd_jax.reporting._forces import forces_figure, forces_of, forces_tables, pushed
from sfkd_jax.reporting._latex import latex
from sfkd_jax.reporting._numbers import plain
from sfkd_jax.reporting._robustness import (
    caption,
    heading,
    note,
    robustness,
    robustness_table,
    studies,
)
from sfkd_jax.reporting._style import save, scenario_label

_Ink: TypeAlias = Callable[..., Picture]
"""(name of the file, caption, how to draw it, from what) -> the picture."""

FILES = "results_files"
MOST_BYTES = 5_000_000
"""Of the page."""


def benchmark_report(directory: Path) -> dict[str, Any]:
    """Write `directory/report/`: index.html (one self-contained page), results.md, table1.tex and results_files/.

    Reads results.json and the arrays of the rows' cells. The only arithmetic is on
    printed means: RMSE relative to another row's in percent, over the same row's
    without a variation, and the spread of trainings.

    Args:
        directory: of a comparison. Of its files only results.json must be there.

    Returns:
        `report`: path of the page. `figures`: paths of the figures and films, in the
        order of the page.

    Raises:
        ArtefactError: results.json is missing, not JSON or without rows that a page can
            be made of; a cell's arrays are damaged; or the disk refuses the page.
    """
    with (
        writing(directory / "report"),
        understood(directory / "results.json", ValueError),
    ):
        return _write(directory)


def _write(directory: Path) -> dict[str, Any]:
    """`benchmark_report`, errors as they come."""
    results = read_json(directory / "results.json", keys=("rows",))
    place = directory / "report" / FILES
    place.mkdir(parents=True, exist_ok=True)
    for stale in (*place.glob("*.png"), *place.glob("*.gif")):
        stale.unlink()

    def drawn(
        name: str, says: str, draw: Callable[..., Figure], *inputs: Any
    ) -> Picture:
        return Picture(save(place / f"{name}.png", draw, *inputs), says)

    page = _page(results, drawn, directory)
    report = place.with_name("index.html")
    write_bytes(report, _html(page).encode())
    write_bytes(report.with_name("results.md"), benchmark_markdown(results).encode())
    table = latex(contests(results["rows"]), paper_of(results))
    write_bytes(report.with_name("table1.tex"), table.encode())
    return {
        "report": str(report),
        "figures": [str(block.path) for block in page if isinstance(block, Picture)],
    }


def benchmark_markdown(results: dict[str, Any]) -> str:
    """The page as Markdown, from the content of results.json alone; figures are linked from `results_files/`."""

    def named(name: str, says: str, *_: Any) -> Picture:
        return Picture(Path(f"{name}.png"), says)

    return to_markdown(_page(results, named, None)).replace("](figures/", f"]({FILES}/")


def _html(page: list[Block]) -> str:
    """The page; its films, from the last one on, as names where it would become too heavy."""
    name = next((block.text for block in page if isinstance(block, Heading)), "")
    text, films = (
        to_html(name, page),
        [block for block in page if isinstance(block, Picture) and _moves(block)],
    )
    while len(text.encode()) > MOST_BYTES and films:
        heavy = films.pop()
        page = [_named(heavy) if block is heavy else block for block in page]
        text = to_html(name, page)
    return text


def _moves(picture: Picture) -> bool:
    return picture.path.suffix == ".gif"


def _named(picture: Picture) -> Text:
    return Text(
        f"{picture.caption} It lies in {FILES}/{picture.path.name}.", kind="note"
    )


def _page(results: dict[str, Any], ink: _Ink, directory: Path | None) -> list[Block]:
    rows: list[Row] = results["rows"]
    found, paper = contests(rows), paper_of(results)
    page: list[Block] = [
        Heading(1, notes.heading(results)),
        Text(notes.lead(results, found), kind="lead"),
    ]
    page += notes.failures(results)
    claims = words(found, paper)
    varied = any(pushed(contest) or studies(rows, contest) for contest in found)
    studied = varied or not is_quoted(found, paper)
    page += [] if studied else claims
    groups: dict[str, list[Contest]] = {vehicle_title(contest): [] for contest in found}
    for contest in found:
        groups[vehicle_title(contest)].append(contest)
    for name, group in groups.items():
        page.append(Heading(2, name))
        for contest in group:
            page += [*_robust(rows, contest, ink), *_forces(contest, ink)]
        page += [Heading(3, "Every row")] if studied else []
        page.append(
            ink(
                f"rmse_{stem(group[0])}",
                notes.overview(group, paper),
                overview,
                group,
                paper,
            )
        )
        page += (
            [] if varied else _driven(group[0], ink, directory)
        )  # the rows as they are have theirs in the table
        for contest in group:
            page += _contest(contest, paper, ink)
        page += [
            Heading(3, "Prediction without feedback, position error"),
            tables.prediction(together(group)),
        ]
        page += [
            Heading(3, "Cost and certificate"),
            tables.cost(group),
            Text(notes.COST, kind="note"),
        ]
    return [*page, *(claims if studied else []), *notes.provenance(results)]


def _driven(contest: Contest, ink: _Ink, directory: Path | None) -> list[Block]:
    """Figure 1 and the film."""
    if not any(FIGURED in line.rows for line in contest.lines):
        return []
    name = f"{FIGURED}_{stem(contest)}"
    said = f"{title(contest)}: {notes.FIGURE_1}"
    blocks: list[Block] = [
        ink(f"figure1_{stem(contest)}", said, through_switches, directory, contest)
    ]
    made = (
        film(directory, contest, directory / "report" / FILES / f"{name}.gif")
        if directory
        else None
    )
    if made:
        blocks.append(
            Picture(
                made[0],
                f"{scenario_label(FIGURED)} in real time: {', '.join(made[1])}.",
            )
        )
    return blocks


def _contest(contest: Contest, paper: tables.Paper, ink: _Ink) -> list[Block]:
    """The tables of a contest, each with what its marks mean, and Figure 2."""
    return [
        Heading(3, f"Tracking: {title(contest)}"),
        tables.tracking(contest, paper),
        Text(notes.tracking(contest, paper), kind="note"),
        *apart(contest),
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


def _forces(contest: Contest, ink: _Ink) -> list[Block]:
    """Figure 2 and its table, where rows were pushed."""
    found = pushed(contest)
    if found is None:
        return []
    tracked, claimed = forces_tables(*found)
    name = f"figure2_{stem(contest)}_{contest.sampling or 'qp'}"
    said = f"{title(contest)}, {scenario_label(found[0])}: {notes.FIGURE_2}"
    return [
        Heading(3, f"Side forces: {title(contest)}"),
        ink(name, said, forces_figure, *found),
        tracked,
        Heading(3, f"Claims under side forces: {title(contest)}"),
        claimed,
        Text(
            f"{notes.FORCES}: {slashed([plain(force) for force in forces_of(*found)])} N.",
            kind="note",
        ),
    ]


def _robust(rows: list[Row], contest: Contest, ink: _Ink) -> list[Block]:
    blocks: list[Block] = []
    for study in studies(rows, contest):
        name = f"variations_{stem(contest)}_{contest.sampling or 'qp'}_{study.scenario}"
        blocks += [
            Heading(3, heading(study)),
            ink(name, caption(study), robustness, study),
            robustness_table(study),
            Text(note(study), kind="note"),
        ]
    return blocks
