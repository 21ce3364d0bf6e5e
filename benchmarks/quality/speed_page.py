"""Write the tables of docs/corridor.md about speed, and their figure, from what benchmarks/quality/speed.py measured.

python -m benchmarks.quality.speed_page
"""

import json
from pathlib import Path

from sfkd_jax.corridor import fastest_speeds
from sfkd_jax.paper import draw_speed

HOME = Path(__file__).resolve().parents[2]
MEASURED = HOME / "benchmarks" / "quality" / "speed.json"
PAGE, FIGURE = HOME / "docs" / "corridor.md", HOME / "docs" / "corridor_speed.png"
OPEN, CLOSE = "<!-- speed -->\n", "<!-- end of speed -->"
CLEARANCES = (0.1, 0.15, 0.2, 0.3)
"""Besides the one that was asked for [m]."""


def table(name, result):
    """The corridor of every cell, as Markdown: a row for each speed."""
    cells = result["cells"]
    frictions, speeds = (
        sorted({cell[key] for cell in cells}) for key in ("friction", "speed")
    )
    known = {(cell["friction"], cell["speed"]): cell for cell in cells}
    lines = [
        _row(
            [
                f"{name}: speed [m/s]",
                "tightest bend [1/m]",
                *(f"friction {value:g}" for value in frictions),
            ]
        )
    ]
    lines.append(_row(["---"] * (2 + len(frictions))))
    for speed in speeds:
        row = [known[friction, speed] for friction in frictions]
        shown = [f"{cell['corridor_m']:.3f} ({cell['lateral_m']:.3f})" for cell in row]
        lines.append(_row([f"{speed:g}", f"{row[0]['curvature']:.4f}", *shown]))
    return "\n".join(lines) + "\n"


def answer(result, room):
    """How fast the car may go, in one sentence."""
    ends = max(cell["speed"] for cell in result["cells"])
    speeds = fastest_speeds(result["cells"], room)
    if all(speed == ends for speed in speeds.values()):
        return f"With {room:g} m of room: up to {ends:g} m/s at every friction; the box ends first."
    if not any(speeds.values()):
        return f"With {room:g} m of room: at no speed of the box."
    words = [
        f"friction {friction:g} {_speed(speed)}"
        for friction, speed in speeds.items()
        if speed != ends
    ]
    words += (
        [f"up to {ends:g} m/s elsewhere, where the box ends first"]
        if ends in speeds.values()
        else []
    )
    return f"With {room:g} m of room: {', '.join(words)}."


def tables(document):
    """All of them, with what was counted."""
    lines = []
    for name, result in document["cars"].items():
        shares = [
            result["coverage"],
            *result["coverage_ci95"],
            *_ends(cell["coverage"] for cell in result["cells"]),
        ]
        inside = "{:.1f} % of all test drives are inside ({:.1f} to {:.1f} %), {:.1f} to {:.1f} % by cell"
        lines += [table(name, result)]
        lines += [
            f"- {answer(result, room)}"
            for room in sorted({*CLEARANCES, document["room_m"]})
        ]
        lines += [
            f"- {result['drives']} drives of {result['duration_s']:g} s fix the units of a cell, as many calibrate and "
            f"as many test at level {100 * result['level']:g} %: {inside.format(*(100 * share for share in shares))}.",
            "",
        ]
    return "\n".join(lines)


def page(text, document):
    """The page with the tables as they have to be."""
    before, rest = text.split(OPEN)
    return before + OPEN + tables(document) + CLOSE + rest.split(CLOSE)[1]


def _row(cells):
    return f"| {' | '.join(cells)} |"


def _ends(values):
    result = sorted(values)
    return result[0], result[-1]


def _speed(speed):
    return "at no speed of the box" if speed is None else f"up to {speed:g} m/s"


if __name__ == "__main__":
    measured = json.loads(MEASURED.read_text("utf-8"))
    PAGE.write_text(page(PAGE.read_text("utf-8"), measured), "utf-8")
    shown = {name: result["cells"] for name, result in measured["cars"].items()}
    print(draw_speed(FIGURE, shown, margin=measured["room_m"]))
