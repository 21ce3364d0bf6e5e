"""The pages of a run and of a comparison, from what their files say."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from sfkd_jax import store
from sfkd_jax.assembly import build_vehicle
from sfkd_jax.certificate import signature_of
from sfkd_jax.driving.plants import axes
from sfkd_jax.driving.simulation import SHARED
from sfkd_jax.driving.simulation.metrics import Row
from sfkd_jax.evaluation import formats
from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, plain, short
from sfkd_jax.report import figures, style, tables
from sfkd_jax.report.episodes import Episodes, by_road, of_rows
from sfkd_jax.report.film import film_of
from sfkd_jax.report.pages import Part, Picture, Section, to_latex, write_page
from sfkd_jax.report.sections import (
    PROOF,
    certificate_document,
    empty_folder,
    holds,
    learned,
    made_with,
    read_optional,
)
from sfkd_jax.report.tables import grouped, record_table, title_of

MADE_BY = {
    "results.json": "evaluate",
    "certificate.json": "certify",
    "open_loop.json": "train",
}
"""File of a run -> the command that makes it."""


def _range(ends: list[Any] | None) -> str:
    """Return the ends of a range as text, "3 to 6"."""
    return " to ".join(map(short, ends or [None]))


_WRITERS = {
    "interval": formats.interval,
    "plain": plain,
    "range": _range,
    "percent": formats.percent,
    "short": short,
    "upper": formats.upper,
}
"""How templates/certificate.csv says that a value is written."""


def write_report(run_dir: Path) -> dict[str, Any]:
    """Write `run_dir/report/`: index.html, figures and a film.

    No number of the run is computed again. All its files but the policy may be missing.
    The same inputs give the same bytes.

    Returns:
        The paths of the page and of its images.
    """
    home = run_dir / "report"
    weights = run_dir / f"policy{store.SUFFIX}"
    with store.as_artefact_error(home):
        if not weights.exists():
            makes = "python -m sfkd_jax.train makes a run"
            raise store.ArtefactError(f"{weights} is missing: {makes}")
        images = empty_folder(home / "figures")
        _, policy = store.read_arrays(weights, kind="policy")
        settings = policy.get("config") or {}
        model = settings.get("model")
        experiment = settings.get("experiment")
        system = str(dig(model, "system") or dig(model, "name") or "sfkd")
        title = f"{style.label(system)}, {plain(experiment or 'unnamed run')}"
        sections = _sections(run_dir, policy, images)
        return write_page(
            f"{title}, seed {plain(settings.get('seed'))}", sections, home
        )


def _sections(run_dir: Path, policy: dict[str, Any], images: Path) -> list[Section]:
    """Return all sections of the page; an error names the file that does not fit."""
    results = read_optional(run_dir / "results.json")
    certificate = certificate_document(run_dir, policy)
    # Numbers of a certificate that does not hold are nowhere drawn.
    proof = certificate if holds(certificate) else {}
    half_width = dig(proof, "corridor", "corridor_m")
    missing: list[Part] = [
        f"{name} is missing: python -m sfkd_jax.{command} makes it."
        for name, command in MADE_BY.items()
        if not (run_dir / name).exists()
    ]
    sections = [Section("", missing)]

    def add(
        title: str, file: str, make: Callable[..., list[Part]], *inputs: Any
    ) -> None:
        with store.as_artefact_error(run_dir / file, ValueError):
            sections.append(Section(title, make(*inputs)))

    rows = results.get("rows")
    add("Closed loop", "results.json", _scores, results)
    add("Episodes", "results.json", _driven, run_dir, half_width, images, rows)
    add("Certificate", "certificate.json", _certified, certificate, policy)
    add("Open loop", "open_loop.json", _predicted, run_dir, proof, images)
    add("Training", "metrics.jsonl", learned, run_dir, images)
    command = dig(results, "config", "command")
    config = {"command": command, **(policy.get("config") or {})}
    versions = policy.get("versions") or results.get("versions")
    return [*sections, made_with(config, versions)]


def _scores(results: dict[str, Any]) -> list[Part]:
    """Return the metrics of all systems: tables for each group of comparable rows."""
    parts: list[Part] = []
    for group in grouped(results.get("rows") or [], SHARED):
        parts.append(f"{title_of(group, SHARED)}: {tables.amount(group)}")
        parts += tables.metric_tables(group)
    return parts


def _driven(
    run_dir: Path, half_width: Any, images: Path, rows: list[Row] | None
) -> list[Part]:
    """Draw figures of every group of episodes, and a film of the first group."""
    parts: list[Part] = []
    corridor = float(half_width) if is_number(half_width) else None
    groups = by_road(of_rows(run_dir, rows or []))
    for number, group in enumerate(groups, 1):
        title = title_of([group[0].row], SHARED)
        is_first = number == 1
        parts += draw_episodes(group, images, title, number, corridor, film=is_first)
    return parts


def draw_episodes(
    group: list[Episodes],
    images: Path,
    title: str,
    number: int,
    corridor: float | None = None,
    *,
    film: bool = True,
) -> list[Part]:
    """Draw the first episode of every row of a group as a figure, and as a film.

    Args:
        group: of episodes on one road.
        images: folder of the images.
        title: what the rows have in common, in words.
        number: of the group, for the names of the files.
        corridor: half width of the certified corridor [m], or None.
        film: whether to make a film.
    """
    path = images / f"first_{number}.png"
    style.save(path, figures.first_episode, group, corridor)
    parts: list[Part] = [f"{title}.", Picture(path, f"First episode: {title}")]
    if not film:
        return parts
    film_path = film_of(images / f"film_{number}.gif", group, corridor)
    if film_path is not None:
        parts.append(Picture(film_path, f"Film: {title}"))
    return parts


def _certified(record: dict[str, Any], policy: dict[str, Any]) -> list[Part]:
    """Return what holds and on what it rests, then the boxes in which it holds."""
    if not record:
        return []
    if not holds(record):
        reason = plain(record.get("reason") or "the file gives no reason")
        return [f"No contraction is certified for these weights: {reason}."]
    quantities = _certified_quantities(record)
    parts: list[Part] = [
        PROOF,
        record_table("Quantity", quantities, "value", "rests on"),
    ]
    boxes = _certified_boxes(record, policy)
    if boxes:
        parts.append(record_table("Box", boxes, "from", "to"))
    return parts


def _certified_quantities(record: dict[str, Any]) -> dict[str, list[str]]:
    """Return name -> [value, what it rests on] of what a certificate holds."""
    file = resources.files("sfkd_jax.report") / "templates" / "certificate.csv"
    signature = signature_of(record)
    quantities = {}
    for line in file.read_text("utf-8").splitlines():
        name, place, writer, basis = line.split(";")
        shown = _WRITERS[writer](dig(record, *place.split(".")))
        if DASH not in shown:
            quantities[name] = [shown, basis.format(signature=signature)]
    return quantities


def _certified_boxes(
    record: dict[str, Any], policy: dict[str, Any]
) -> dict[str, list[Any]]:
    """Return name -> [lower, upper end] of the axes of the boxes of a certificate."""
    boxes = {}
    for box, known in _axes(record, policy).items():
        # Boxes of logged data name their own axes.
        names = dig(record, "measured", "boxes", "names", box) or known
        for axis, name in enumerate(names):
            place = ("measured", "boxes", box)
            ends = [dig(record, *place, end, str(axis)) for end in ("0", "1")]
            if is_pair(ends):
                boxes[f"{box}: {name}"] = ends
    return boxes


def _axes(record: dict[str, Any], policy: dict[str, Any]) -> dict[str, list[str]]:
    """Return the names of the axes of every box, those of the vehicle of the policy."""
    settings = policy.get("config") or {}
    vehicle = settings.get("vehicle")
    if not vehicle:
        return {}
    # No certificate of another frame has a corridor.
    names = axes(build_vehicle(vehicle), along_path=bool(record.get("corridor")))
    env_names = dig(settings, "environment", "names")
    if env_names:
        names["env"] = env_names
    return names


def _predicted(run_dir: Path, proof: dict[str, Any], images: Path) -> list[Part]:
    """Draw errors of predictions by time ahead, beside those of simple models."""
    errors = read_optional(run_dir / "open_loop.json")
    if not errors.get("steps"):
        return []
    radii = dig(proof, "measured", "tube", "physical", "position_m")
    path = style.save(images / "open_loop.png", figures.open_loop, errors, radii or [])
    number = plain(errors.get("trajectories"))
    return [
        Picture(path, "Prediction error by time ahead"),
        f"{number} trajectories that training never saw.",
    ]


_TABLE = ("inner_loop", "latency", "sampling")
"""Rows of one table share these; its columns are vehicles and scenarios."""
_FIGURE = ("vehicle", *_TABLE)
"""Rows of one figure share these."""


def write_results_page(directory: Path) -> dict[str, Any]:
    """Write `directory/report/`: index.html, table1.tex, figures, films.

    Args:
        directory: of a comparison, with results.json; the arrays of its rows may be
            missing.

    Returns:
        The paths of the page and of its images.
    """
    source = directory / "results.json"
    home = directory / "report"
    with store.as_artefact_error(home), store.as_artefact_error(source, ValueError):
        results = store.read_json(source, keys=("rows",))
        images = empty_folder(home / "figures")
        sections, captions = _results(results, directory, images)
        store.write_bytes(home / "table1.tex", to_latex(captions).encode())
        title = plain(dig(results, "config", "name") or "Comparison")
        return write_page(title, sections, home)


def _results(
    results: dict[str, Any], directory: Path, images: Path
) -> tuple[list[Section], list[tuple[str, pd.DataFrame]]]:
    """Return the sections of the page, and (caption, table) of the main tables.

    The sections are tables, figures, every metric, and what made them.
    """
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
    sections = [Section("", first)]
    metrics = []
    captions = []
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
    config = results.get("config") or {}
    sections = [*sections, *metrics, made_with(config, results.get("versions"))]
    return sections, captions


def _drawn(group: list[Row], directory: Path, images: Path, number: int) -> list[Part]:
    """Draw the paper's figures 1 and 2 and a film.

    Figure 1 and the film are of the last scenario of which episodes are stored, figure
    2 is of the last scenario.
    """
    scenarios = grouped(group, ("scenario",))
    episodes: list[Episodes] = []
    for rows in reversed(scenarios):
        episodes = of_rows(directory, rows)
        if episodes:
            break
    parts: list[Part] = []
    if episodes:
        title = title_of([episodes[0].row], ("scenario", *_FIGURE))
        parts += draw_episodes(episodes, images, title, number)
    forced = [row for row in scenarios[-1] if dig(row, "disturbed", "0")]
    if forced:
        path = style.save(images / f"forces_{number}.png", figures.side_forces, forced)
        parts.append(Picture(path, "RMSE by unmeasured side force"))
    return parts
