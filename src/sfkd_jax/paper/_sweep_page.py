"""The comparison of many runs: reads what lies in their directories and writes page, Markdown, records and figure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sfkd_jax.artefacts import write_bytes, write_json, writing
from sfkd_jax.evaluation.formats import (
    dig,
    mean_std,
    number,
    percent,
    plain,
    short,
    upper,
)
from sfkd_jax.paper._sweep_figure import tradeoff
from sfkd_jax.paper._sweep_records import (
    Record,
    curves,
    records_of,
    scenario_of,
    steps_of,
)
from sfkd_jax.paper._sweep_text import paragraph
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


def write_comparison(root: Path, pattern: str, name: str) -> dict[str, Any]:
    """Write `root/name/comparison/`: `index.html`, `report.md`, `comparison.json` and `figures/<name>.png`.

    Reads settings.json, policy.json, open_loop.json, certificate.json and results.json
    of every run. All but settings.json may be missing: what they would say is null. The
    only arithmetic is d̄ / (1 − α), for the separate α and for d̄ on validation drives.

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
    with writing(root / name / "comparison"):
        return _write(root, pattern, name)


def _write(root: Path, pattern: str, name: str) -> dict[str, Any]:
    """`write_comparison`, errors as they come."""
    records = records_of(root, pattern)
    place, figure = root / name / "comparison", Path(name).name
    (place / "figures").mkdir(parents=True, exist_ok=True)
    (place / "figures" / f"{figure}.png").unlink(missing_ok=True)
    title = f"Comparison of runs: {name}"
    page: list[Block] = [Heading(1, title), Text(paragraph(records), kind="lead")]
    if curves(records):
        beta = plain(curves(records)[0][0]["beta"])
        picture = save(place / "figures" / f"{figure}.png", tradeoff, records)
        page.append(Picture(picture, _caption(beta, scenario_of(records))))
    page += _tables(records)
    page += [Heading(2, "How to make it again"), Code(_command(root, pattern, name))]
    write_json(place / "comparison.json", {"pattern": pattern, "rows": records})
    write_bytes(place / "index.html", to_html(title, page).encode())
    write_bytes(place / "report.md", to_markdown(page).encode())
    return {
        "report": str(place / "index.html"),
        "comparison": str(place / "comparison.json"),
        "figures": [str(block.path) for block in page if isinstance(block, Picture)],
    }


def _command(root: Path, pattern: str, name: str) -> str:
    """The command line of this page, quoted twice: for the shell, and for Hydra, to which = and * mean something."""
    settings = {"report.compare": pattern, "name": name, "root": root}
    return " ".join(
        [
            "python -m sfkd_jax.report",
            *(f"\"{key}='{value}'\"" for key, value in settings.items()),
        ]
    )


def _caption(beta: str, scenario: str | None) -> str:
    driven = (
        f" Whiskers: 95 % interval of the mean over episodes of {scenario_label(scenario)}."
        if scenario
        else ""
    )
    return (
        f"Runs with β = {beta}, one point a run, against the contraction factor that is certified.{driven} Hollow: "
        "the same run, if only the separate bounds ρ and β were added. Latent units are those of each run."
    )


_Columns = dict[str, Callable[[Record], str]]

_PROVED: _Columns = {
    "Vehicle": lambda record: plain(record["vehicle"]),
    "Inner\nloop": lambda record: plain(record["inner_loop"]),
    "ρ\nasked": lambda record: plain(record["rho"]),
    "β\nasked": lambda record: plain(record["beta"]),
    "α\ncertified": lambda record: upper(record["alpha"]),
    "α\nseparate": lambda record: upper(record["alpha_separate"]),
    "α\njoint": lambda record: upper(record["alpha_joint"]),
    "Attack": lambda record: short(record["attack"], 6),
    "Tightness": lambda record: number(record["tightness"], 4),
}

_MEASURED: _Columns = {
    "d̄": lambda record: upper(record["d_bar"]),
    "d̄ on\nvalidation": lambda record: upper(record["d_bar_validation"]),
    "Tube at T,\nlatent": lambda record: upper(record["tube"]["latent"]),
    "Ultimate\nbound": lambda record: upper(record["ultimate"]),
    "Ultimate on\nvalidation, body": lambda record: upper(
        record["ultimate_body_validation"]
    ),
    "Tube at T,\nposition [m]": lambda record: upper(record["tube"]["position_m"]),
}

_PREDICTED: _Columns = {
    "Position\n[m]": lambda record: number(record["open_loop"]["position_rmse_m"], 4),
    "Along\n[m]": lambda record: number(record["open_loop"]["longitudinal_rmse_m"], 4),
    "Across\n[m]": lambda record: number(record["open_loop"]["lateral_rmse_m"], 4),
}

_DRIVEN: _Columns = {
    "RMSE [m]\nmean ± std": lambda row: mean_std(row.get("rmse_m"), 4),
    "RMSE over\noracle": lambda row: number(row.get("ratio_to_oracle"), 2),
    "Steering rate\n[rad/s]": lambda row: number(row.get("smoothness_rad_per_s")),
    "V0, theorem\n[%]": lambda row: percent(row.get("v0")),
    "V1, certified\ntube [%]": lambda row: percent(row.get("v1_certified")),
    "its mean\nradius [m]": lambda row: number(row.get("v1_certified_radius_m")),
    "V1, conformal\ntube [%]": lambda row: percent(row.get("v1_conformal")),
    "mean radius\nof that [m]": lambda row: number(row.get("v1_conformal_radius_m")),
}


def _tables(records: list[Record]) -> list[Block]:
    scenarios = sorted({name for record in records for name in record["closed_loop"]})
    covered = sorted({name for record in records for name in record["coverage"]})
    coverage: _Columns = {
        f"Covered,\n{scenario_label(name)} [%]": _coverage(name) for name in covered
    }
    best = [record["smallest_of_its_betas"] for record in records]
    marked = f"{_MARKED} " if any(best) else ""
    blocks: list[Block] = [
        Heading(2, "What is certified"),
        _table(records, _PROVED),
        *_reasons(records),
        Heading(2, "What the bounds come to"),
        _table(
            records,
            _MEASURED | coverage,
            tuple(place for place, one in enumerate(best) if one),
        ),
        Text(
            f"{marked}T is {steps_of(records, 'tube')} steps. {_COVERED}", kind="note"
        ),
        Heading(
            2,
            f"Prediction without feedback, after {steps_of(records, 'open_loop')} steps",
        ),
        _table(records, _PREDICTED),
    ]
    for name in scenarios:
        rows = {key: _of(name, cell) for key, cell in _DRIVEN.items()}
        blocks += [
            Heading(2, f"Driven: scenario {scenario_label(name)}"),
            _table(records, rows),
        ]
    return blocks


_MARKED = (
    "Stressed: the smallest ultimate bound of the body state, L d̄ / (1 − α), on validation drives among runs that "
    "share one vehicle, one inner loop and one ρ + β; this is what chooses β, and no calibration drive takes part in "
    "it. The latent's unit differs from run to run; the body state's does not."
)
_COVERED = (
    "Covered: share of drives, calibration aside, of which every one-step error is at most d̄, by the scenario they "
    "come from."
)


def _coverage(name: str) -> Callable[[Record], str]:
    return lambda record: percent(record["coverage"].get(name))


def _of(scenario: str, cell: Callable[[Record], str]) -> Callable[[Record], str]:
    """A column of the scenario's row of each run."""
    return lambda record: cell(dig(record, "closed_loop", scenario) or {})


def _table(
    records: list[Record], columns: _Columns, strong: tuple[int, ...] = ()
) -> Table:
    names = _short([record["run"] for record in records])
    rows = [
        [name, *(cell(record) for cell in columns.values())]
        for name, record in zip(names, records, strict=True)
    ]
    return Table(["Run", *columns], rows, strong)


def _reasons(records: list[Record]) -> list[Block]:
    names = _short([record["run"] for record in records])
    rows = [
        [name, plain(r["reason"])]
        for name, r in zip(names, records, strict=True)
        if r["reason"]
    ]
    return (
        [Heading(3, "Not certified"), Table(["Run", "Reason"], rows, prose=True)]
        if rows
        else []
    )


def _short(places: list[str]) -> list[str]:
    """Paths without the folders that they begin and end with in common; a single one in full."""
    paths = [place.split("/") for place in places]
    while len({path[0] for path in paths}) == 1 < min(map(len, paths)):
        paths = [path[1:] for path in paths]
    while len({path[-1] for path in paths}) == 1 < min(map(len, paths)):
        paths = [path[:-1] for path in paths]
    return ["/".join(path) for path in paths] if len(places) > 1 else places
