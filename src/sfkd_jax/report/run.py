"""The pages of a run and of a comparison, from what their files say."""

from __future__ import annotations

from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from sfkd_jax import store
from sfkd_jax.build import build_vehicle
from sfkd_jax.evaluation import SHARED, formats
from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, plain, short
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.plants import axes
from sfkd_jax.report import figures, style, tables
from sfkd_jax.report.episodes import Episodes, by_road, of_rows
from sfkd_jax.report.film import film_of
from sfkd_jax.report.pages import Part, Picture, Section, to_latex, write_page
from sfkd_jax.report.tables import grouped, record_table, title_of

MADE_BY = {
    "results.json": "evaluate",
    "certificate.json": "certify",
    "open_loop.json": "train",
}
"""File of a run -> the command that makes it."""
PROOF = (
    "Proved: recomputed from the stored weights, for every state, command and "
    "environment in the boxes. Measured: a quantile over runs that training never saw, "
    "promised for further runs under the same conditions. Unsigned: whoever can write "
    "the file can change such a number within its range. Outside the boxes nothing is "
    "claimed."
)
_WRITERS = {
    "interval": formats.interval,
    "plain": plain,
    "range": lambda ends: " to ".join(map(short, ends or [None])),
    "percent": formats.percent,
    "short": short,
    "upper": formats.upper,
}
"""How templates/certificate.csv says that a value is written."""


def write_report(run_dir: Path) -> dict[str, Any]:
    """Write `run_dir/report/`: index.html, figures and a film.

    Recomputes no number of the run, whose files may be missing but for the policy; the
    same inputs give the same bytes. Returns the paths of the page and of its images.
    """
    home, weights = run_dir / "report", run_dir / f"policy{store.SUFFIX}"
    with store.as_artefact_error(home):
        if not weights.exists():
            makes = "python -m sfkd_jax.train makes a run"
            raise store.ArtefactError(f"{weights} is missing: {makes}")
        images = empty_folder(home / "figures")
        _, policy = store.read_arrays(weights, kind="policy")
        settings = policy.get("config") or {}
        model, experiment = settings.get("model"), settings.get("experiment")
        system = str(dig(model, "system") or dig(model, "name") or "sfkd")
        title = f"{style.label(system)}, {plain(experiment or 'unnamed run')}"
        sections = _sections(run_dir, policy, images)
        return write_page(
            f"{title}, seed {plain(settings.get('seed'))}", sections, home
        )


def read_optional(path: Path) -> dict[str, Any]:
    """The JSON object in a file, empty without a file."""
    return store.read_json(path) if path.exists() else {}


def certificate_document(run: Path, policy: dict[str, Any]) -> dict[str, Any]:
    """The certificate of a run; one about other weights is not valid."""
    certificate = read_optional(run / "certificate.json")
    own, named = policy.get("sha256"), certificate.get("weights_sha256")
    # Valid for other weights is not valid here: the page must not show it.
    if own and named and own != named:
        reason = "the certificate in this run is about other weights"
        return {"valid": False, "reason": reason}
    return certificate


def holds(certificate: dict[str, Any]) -> bool:
    """Whether a certificate is valid, with a contraction factor below one."""
    alpha: Any = certificate.get("alpha")
    return certificate.get("valid") is True and is_number(alpha) and alpha < 1


def empty_folder(folder: Path) -> Path:
    """Make a folder for images, without those of an earlier page."""
    folder.mkdir(parents=True, exist_ok=True)
    # An earlier page may have had more figures, which would stay among the new ones.
    for stale in (*folder.glob("*.png"), *folder.glob("*.gif")):
        stale.unlink()
    return folder


def made_with(config: dict[str, Any], versions: Any) -> Section:
    """The command, the settings and the versions that made something, folded."""
    parts: list[Part] = [record_table("Setting", config, "value")]
    parts.append(record_table("Package", versions or {}, "version"))
    return Section("Command, settings and versions", parts, folded=True)


def _sections(run_dir: Path, policy: dict[str, Any], images: Path) -> list[Section]:
    """All sections of the page; a file whose content does not fit is named."""
    results = read_optional(run_dir / "results.json")
    certificate = certificate_document(run_dir, policy)
    # Numbers of a certificate that does not hold are nowhere drawn.
    proof = certificate if holds(certificate) else {}
    half = dig(proof, "corridor", "corridor_m")
    missing: list[Part] = [
        f"{name} is missing: python -m sfkd_jax.{command} makes it."
        for name, command in MADE_BY.items()
        if not (run_dir / name).exists()
    ]
    drawn = partial(_driven, run_dir, half, images)
    sections = [Section("", missing)]
    for title, file, make in (
        ("Closed loop", "results.json", lambda: _scores(results)),
        ("Episodes", "results.json", lambda: drawn(results.get("rows"))),
        ("Certificate", "certificate.json", lambda: _certified(certificate, policy)),
        ("Open loop", "open_loop.json", lambda: _predicted(run_dir, proof, images)),
        ("Training", "metrics.jsonl", lambda: _learned(run_dir, images)),
    ):
        with store.as_artefact_error(run_dir / file, ValueError):
            sections.append(Section(title, make()))
    command = {"command": dig(results, "config", "command")}
    versions = policy.get("versions") or results.get("versions")
    return [*sections, made_with(command | (policy.get("config") or {}), versions)]


def _scores(results: dict[str, Any]) -> list[Part]:
    """The metrics of all systems: tables for each group that may be compared."""
    parts: list[Part] = []
    for group in grouped(results.get("rows") or [], SHARED):
        parts.append(f"{title_of(group, SHARED)}: {tables.amount(group)}")
        parts += tables.metric_tables(group)
    return parts


def _driven(
    run_dir: Path, half: Any, images: Path, rows: list[Row] | None
) -> list[Part]:
    """Figures of every group of episodes, and a film of the first one."""
    parts: list[Part] = []
    corridor = float(half) if is_number(half) else None
    for number, group in enumerate(by_road(of_rows(run_dir, rows or [])), 1):
        title = title_of([group[0].row], SHARED)
        film = number == 1
        parts += draw_episodes(group, images, title, number, corridor, film=film)
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
    """The first episode of every row of a group as a figure, and as a film."""
    path = images / f"first_{number}.png"
    style.save(path, figures.first_episode, group, corridor)
    parts: list[Part] = [f"{title}.", Picture(path, f"First episode: {title}")]
    made = film_of(images / f"film_{number}.gif", group, corridor) if film else None
    return [*parts, Picture(made, f"Film: {title}")] if made else parts


def _certified(record: dict[str, Any], policy: dict[str, Any]) -> list[Part]:
    """What holds and on what it rests, then the boxes outside of which it does not."""
    if not record:
        return []
    if not holds(record):
        reason = plain(record.get("reason") or "the file gives no reason")
        return [f"No contraction is certified for these weights: {reason}."]
    file = resources.files("sfkd_jax.report") / "templates" / "certificate.csv"
    quantities, boxes = {}, {}
    for line in file.read_text("utf-8").splitlines():
        name, place, write, basis = line.split(";")
        shown = _WRITERS[write](dig(record, *place.split(".")))
        quantities |= {name: [shown, basis]} if DASH not in shown else {}
    for box, known in _axes(record, policy).items():
        # Boxes of logged data name their own axes.
        for axis, name in enumerate(dig(record, "boxes", "names", box) or known):
            side = [dig(record, "boxes", box, end, str(axis)) for end in "01"]
            boxes |= {f"{box}: {name}": side} if is_pair(side) else {}
    parts: list[Part] = [PROOF]
    parts.append(record_table("Quantity", quantities, "value", "rests on"))
    return [*parts, record_table("Box", boxes, "from", "to")] if boxes else parts


def _axes(record: dict[str, Any], policy: dict[str, Any]) -> dict[str, list[str]]:
    """Names of the axes of every box of a certificate, from the vehicle of a policy."""
    settings = policy.get("config") or {}
    vehicle = settings.get("vehicle")
    if not vehicle:
        return {}
    named = axes(
        build_vehicle(vehicle),
        # No other certificate has a corridor.
        along_path=bool(record.get("corridor")),
    )
    environment = dig(settings, "environment", "names")
    return named | ({"env": environment} if environment else {})


def _predicted(run_dir: Path, proof: dict[str, Any], images: Path) -> list[Part]:
    """Errors of predictions by time ahead, beside bicycles."""
    errors = read_optional(run_dir / "open_loop.json")
    if not errors.get("steps"):
        return []
    radii = dig(proof, "tube", "physical", "position_m")
    path = style.save(images / "open_loop.png", figures.open_loop, errors, radii or [])
    words = f"{plain(errors.get('trajectories'))} trajectories that training never saw."
    return [Picture(path, "Prediction error by time ahead"), words]


def _learned(run_dir: Path, images: Path) -> list[Part]:
    """The loss by optimisation step."""
    log = run_dir / "metrics.jsonl"
    if not (log.exists() and (lines := store.read_jsonl(log))):
        return []
    path = style.save(images / "learning.png", figures.learning, lines)
    return [Picture(path, "Loss by optimisation step")]


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
        images = empty_folder(home / "figures")
        sections, captions = _results(results, directory, images)
        store.write_bytes(home / "table1.tex", to_latex(captions).encode())
        title = plain(dig(results, "config", "name") or "Comparison")
        return write_page(title, sections, home)


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
        if (table := tables.cross_table(group, tables.rmse_cell)) is not None:
            sections.append(Section(title, [table]))
            captions.append((f"{title}. {tables.MARKS}", table))
        for metric in tables.shown_metrics():
            if (table := tables.cross_table(group, metric.text)) is not None:
                head = f"{metric.head()}: {title}"
                metrics.append(Section(head, [table], folded=True))
    for number, group in enumerate(grouped(rows, _FIGURE), 1):
        drawn = _drawn(group, directory, images, number)
        sections.append(Section(title_of(group, _FIGURE), drawn))
    made = made_with(results.get("config") or {}, results.get("versions"))
    return [*sections, *metrics, made], captions


def _drawn(group: list[Row], directory: Path, images: Path, number: int) -> list[Part]:
    """The paper's figures 1 and 2 and a film, of the last scenario that has them."""
    scenarios = grouped(group, ("scenario",))
    found = (of_rows(directory, rows) for rows in reversed(scenarios))
    episodes = next((one for one in found if one), [])
    parts: list[Part] = []
    if episodes:
        title = title_of([episodes[0].row], ("scenario", *_FIGURE))
        parts += draw_episodes(episodes, images, title, number)
    forced = [row for row in scenarios[-1] if dig(row, "disturbed", "0")]
    if forced:
        path = style.save(images / f"forces_{number}.png", figures.side_forces, forced)
        parts.append(Picture(path, "RMSE by unmeasured side force"))
    return parts
