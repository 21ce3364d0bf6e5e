"""LaTeX: one booktabs table per setup, with the printed numbers beside ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sfkd_jax.evaluation.formats import (
    DASH,
    is_number,
    millimetres,
    number,
    percent,
)
from sfkd_jax.evaluation.metrics import BY_NAME
from sfkd_jax.paper._setups import Entry, Setup
from sfkd_jax.paper._study import Study
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.rows import NO_MODEL
from sfkd_jax.reporting.style import scenario_label

_ESCAPES = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "−": "$-$",
    "±": r"$\pm$",
    "–": "--",
    "α": r"$\alpha$",
    "<": "$<$",
    ">": "$>$",
}
_PREAMBLE = (
    "% Needs \\usepackage{booktabs,graphicx}. Every table stands alone, shrunk to the\n"
    "% text width where it is wider (about 450 pt for S1 to S3). In two columns use\n"
    "% table* for table, on narrow pages landscape.\n"
)
_FIT = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"


class _Column(NamedTuple):
    """One column; the least `value` of a learned row is bold, None for quotations."""

    group: str
    head: str
    shown: Callable[[Entry], str]
    value: Callable[[Entry], Any] | None = None


def latex(setups: list[Setup], study: Study) -> str:
    """All tables, divided by empty lines."""
    return _PREAMBLE + "\n".join(_table(setup, study) for setup in setups)


def _table(setup: Setup, study: Study) -> str:
    """A float with its caption, no wider than the text."""
    name = "-".join([setup.stem, setup.sampling or "table"]).replace("_", "-")
    lines = [
        r"\begin{table}[p]",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{_escaped(_caption(setup))}}}\label{{tab:{name}}}\vspace{{1ex}}",
        _FIT,
        f"{_tabular(setup, _columns(setup, study))}}}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _caption(setup: Setup) -> str:
    where = scenario_label(setup.hardest)
    return text("tables.latex", setup=setup.title, scenario=where)


def _tabular(setup: Setup, columns: list[_Column]) -> str:
    groups = list(dict.fromkeys(column.group for column in columns))
    spans = [sum(column.group == group for column in columns) for group in groups]
    above, rules = [], []
    for i, (group, span) in enumerate(zip(groups, spans, strict=True)):
        first = 2 + sum(spans[:i])
        above.append(rf"\multicolumn{{{span}}}{{c}}{{{_escaped(group)}}}")
        rules.append(rf"\cmidrule(lr){{{first}-{first + span - 1}}}")
    shown = [_cells(setup, column) for column in columns]
    body = [
        [_escaped(one.name), *cells]
        for one, *cells in zip(setup.entries, *shown, strict=True)
    ]
    lines = [
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        rf" & {' & '.join(above)} \\",
        "".join(rules),
        rf"Row & {' & '.join(_escaped(column.head) for column in columns)} \\",
        r"\midrule",
        *(rf"{' & '.join(row)} \\" for row in body),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines)


def _columns(setup: Setup, study: Study) -> list[_Column]:
    columns = []
    for name in setup.scenarios:
        group, printed = f"{scenario_label(name)} RMSE [mm]", f"rmse_{name}_m"
        columns.append(_Column(group, "ours", *_rmse(name)))
        if study.prints(printed):
            show = _printed(study, printed, lambda value: millimetres(value, 0))
            columns.append(_Column(group, "paper", show))
    rate, shares = "Rate [rad/s]", "Violations [%]"
    return [
        *columns,
        _Column(rate, "ours", *_metric(setup, "smoothness_rad_per_s")),
        _Column(rate, "paper", _printed(study, "smoothness_rad_per_s", number)),
        _Column(shares, "V1", _metric(setup, "violation.v1_conformal")[0]),
        _Column(shares, "V2", *_metric(setup, "violation.v2")),
        _Column(shares, "paper", _printed(study, "violation_rate", percent)),
    ]


def _rmse(name: str) -> tuple[Callable[[Entry], str], Callable[[Entry], Any]]:
    """Text and value of the RMSE on a scenario."""

    def show(entry: Entry) -> str:
        mean, std = (entry.value(name, "rmse_m", key) for key in ("mean", "std"))
        spread = (
            f" ± {millimetres(std)}" if mean is not None and std is not None else ""
        )
        return millimetres(mean) + spread

    return show, lambda entry: entry.value(name, "rmse_m", "mean")


def _metric(
    setup: Setup, name: str
) -> tuple[Callable[[Entry], str], Callable[[Entry], Any]]:
    """Text and value of a metric on the hardest scenario."""
    metric, hardest = BY_NAME[name], setup.hardest
    return (
        lambda entry: metric.text(entry.row(hardest)),
        lambda entry: metric.value(entry.row(hardest)),
    )


def _printed(
    study: Study, column: str, write: Callable[[Any], str]
) -> Callable[[Entry], str]:
    return lambda entry: write(study.number(entry.system, column))


def _cells(setup: Setup, column: _Column) -> list[str]:
    """A column, its least learned number in bold with all that print the same."""
    value, texts = column.value, [column.shown(entry) for entry in setup.entries]
    if value is None:
        return [_escaped(text) for text in texts]
    learned = [
        (value(entry), text)
        for entry, text in zip(setup.entries, texts, strict=True)
        if entry.system not in NO_MODEL and is_number(value(entry))
    ]
    best = min(learned, default=(None, DASH))[1].split(" ±")[0]
    return [
        rf"\textbf{{{_escaped(text)}}}"
        if entry.system not in NO_MODEL and text.split(" ±")[0] == best != DASH
        else _escaped(text)
        for entry, text in zip(setup.entries, texts, strict=True)
    ]


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(letter, letter) for letter in text)
