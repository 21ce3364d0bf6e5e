"""Print the tables of docs/results/other-cars.md from experiments/commonroad/*.json; with --write put them there.

python -m experiments.commonroad.page [--write]
--write draws the page's figure as well.
"""

import argparse
import json

from benchmarks.harness import ROOT
from benchmarks.markdown import put, table

FIGURE = ROOT / "docs" / "results" / "other-cars_files" / "rmse.png"
SYSTEMS = {
    # row: (label, colour, line)
    "sfkd": ("SFKD, dynamic", "#0b57b0", "-"),
    "sfkd_kinematic": ("SFKD, kinematic", "#009e73", "-"),
    "sfkd_tuned": ("SFKD, dynamic, tuned", "#0b57b0", "--"),
    "sfkd_kinematic_tuned": ("SFKD, kinematic, tuned", "#009e73", "--"),
    "nominal": ("nominal", "#e8a33d", "-"),
    "nominal_this_car": ("nominal, this car's wheelbase", "#d55e00", "-"),
}
FRICTIONS = (0.9, 0.6, 0.3)
CARS = {"commonroad_std": "single-track drift", "commonroad_mb": "multi-body"}


def results():
    """The document of the last run."""
    return json.loads(
        (ROOT / "experiments" / "commonroad" / "results.json").read_text()
    )


def deviations():
    """Lateral RMSE by car, friction and system [mm], and how many episodes left the
    lane.
    """
    rows, lines = results()["rows"], []
    for name, (label, *_) in SYSTEMS.items():
        mine = [row for row in rows if row["system"] == name]
        lines.append(
            [label, *map(deviation, mine), sum(row["departures"] for row in mine)]
        )
    first = [row for row in rows if row["system"] == "nominal"]
    return table(
        [
            "",
            *(f"{CARS[row['vehicle']]}, {row['friction']}" for row in first),
            "left the lane",
        ],
        lines,
    )


def deviation(row):
    """In millimetres, with the departures."""
    mean, left = row["rmse_m"]["mean"], row["departures"]
    return ("spun" if mean is None else f"{1e3 * mean:.1f}") + (
        f" ({left} left)" if left else ""
    )


def ratios():
    """Every SFKD row over the nominal bicycle (all paths, worst path), over itself
    before, and the monitor's flags.
    """
    lines = []
    for name, (label, *_) in SYSTEMS.items():
        for car, words in CARS.items():
            mine = [
                row
                for row in results()["rows"]
                if (row["system"], row["vehicle"]) == (name, car)
            ]
            if name.startswith("nominal"):
                continue
            entries = [
                f"{times(row['ratio_to_nominal'])} ({times(row['worst_ratio_to_nominal'])})"
                for row in mine
            ]
            untuned = (
                " / ".join(times(row["ratio_to_untuned"]) for row in mine)
                if name.endswith("_tuned")
                else ""
            )
            flags = " / ".join(f"{100 * row['breach_steps']:.0f}" for row in mine)
            lines.append([f"{label}, {words}", *entries, untuned, flags])
    heads = [f"over nominal, {friction} (worst path)" for friction in FRICTIONS]
    return table(["RMSE", *heads, "over the same untuned", "steps flagged [%]"], lines)


def times(ratio):
    """A ratio, or a dash where a car spun."""
    return "–" if ratio is None else f"{ratio:.2f}"


def tuning():
    """What training on did to prediction and certificate."""
    result = results()["tuning"]
    lines = []
    for name, row in result.items():
        if name == "drives":
            continue
        error = row["position_rmse_2s_m"]
        numbers = [
            f"{error['before']:.3f}",
            f"{error['after']:.3f}",
            f"{row['alpha']:.4f}",
            f"{row['d_bar']:.3f}",
        ]
        lines.append(
            [
                SYSTEMS[name][0],
                *numbers,
                f"{100 * row['coverage']:.0f} %",
                f"{row['cpu_seconds']:.0f}",
            ]
        )
    heads = [
        "",
        "2 s ahead, before [m]",
        "after [m]",
        "α, certified",
        "d̄",
        "held-out drives inside d̄",
        "CPU [s]",
    ]
    return table(heads, lines)


def handling():
    """Curvature in a steady turn over that of the textbook bicycle."""
    names = {"kinematic": "our kinematic plant", "dynamic": "our dynamic plant"}
    names |= {"std": CARS["commonroad_std"], "mb": CARS["commonroad_mb"]}
    lines = [
        [names[name], *(f"{value:.3f}" for value in row)]
        for name, row in results()["handling"].items()
    ]
    return table(
        ["curvature over the bicycle's", *(f"friction {each}" for each in FRICTIONS)],
        lines,
    )


def export():
    """The exported controller beside the one in Python."""
    result = results()["export"]
    numbers = [
        result["steps"],
        f"{1e3 * result['rmse_m']:.1f}",
        f"{result['largest_difference']:g}",
    ]
    return table(["steps", "RMSE [mm]", "largest difference of a control"], [numbers])


def along_path():
    """What is certified of the drift car along a path, and what the package's own car
    did.
    """
    result = json.loads((ROOT / "experiments" / "commonroad" / "path.json").read_text())
    certificate, package, step = (
        result["certificate"],
        result["package"],
        result["step"],
    )
    output, corridor = certificate["outputs"]["position"], certificate["corridor"]
    bounds, s3, tube = corridor["bounds"], corridor["by_scenario"]["s3"], output["tube"]
    inside = {
        name: within(output["coverage"][name], output["coverage_drives"])
        for name in tube
    }
    separate = step["largest"]
    lines = {
        "α in the metric of e_y, proved; in the 2-norm": f"{output['alpha']:.3f}; {certificate['alpha']:.3f}",
        "tube on 5 s drives like the data, `for_ever` [m]": f"{tube['for_ever']:.3f}",
        "test drives inside": inside["for_ever"],
        "the same, `followed` [m]": f"{tube['followed']:.3f}",
        "test drives inside it": inside["followed"],
        "corridor |e_y| on drives of the class [m]": f"{corridor['corridor_m']:.3f}",
        "of it W; tube around the copy, `followed` [m]": f"{bounds['nominal']:.3f}; {bounds['followed_position']:.3f}",
        "tube around the copy, `for_ever` [m]": f"{bounds['for_ever_position']:.3f}",
        "fresh drives of the class inside": counted(corridor),
        "S3 drives of 60 s inside, never calibrated on": counted(s3),
        "drives of the class by the package's functions inside": counted(package),
        "of these with |e_y| within the corridor": f"{package['inside_corridor']} of {package['coverage_drives']}",
        "their largest |e_y|; |e_y − ê_y| [m]": f"{package['lateral_m']:.3f}; {package['distance_m']:.3f}",
        f"one step beside the package's, largest of {step['steps']}: position [m]; v [m/s]": (
            f"{max(separate['p_x'], separate['p_y']):.0e}; {separate['v']:.0e}"
        ),
        "certify everything [s]": f"{certificate['seconds']:.0f}",
    }
    return table(
        ["single-track drift, along a path", ""], list(map(list, lines.items()))
    )


def adaptive():
    """Lateral RMSE in the second half of a minute, and its ratio to nominal-MPPI."""
    document = json.loads(
        (ROOT / "experiments" / "commonroad" / "adaptive.json").read_text()
    )
    heads, lines = ["after 30 s [mm] (over nominal)"], {}
    for car, rows in document["cars"].items():
        heads += [
            f"{CARS[f'commonroad_{car}']}, {friction}"
            for friction in document["protocol"]["frictions"]
        ]
        nominal = _means(rows["nominal"])
        for row, found in rows.items():
            entries = [
                f"{mean:.1f} ({mean / best:.2f})"
                for mean, best in zip(_means(found), nominal, strict=True)
            ]
            lines.setdefault(row, [row]).extend(entries)
    return table(heads, list(lines.values()))


def _means(found):
    """Over the paths of a friction."""
    return [sum(paths) / len(paths) for paths in found["after_mm"]]


def counted(result):
    """Drives inside of how many, with the interval of the share."""
    low, high = result["coverage_ci95"]
    return f"{within(result['coverage'], result['coverage_drives'])} ({low:.3f} to {high:.3f})"


def within(share, drives):
    """A share as a count."""
    return f"{round(share * drives)} of {drives}"


TABLES = {
    "deviations": deviations,
    "ratios": ratios,
    "handling": handling,
    "tuning": tuning,
    "export": export,
    "along path": along_path,
    "adaptive": adaptive,
}


def draw():
    """Lateral RMSE over friction, one panel a car, where all paths were driven in the
    lane.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.9, 3.4), layout="constrained")
    panels = figure.subplots(1, len(CARS), sharey=True)
    for axes, (car, words) in zip(panels, CARS.items(), strict=True):
        for name, (label, colour, line) in SYSTEMS.items():
            mine = [
                row
                for row in results()["rows"]
                if (row["system"], row["vehicle"]) == (name, car)
            ]
            sound = [row for row in mine if not row["departures"]]
            points = (
                [row["friction"] for row in sound],
                [1e3 * row["rmse_m"]["mean"] for row in sound],
            )
            if not sound:
                continue
            axes.plot(
                *points,
                color=colour,
                linestyle=line,
                marker="o",
                markersize=4,
                label=label,
            )
        axes.set(title=words, xlabel="friction", xticks=(0.3, 0.6, 0.9), yscale="log")
        axes.grid(visible=True, which="both", color="#e3e6ea", linewidth=0.6)
    panels[0].set_ylabel("lateral RMSE [mm]")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=3,
        fontsize=8,
        frameon=False,
    )
    FIGURE.parent.mkdir(exist_ok=True)
    figure.savefig(FIGURE, dpi=150, metadata={"Software": None})


def main():
    """Parse, print or write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="put the tables into docs/results/other-cars.md and draw its figure",
    )
    made = {name: build() for name, build in TABLES.items()}
    if not parser.parse_args().write:
        print("\n\n".join(made.values()))
        return
    put(ROOT / "docs" / "results" / "other-cars.md", made)
    draw()


if __name__ == "__main__":
    main()
