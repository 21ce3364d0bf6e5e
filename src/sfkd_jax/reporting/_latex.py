"""Table 1 for a paper: one booktabs table per vehicle and sampling, the paper's own numbers beside ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sfkd_jax.reporting._benchmark_rows import (
    SELF_EVIDENT,
    Contest,
    Line,
    scenarios,
    stem,
    title,
)
from sfkd_jax.reporting._benchmark_tables import Paper, conformal, millimetres, percent
from sfkd_jax.reporting._numbers import DASH, dig, is_number, number
from sfkd_jax.reporting._style import scenario_label

_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "−": "$-$", "±": r"$\pm$", "–": "--", "α": r"$\alpha$", "<": "$<$", ">": "$>$",
}  # fmt: skip
_PREAMBLE = (
    "% Needs \\usepackage{booktabs,graphicx}. Every table stands alone; it is shrunk to the width of the text where\n"
    "% it is wider (about 450 pt for S1 to S3): in two columns use table* for table, on narrow pages landscape.\n"
)
_FIT = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"


class _Column(NamedTuple):
    """One column; `value` decides which learned row is set in bold, None for columns that are only quoted."""

    group: str
    head: str
    show: Callable[[Line], str]
    value: Callable[[Line], Any] | None = None


def latex(found: list[Contest], paper: Paper) -> str:
    """Tables divided by empty lines; every one stands alone."""
    return _PREAMBLE + "\n".join(_table(contest, paper) for contest in found)


def _table(contest: Contest, paper: Paper) -> str:
    """A float with its caption, no wider than the text."""
    name = "-".join([stem(contest), contest.sampling or "table"]).replace("_", "-")
    lines = [
        r"\begin{table}[p]",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{_escaped(_caption(contest))}}}\label{{tab:{name}}}\vspace{{1ex}}",
        _FIT,
        f"{_tabular(contest, paper)}}}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _caption(contest: Contest) -> str:
    hardest = scenario_label(scenarios(contest)[-1])
    return (
        f"{title(contest)}. Lateral RMSE: mean and standard deviation over episodes. Steering rate, V1 (segments that "
        f"leave their conformal tube) and V2 (windows beyond one threshold): on {hardest}. Bold: the best learned row "
        "of a column. Paper: what the paper prints for the row's system, measured in another simulator."
    )


def _tabular(contest: Contest, paper: Paper) -> str:
    columns = _columns(contest, paper)
    groups = list(dict.fromkeys(column.group for column in columns))
    spans = [sum(column.group == group for column in columns) for group in groups]
    above = [
        rf"\multicolumn{{{span}}}{{c}}{{{_escaped(group)}}}"
        for group, span in zip(groups, spans, strict=True)
    ]
    edges = [2 + sum(spans[:place]) for place in range(len(spans))]
    rules = [
        rf"\cmidrule(lr){{{edge}-{edge + span - 1}}}"
        for edge, span in zip(edges, spans, strict=True)
    ]
    shown = [_cells(contest, column) for column in columns]
    body = [
        [_escaped(line.name), *cells]
        for line, *cells in zip(contest.lines, *shown, strict=True)
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


def _columns(contest: Contest, paper: Paper) -> list[_Column]:
    columns = []
    for name in scenarios(contest):
        group = f"{scenario_label(name)} RMSE [mm]"
        columns.append(
            _Column(group, "ours", _spread(name), _of(name, "rmse_m", "mean"))
        )
        if any(f"rmse_{name}_m" in row for row in paper.values()):
            columns.append(
                _Column(
                    group,
                    "paper",
                    _printed(paper, f"rmse_{name}_m", lambda x: millimetres(x, 0)),
                )
            )
    hardest = scenarios(contest)[-1]
    rate, violated = "smoothness_rad_per_s", _of(hardest, "violation", "v2")
    columns += [
        _Column(
            "Rate [rad/s]",
            "ours",
            lambda line: number(_of(hardest, rate)(line)),
            _of(hardest, rate),
        ),
        _Column("Rate [rad/s]", "paper", _printed(paper, rate, number)),
        _Column(
            "Violations [%]", "V1", lambda line: percent(_conformal(line, hardest))
        ),
        _Column("Violations [%]", "V2", lambda line: percent(violated(line)), violated),
        _Column("Violations [%]", "paper", _printed(paper, "violation_rate", percent)),
    ]
    return columns


def _cells(contest: Contest, column: _Column) -> list[str]:
    """A column as LaTeX, its smallest learned number in bold with all that print the same."""
    value, shown = column.value, [column.show(line) for line in contest.lines]
    if value is None:
        return [_escaped(text) for text in shown]
    pairs = list(zip(contest.lines, shown, strict=True))
    learned = [
        (value(line), text)
        for line, text in pairs
        if _learned(line) and is_number(value(line))
    ]
    best = min(learned, default=(None, DASH))[1].split(" ±")[0]
    bold = [
        _learned(line) and text != DASH and text.split(" ±")[0] == best
        for line, text in pairs
    ]
    return [
        rf"\textbf{{{_escaped(text)}}}" if mark else _escaped(text)
        for text, mark in zip(shown, bold, strict=True)
    ]


def _learned(line: Line) -> bool:
    return line.system not in SELF_EVIDENT


def _of(scenario: str, *keys: str) -> Callable[[Line], Any]:
    return lambda line: dig(line.rows.get(scenario), *keys)


def _conformal(line: Line, scenario: str) -> Any:
    return conformal(line.rows.get(scenario) or {}, "v1_conformal", "v1")


def _spread(scenario: str) -> Callable[[Line], str]:
    def show(line: Line) -> str:
        mean, std = (_of(scenario, "rmse_m", key)(line) for key in ("mean", "std"))
        return (
            f"{millimetres(mean)} ± {millimetres(std)}"
            if is_number(mean) and is_number(std)
            else millimetres(mean)
        )

    return show


def _printed(
    paper: Paper, key: str, show: Callable[[Any], str]
) -> Callable[[Line], str]:
    return lambda line: show(dig(paper.get(line.system), key))


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(letter, letter) for letter in text)
