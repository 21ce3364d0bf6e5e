"""The tables of what benchmarks/quality/shield.py measured, and what of it is not as asked."""

ASKED = {"departures": 0, "rmse_ratio": 1.02, "intervened": 0.01, "added_ms": 1.0}
FLAGS = ("infeasible", "void", "broken")
"""Of a step: no way back into the corridor; beyond the certificate's boxes; too far
from the copy.
"""


def table(document):
    """The document as Markdown: a table of all scripts for every car, and one of the
    policies' own planners.
    """
    head = [
        "planner",
        "left the lane, without → with",
        "largest e_y [m], without → with",
        "copy [m]",
        "e_y − copy [m]",
    ]
    head += ["drives inside", "steps cut", "no way back", "void", "broken"]
    lines = []
    for name, car in document["cars"].items():
        bounds = car["bounds"]
        lines += [
            f"{name}: W = {bounds['nominal']:.3f} m, tube {bounds['vehicle_to_nominal_position']:.3f} m",
            "",
        ]
        lines += [_row(head), _row(["---"] * len(head))]
        for label, both in (*car["scripts"].items(), ("its own", car["planner"])):
            saved, free = both["with"], both["without"]
            cells = [
                label,
                f"{_of(free)} → {_of(saved)}",
                f"{_metres(free)} → {_metres(saved)}",
            ]
            cells += [f"{saved[key]:.3f}" for key in ("copy_m", "distance_m")]
            lines.append(
                _row(
                    cells
                    + [_percent(saved[key]) for key in ("inside", "intervened", *FLAGS)]
                )
            )
        lines.append("")
    head = [
        "car",
        "RMSE without → with [mm]",
        "ratio",
        "steps cut",
        "step without → with [ms]",
        "added [ms]",
    ]
    lines += [_row(head), _row(["---"] * len(head))]
    for name, car in document["cars"].items():
        saved, free, times = (
            car["planner"]["with"],
            car["planner"]["without"],
            car["step"],
        )
        cells = [
            name,
            f"{1e3 * free['rmse_m']:.1f} → {1e3 * saved['rmse_m']:.1f}",
            f"{car['planner']['rmse_ratio']:.3f}",
        ]
        cells += [_percent(saved["intervened"])]
        cells += [
            f"{times['without']['median_ms']:.2f} → {times['with']['median_ms']:.2f}",
            f"{times['added_ms']:.2f}",
        ]
        lines.append(_row(cells))
    return "\n".join(lines) + "\n"


def _row(cells):
    return f"| {' | '.join(cells)} |"


def _of(summary):
    return f"{summary['departures']} of {summary['drives']}"


def _metres(summary):
    largest = summary["largest_m"]
    return (
        "not finite"
        if largest is None
        else f"{largest:.3f}"
        if largest < 10.0
        else "> 10"
    )


def _percent(share):
    """As few digits as tell a share that is not 0 or 1 from both."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return "< 0.01 %" if share < 1e-4 else f"{100 * share:.2f} %"


def misses(document):
    """What was asked for and is not so, in words."""
    result = []
    for name, car in document["cars"].items():
        left = {
            script: both["with"]["departures"]
            for script, both in car["scripts"].items()
        }
        left |= {"its own": car["planner"]["with"]["departures"]}
        own = {
            "rmse_ratio": car["planner"]["rmse_ratio"],
            "intervened": car["planner"]["with"]["intervened"],
        }
        own |= {"added_ms": car["step"]["added_ms"]}
        result += [
            f"{name}, {script}: {count} departures"
            for script, count in left.items()
            if count > ASKED["departures"]
        ]
        result += [
            f"{name}: {key} = {value:.4g}, asked {ASKED[key]}"
            for key, value in own.items()
            if not value <= ASKED[key]
        ]
    return result
