"""The results page of a comparison: HTML, Markdown, LaTeX, figures and a film."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from matplotlib.figure import Figure

from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper import _figures as figures
from sfkd_jax.paper import _tables as tables
from sfkd_jax.paper._animation import film
from sfkd_jax.paper._claims import better_rows, claims
from sfkd_jax.paper._forces import Forces, forces_figure, forces_of, forces_tables
from sfkd_jax.paper._latex import latex
from sfkd_jax.paper._provenance import failures, lead, provenance
from sfkd_jax.paper._setups import Setup, merged, setups
from sfkd_jax.paper._study import Study, study_of
from sfkd_jax.paper._texts import text
from sfkd_jax.paper._variations import (
    Variations,
    variations,
    variations_figure,
    variations_table,
)
from sfkd_jax.reporting.blocks import (
    Block,
    Heading,
    Picture,
    Table,
    Text,
    to_html,
    to_markdown,
)
from sfkd_jax.reporting.style import save, scenario_label
from sfkd_jax.store import as_artefact_error, read_json, write_bytes, writing

FILES = "results_files"
MOST_BYTES = 5_000_000
"""Of the page."""


class _Plot(NamedTuple):
    """A figure to draw: `draw(*inputs)`, or `draw(directory, *inputs)` from arrays."""

    name: str
    caption: str
    draw: Callable[..., Figure]
    inputs: tuple[Any, ...]
    from_arrays: bool = False


class _Film(NamedTuple):
    """A film of a setup on a scenario."""

    setup: Setup
    scenario: str


_Part: TypeAlias = Block | _Plot | _Film


def write_results_page(
    directory: Path, page: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Write the page, as HTML and Markdown, and its LaTeX table to `directory/report`.

    Reads results.json and the arrays of the rows. The only arithmetic is on printed
    means: RMSE relative to another row's in percent, over the same row's without a
    variation, and the spread of trainings.

    Args:
        directory: of a comparison. Of its files only results.json must exist.
        page: `comparison.page` for results whose settings do not record it.

    Returns:
        `report`: path of the page. `figures`: paths of the figures and films, in the
        order of the page.

    Raises:
        ArtefactError: results.json is missing, not JSON or without usable rows; the
            arrays of a row are damaged; or the page cannot be written.
    """
    source = directory / "results.json"
    with writing(directory / "report"), as_artefact_error(source, ValueError):
        results = read_json(source, keys=("rows",))
        files = directory / "report" / FILES
        files.mkdir(parents=True, exist_ok=True)
        for stale in (*files.glob("*.png"), *files.glob("*.gif")):
            stale.unlink()
        study = study_of(results, page)
        blocks = _drawn(_page(results, study), directory)
        report = files.with_name("index.html")
        write_bytes(report, _html(blocks).encode())
        markdown = results_markdown(results, page)
        write_bytes(report.with_name("results.md"), markdown.encode())
        table = latex(setups(results["rows"]), study)
        write_bytes(report.with_name("table1.tex"), table.encode())
    pictures = [block for block in blocks if isinstance(block, Picture)]
    return {"report": str(report), "figures": [str(one.path) for one in pictures]}


def results_markdown(
    results: dict[str, Any], page: dict[str, Any] | None = None
) -> str:
    """The page as Markdown; its figures are links to `results_files/`.

    Args:
        results: content of results.json.
        page: `comparison.page` for results whose settings do not record it.
    """
    blocks: list[Block] = []
    for part in _page(results, study_of(results, page)):
        if isinstance(part, _Plot):
            blocks.append(Picture(Path(f"{part.name}.png"), part.caption))
        elif not isinstance(part, _Film):
            blocks.append(part)
    return to_markdown(blocks).replace("](figures/", f"]({FILES}/")


def _drawn(parts: list[_Part], directory: Path) -> list[Block]:
    """Draw all figures and films; a film without arrays is left out."""
    files, blocks = directory / "report" / FILES, []
    for part in parts:
        if isinstance(part, _Plot):
            inputs = (directory, *part.inputs) if part.from_arrays else part.inputs
            path = save(files / f"{part.name}.png", part.draw, *inputs)
            blocks.append(Picture(path, part.caption))
        elif isinstance(part, _Film):
            path = files / f"{part.scenario}_{part.setup.stem}.gif"
            made = film(directory, part.setup.rows_on(part.scenario), path)
            if made:
                where, cars = scenario_label(part.scenario), ", ".join(made[1])
                caption = text("figures.film", scenario=where, cars=cars)
                blocks.append(Picture(made[0], caption))
        else:
            blocks.append(part)
    return blocks


def _html(blocks: list[Block]) -> str:
    """The page; if it is too large, films become links, the last one first."""
    title = next((block.text for block in blocks if isinstance(block, Heading)), "")
    html = to_html(title, blocks)
    films = [
        i
        for i, block in enumerate(blocks)
        if isinstance(block, Picture) and block.path.suffix == ".gif"
    ]
    while len(html.encode()) > MOST_BYTES and films:
        i = films.pop()
        heavy = blocks[i]
        assert isinstance(heavy, Picture)
        path = f"{FILES}/{heavy.path.name}"
        link = text("figures.film_file", caption=heavy.caption, path=path)
        blocks = [*blocks[:i], Text(link, kind="note"), *blocks[i + 1 :]]
        html = to_html(title, blocks)
    return html


def _page(results: dict[str, Any], study: Study) -> list[_Part]:
    rows: list[Row] = results["rows"]
    groups: dict[str, list[Setup]] = {}
    everything = setups(rows)
    for setup in everything:
        groups.setdefault(setup.vehicle_title, []).append(setup)
    varied = any(forces_of(one) or variations(rows, one, study) for one in everything)
    first = study.is_printed(everything) and not varied
    sentences = claims(everything, study)
    return [
        Heading(1, study.title),
        Text(lead(results, everything, study), kind="lead"),
        *failures(results),
        *(sentences if first else []),
        *(
            part
            for title, group in groups.items()
            for part in (
                Heading(2, title),
                *_vehicle(rows, group, study, first, varied),
            )
        ),
        *([] if first else sentences),
        *provenance(results, everything),
    ]


def _vehicle(
    rows: list[Row], group: list[Setup], study: Study, first: bool, varied: bool
) -> list[_Part]:
    """The studies of a vehicle, then all rows of its setups."""
    parts: list[_Part] = []
    for setup in group:
        for one in variations(rows, setup, study):
            parts += _variations(one)
        forces = forces_of(setup)
        parts += _forces(forces) if forces else []
    parts += [] if first else [Heading(3, "Every row")]
    caption = figures.overview_caption(group, study)
    name = f"rmse_{group[0].stem}"
    parts.append(_Plot(name, caption, figures.overview, (group, study)))
    if not varied and group[0].rows_on(study.scenario):
        parts += _driven(group[0], study.scenario)
    for setup in group:
        parts += _setup(setup, study)
    return [
        *parts,
        Heading(3, "Prediction without feedback, position error"),
        tables.prediction(merged(group)),
        Heading(3, "Cost and certificate"),
        tables.cost(group),
        Text(text("tables.cost"), kind="note"),
    ]


def _driven(setup: Setup, scenario: str) -> list[_Part]:
    """Figure 1 and the film."""
    caption, inputs = text("figures.deviations", setup=setup.title), (setup, scenario)
    name = f"figure1_{setup.stem}"
    plot = _Plot(name, caption, figures.deviations, inputs, from_arrays=True)
    return [plot, _Film(setup, scenario)]


def _setup(setup: Setup, study: Study) -> list[_Part]:
    """The tables of a setup, each with its note."""
    printed = text("tables.printed") if study.is_printed([setup]) else ""
    several = tables.has_trainings([setup])
    sections: dict[str, tuple[Table | None, str]] = {
        "Tracking": (
            tables.tracking(setup, study),
            text("tables.tracking", printed=printed),
        ),
        "Single trainings": (
            tables.trainings_table(setup) if several else None,
            text("tables.trainings"),
        ),
        "Against SFKD and the oracle": (
            tables.relative(setup),
            text("tables.relative", undecided=text(f"tables.{tables.decided(setup)}")),
        ),
        "Extremes and smoothness": (
            tables.extremes(setup, study),
            text("tables.extremes") if several else "",
        ),
        "Claims": (tables.claims(setup), text("tables.claims")),
        "Threshold and planner": (tables.limits(setup, study), text("tables.limits")),
    }
    parts: list[_Part] = []
    for title, (table, note) in sections.items():
        if table:
            parts += [Heading(3, f"{title}: {setup.title}"), table]
            parts += [Text(note, kind="note")] if note else []
    title = f"Rows that beat SFKD: {setup.title}"
    return [*parts, Heading(3, title), *better_rows(setup)]


def _forces(forces: Forces) -> list[_Part]:
    """Figure 2 and its tables."""
    tracked, claimed = forces_tables(forces)
    setup = forces.setup
    name = f"figure2_{setup.stem}_{setup.sampling or 'qp'}"
    return [
        Heading(3, f"Side forces: {setup.title}"),
        _Plot(name, forces.caption, forces_figure, (forces,)),
        tracked,
        Heading(3, f"Claims under side forces: {setup.title}"),
        claimed,
        Text(forces.note, kind="note"),
    ]


def _variations(varied: Variations) -> list[_Part]:
    """The figure and the table of a study."""
    setup = varied.setup
    kind = setup.sampling or "qp"
    name = f"variations_{setup.stem}_{kind}_{varied.scenario}"
    return [
        Heading(3, varied.heading),
        _Plot(name, varied.caption, variations_figure, (varied,)),
        variations_table(varied),
        Text(varied.note, kind="note"),
    ]
