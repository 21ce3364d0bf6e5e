"""Write the tables of docs/adaptation.md from measurements in benchmarks/quality.

python -m benchmarks.quality.adaptation_page
"""

import json
import statistics
from functools import partial

from benchmarks.harness import ROOT
from benchmarks.markdown import filled, table

PAGE = ROOT / "docs" / "adaptation.md"
MAIN = (
    "oracle that knows",
    "oracle that does not know",
    "oracle, e estimated",
    "SFKD",
    "SFKD, adaptive",
    "SFKD, adaptive, slower",
    "SFKD, adaptive, cautious",
)
RIVALS = (
    "SFKD, adaptive",
    "SFKD, one filter",
    "SFKD, no slow causes",
    "SFKD, bank",
    "neural ODE",
    "neural ODE, last layer",
)
FRICTION = "friction 0.2, told 0.9, 12 m/s"
LEADS = ("1", "5", "10", "20")
VEHICLES = ("kinematic", "dynamic")


def measured(name):
    """The cases of a vehicle."""
    return _stored(f"adaptation_{name}")["cases"]


def errors(name):
    """Lateral RMSE of every row, with its ratio to the oracle that knows."""
    lines = []
    for case, rows in measured(name).items():
        if case != FRICTION:
            best = rows["oracle that knows"]["rmse_mm"]
            lines.append([case, *(_error(rows.get(row), best) for row in MAIN)])
    return table([f"{name} [mm]", *MAIN], lines)


def rivals(name):
    """The same of ablations and of baselines."""
    lines = []
    for case, rows in measured(name).items():
        if RIVALS[-1] in rows:
            best = rows["oracle that knows"]["rmse_mm"]
            lines.append([case, *(_error(rows.get(row), best) for row in RIVALS)])
    return table([f"{name} [mm]", *RIVALS], lines)


def friction(name):
    """Who leaves the lane on a road three times as slippery as E allows."""
    rows = measured(name)[FRICTION]
    head = [name, "left the lane", "largest error, median [m]", "speed, mean [m/s]"]
    lines = []
    for row, found in rows.items():
        largest = found["largest_mm"]
        left = f"{found['left_the_lane']} of {len(largest)}"
        middle = f"{statistics.median(largest) / 1e3:.2f}"
        lines.append([row, left, middle, f"{found['speed_m_per_s']:.1f}"])
    return table(head, lines)


def coverage(name):
    """Coverage of the tube at level 95 % and its radius; speed and largest error."""
    heads = [f"{lead} ahead" for lead in LEADS]
    heads += ["radius 10 ahead [m]", "largest error [mm]"]
    heads += ["slower: speed [m/s]", "slower: largest error [mm]"]
    lines = []
    cases = measured(name)
    given = {
        case: (rows["SFKD, adaptive"], rows.get("SFKD, adaptive, slower"))
        for case, rows in cases.items()
    }
    careful = cases[FRICTION]["SFKD, e estimated, cautious"]
    given[f"{FRICTION}; e estimated, cautious"] = careful, None
    for case, (own, slow) in given.items():
        cells = [f"{100 * own['coverage'][lead]:.1f} %" for lead in LEADS]
        cells.append(f"{own['tube_m']['10']:.3f}")
        cells.append(f"{max(own['largest_mm']):.0f}")
        speed = f"{slow['speed_m_per_s']:.1f}" if slow else "–"
        cells += [speed, f"{max(slow['largest_mm']):.0f}" if slow else "–"]
        lines.append([case, *cells])
    return table([name, *heads], lines)


def information(name):
    """Errors of estimated friction and force after a switch, beside their bound."""
    document = _stored(f"estimation_bound_{name}")
    rows = document["errors"]
    steps = list(rows["bound"])
    head = [f"{name}: friction / side force [N], steps after a switch", *steps]
    lines = []
    driven = document["rmse_mm"]
    driven = driven | {"bound": driven["oracle, e as wrong as the bound"]}
    for row, errors in rows.items():
        cells = [f"{errors[at][0]:.2f} / {errors[at][1]:.0f}" for at in steps]
        lines.append([row, *cells, f"{driven[row]:.1f}"])
    exact = f"{driven['oracle, e measured']:.1f}"
    lines.append(["e measured", *["0 / 0"] * len(steps), exact])
    return table([*head, "lateral RMSE [mm]"], lines)


KINDS = {
    "information": information,
    "errors": errors,
    "rivals": rivals,
    "friction": friction,
    "coverage": coverage,
}
TABLES = {
    f"{kind}_{name}": partial(build, name)
    for name in VEHICLES
    for kind, build in KINDS.items()
}
"""Marker in the page -> its table."""


def page(text):
    """The page with its tables."""
    return filled(text, {name: build() for name, build in TABLES.items()})


def _stored(name):
    """A document of this folder."""
    return json.loads((ROOT / f"benchmarks/quality/{name}.json").read_text())


def _error(row, best):
    """RMSE and ratio of a row, or a dash."""
    if row is None:
        return "–"
    return f"{row['rmse_mm']:.1f} ({row['rmse_mm'] / best:.2f})"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
