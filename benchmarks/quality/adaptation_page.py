"""Write the tables of docs/adaptation.md from what benchmarks/quality/adaptation.py measured.

python -m benchmarks.quality.adaptation_page
"""

import json
import re
from functools import partial

from benchmarks.harness import ROOT

PAGE = ROOT / "docs" / "adaptation.md"
COLUMNS = (
    "oracle that knows",
    "oracle that does not know",
    "SFKD",
    "SFKD, adaptive",
    "SFKD, adaptive, slower",
    "SFKD, one filter",
    "SFKD, no slow causes",
    "oracle, e estimated",
)
VEHICLES = ("kinematic", "dynamic")


def measured(name):
    """The cases of a vehicle."""
    file = ROOT / f"benchmarks/quality/adaptation_{name}.json"
    return json.loads(file.read_text())["cases"]


def errors(name):
    """Lateral RMSE of every row, with its ratio to the oracle that knows."""
    lines = [_line([f"{name} [mm]", *COLUMNS]), _line(["---"] * (1 + len(COLUMNS)))]
    for case, rows in measured(name).items():
        best = rows["oracle that knows"]["rmse_mm"]
        cells = [_error(rows.get(column), best) for column in COLUMNS]
        lines.append(_line([case, *cells]))
    return "\n".join(lines)


def coverage(name):
    """Coverage of the tube at level 95 %, its radius, and speeds of the rows with it."""
    leads = ("1", "5", "10", "20")
    heads = [f"{lead} ahead" for lead in leads]
    slower = [
        "radius 10 ahead [m]",
        "speed [m/s]",
        "slower: speed [m/s]",
        "largest [mm]",
    ]
    lines = [_line([name, *heads, *slower]), _line(["---"] * 9)]
    for case, rows in measured(name).items():
        own, slow = rows["SFKD, adaptive"], rows["SFKD, adaptive, slower"]
        cells = [f"{100 * own['coverage'][lead]:.1f} %" for lead in leads]
        cells.append(f"{own['tube_m']['10']:.3f}")
        cells += [f"{row['speed_m_per_s']:.1f}" for row in (own, slow)]
        cells.append(f"{own['largest_mm']:.0f}, slower {slow['largest_mm']:.0f}")
        lines.append(_line([case, *cells]))
    return "\n".join(lines)


TABLES = {
    f"{kind}_{name}": partial(build, name)
    for name in VEHICLES
    for kind, build in (("errors", errors), ("coverage", coverage))
}
"""Marker in the page -> its table."""


def page(text):
    """The page with its tables."""
    for name, build in TABLES.items():
        pattern = re.compile(rf"<!-- {name} -->\n.*?<!-- end -->", re.DOTALL)
        text = pattern.sub(f"<!-- {name} -->\n{build()}\n<!-- end -->", text)
    return text


def _error(row, best):
    """RMSE and ratio of a row, or a dash."""
    if row is None:
        return "–"
    return f"{row['rmse_mm']:.1f} ({row['rmse_mm'] / best:.2f})"


def _line(cells):
    """A line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
