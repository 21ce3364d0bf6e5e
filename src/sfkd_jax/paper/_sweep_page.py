"""The page of a sweep over contraction factors, with its records and its figure."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sfkd_jax.evaluation.formats import dig, percent, plain
from sfkd_jax.evaluation.metrics import BY_NAME
from sfkd_jax.paper._sweep_figure import tradeoff
from sfkd_jax.paper._sweep_records import (
    Record,
    curves,
    records_of,
    scenario_of,
    steps_of,
)
from sfkd_jax.paper._sweep_text import FILE, paragraph, text
from sfkd_jax.reporting.blocks import (
    Block,
    Code,
    Heading,
    Picture,
    Table,
    Text,
    to_html,
    to_markdown,
)
from sfkd_jax.reporting.style import save, scenario_label
from sfkd_jax.reporting.texts import fill
from sfkd_jax.store import write_bytes, write_json, writing

_TABLES: dict[str, dict[str, str]] = tomllib.loads(FILE.read_text("utf-8"))
_DRIVEN = {
    "rmse_m": "rmse_m",
    "ratio_to_oracle": "ratio_to_oracle",
    "smoothness_rad_per_s": "smoothness_rad_per_s",
    "v0": "violation.v0",
    "v1_certified": "violation.v1",
    "v1_certified_radius_m": "violation.v1_radius_m",
    "v1_conformal": "violation.v1_conformal",
    "v1_conformal_radius_m": "violation.v1_conformal_radius_m",
}
"""Key in a record -> name of the metric."""
_Columns = dict[str, Callable[[Record], str]]


def write_comparison(root: Path, pattern: str, name: str) -> dict[str, Any]:
    """Write index.html, report.md, comparison.json and a figure of many runs.

    The files are in `root/name/comparison/`. Reads settings.json, policy.safetensors,
    open_loop.json, certificate.json and results.json of every run; what is in a missing
    file is null, except for settings.json. The only arithmetic is d̄ / (1 − α), for the
    separate α and for d̄ on validation drives.

    Args:
        root: of all store.
        pattern: of run directories below it, as `contraction/*/*/seed=*`.
        name: of the page.

    Returns:
        `report`, `comparison`: paths of the page and of the records. `figures`: paths
        of the figures.

    Raises:
        ValueError: no run matches.
        ArtefactError: a file that is not JSON, or the disk refuses the page.
    """
    with writing(root / name / "comparison"):
        return _write(root, pattern, name)


def _write(root: Path, pattern: str, name: str) -> dict[str, Any]:
    """`write_comparison`, without conversion of errors of the disk."""
    records = records_of(root, pattern)
    directory, title = root / name / "comparison", f"Comparison of runs: {name}"
    figure = directory / "figures" / f"{Path(name).name}.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    figure.unlink(missing_ok=True)
    page: list[Block] = [Heading(1, title), Text(paragraph(records), kind="lead")]
    if curves(records):
        page.append(Picture(save(figure, tradeoff, records), _caption(records)))
    page += _tables(records)
    page += [Heading(2, "How to make it again"), Code(_command(root, pattern, name))]
    write_json(directory / "comparison.json", {"pattern": pattern, "rows": records})
    write_bytes(directory / "index.html", to_html(title, page).encode())
    write_bytes(directory / "report.md", to_markdown(page).encode())
    return {
        "report": str(directory / "index.html"),
        "comparison": str(directory / "comparison.json"),
        "figures": [str(block.path) for block in page if isinstance(block, Picture)],
    }


def _command(root: Path, pattern: str, name: str) -> str:
    """The command of this page; Hydra needs quotes inside those of the shell."""
    settings = {"report.compare": pattern, "name": name, "root": root}
    words = [f"\"{key}='{value}'\"" for key, value in settings.items()]
    return " ".join(["python -m sfkd_jax.report", *words])


def _caption(records: list[Record]) -> str:
    scenario, whiskers = scenario_of(records), ""
    if scenario:
        whiskers = text("text.whiskers", scenario=scenario_label(scenario))
    beta = curves(records)[0][0]["beta"]
    return text("text.caption", beta=beta, whiskers=whiskers)


def _tables(records: list[Record]) -> list[Block]:
    covered = sorted({name for record in records for name in record["coverage"]})
    coverage = {
        f"Covered, {scenario_label(name)} [%]": _coverage(name) for name in covered
    }
    best = [i for i, one in enumerate(records) if one["smallest_of_its_betas"]]
    stressed = text("text.stressed") if best else ""
    note = text("text.covered", stressed=stressed, steps=steps_of(records, "tube"))
    ahead = f"after {steps_of(records, 'open_loop')} steps"
    return [
        Heading(2, "What is certified"),
        _table(records, _columns("certified")),
        *_reasons(records),
        Heading(2, "The bounds that follow"),
        _table(records, _columns("bounds") | coverage, tuple(best)),
        Text(note, kind="note"),
        Heading(2, f"Prediction without feedback, {ahead}"),
        _table(records, _columns("predicted")),
        *_driven(records),
    ]


def _columns(section: str) -> _Columns:
    """The columns of a section of the texts."""

    def column(template: str) -> Callable[[Record], str]:
        return lambda record: fill(template, record)

    return {name: column(template) for name, template in _TABLES[section].items()}


def _coverage(name: str) -> Callable[[Record], str]:
    return lambda record: percent(record["coverage"].get(name))


def _driven(records: list[Record]) -> list[Block]:
    """The closed-loop metrics of every run, by scenario."""

    def column(scenario: str, key: str) -> Callable[[Record], str]:
        write = BY_NAME[_DRIVEN[key]].write
        return lambda record: write(dig(record, "closed_loop", scenario, key))

    blocks: list[Block] = []
    for name in sorted({name for one in records for name in one["closed_loop"]}):
        heading = Heading(2, f"Driven: scenario {scenario_label(name)}")
        columns = {BY_NAME[m].head(): column(name, key) for key, m in _DRIVEN.items()}
        blocks += [heading, _table(records, columns)]
    return blocks


def _table(
    records: list[Record], columns: _Columns, strong: tuple[int, ...] = ()
) -> Table:
    rows = [
        [name, *(cell(record) for cell in columns.values())]
        for name, record in zip(_short_names(records), records, strict=True)
    ]
    return Table(["Run", *columns], rows, strong)


def _reasons(records: list[Record]) -> list[Block]:
    """The runs without a certificate."""
    named = zip(_short_names(records), records, strict=True)
    rows = [[name, plain(one["reason"])] for name, one in named if one["reason"]]
    table = Table(["Run", "Reason"], rows, prose=True)
    return [Heading(3, "Not certified"), table] if rows else []


def _short_names(records: list[Record]) -> list[str]:
    """Paths of several runs without the folders at both ends that all share."""
    names = [record["run"] for record in records]
    paths = [name.split("/") for name in names]
    while len({path[0] for path in paths}) == 1 < min(map(len, paths)):
        paths = [path[1:] for path in paths]
    while len({path[-1] for path in paths}) == 1 < min(map(len, paths)):
        paths = [path[:-1] for path in paths]
    return ["/".join(path) for path in paths] if len(names) > 1 else names
