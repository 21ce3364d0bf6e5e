"""Tables of numbers on the pages, from committed results.

python -m benchmarks.pages    writes every block `<!-- NAME -->` … `<!-- end -->` again
"""

import json
import re
from pathlib import Path

import numpy as np

from experiments import results
from experiments.results import markdown as table
from experiments.simulator import PREFIXES

ROOT = Path(__file__).parents[1]
PRETRAINED = ROOT / "src" / "sfkd_jax" / "pretrained"
CARS = ("dynamic", "kinematic")


def filled(page, made):
    """A page with tables between <!-- NAME --> and the next <!-- end -->.

    Raises:
        SystemExit: a table has no place in the page, or several.
    """
    for name, text in made.items():
        pattern = re.compile(rf"<!-- {name} -->\n.*?<!-- end -->", re.DOTALL)
        place = f"<!-- {name} -->\n{text}\n<!-- end -->"
        page, count = pattern.subn(lambda _, place=place: place, page)
        if count != 1:
            raise SystemExit(f"{count} places for the table {name!r}, not 1")
    return page


def read(name):
    """A committed JSON document."""
    return json.loads((ROOT / name).read_text("utf-8"))


LAWS = ("law", "law_plant", "law_nominal")
"""The law that ships, and those of the true car and of the textbook bicycle."""


def corridor():
    """The certificates of the shipped policies and of a foreign car, and how they drive."""
    certificates = [read(PRETRAINED / f"{car}_path/certificate.json") for car in CARS]
    rows = read("experiments/corridor.json")["rows"]
    rows = [row for row in rows if row["scenario"] == "s3"]

    def error(car, system, digits=1):
        row = next(r for r in rows if (r["vehicle"], r["row"]) == (car, system))
        if row["left_the_lane"]:
            return "leaves the lane"
        return f"{np.mean(row['rmse_mm']):.{digits}f}"

    other = read("experiments/simulator.json")
    about = [*(document["corridor"] for document in certificates), other]
    rates = (one["outputs"]["position"]["alpha"] for one in certificates)
    inside = ((one["coverage"], *one["coverage_ci95"]) for one in about)
    lines = [
        [
            "**corridor: bound on the distance from the path [m]**",
            *(f"**{one['corridor_m']:.3f}**" for one in about),
        ],
        [
            "share of fresh runs inside, with its 95 % interval",
            *("{:.3f} ({:.3f} to {:.3f})".format(*one) for one in inside),
        ],
        [
            "share of S3 runs inside, never calibrated on",
            *(f"{one['by_scenario']['s3']['coverage']:.3f}" for one in about[:-1]),
            f"{other['coverage_s3']:.3f}",
        ],
        [
            "contraction rate, proved (metric of the distance)",
            *(f"{rate:.3f}" for rate in [*rates, other["alpha"]]),
        ],
        [
            "S3, lateral RMSE [mm]; of a planner that knows the car",
            *(f"{error(car, 'sfkd')}; {error(car, 'oracle')}" for car in CARS),
            f"{other['rmse_mm']:.1f}; –",
        ],
        [
            "the same: MPPI with the textbook bicycle; Stanley; pure pursuit",
            *("; ".join(error(car, name, 0) for name in PREFIXES) for car in CARS),
            "; ".join(f"{other[f'{name}rmse_mm']:.0f}" for name in PREFIXES.values()),
        ],
        [
            "the law alone: of the learned model; of the true car; of the bicycle [mm]",
            *("; ".join(error(car, law) for law in LAWS) for car in CARS),
            "–",
        ],
    ]
    return table(["", *CARS, "[highway-env](docs/your-vehicle.md)"], lines)


def measured():
    """What `benchmarks.recovery` found: (car, row) -> numbers."""
    rows = read("benchmarks/recovery.json")["rows"]
    return {(row["car"], row["row"]): row for row in rows}


def shield():
    """Hostile planners inside the filter, and without it."""
    rows = measured()

    def cells(car, kind):
        kept = rows[car, f"planner {kind}: guard"]
        free = rows[car, f"planner {kind}: bare"]["left_the_lane"]
        return [
            f"{free} of {kept['runs']} → {kept['left_the_lane']}",
            f"{kept['largest_m']:.3f} m, {100 * kept['inside']:.1f} %",
        ]

    head, inside = ["planner"], "largest distance, runs inside"
    for car in CARS:
        head += [f"{car}: left the lane, without → with", inside]
    kinds = ("worst", "bang-bang", "random", "NaN", "full lock")
    return table(
        head,
        [[kind, *cells("dynamic", kind), *cells("kinematic", kind)] for kind in kinds],
    )


def recovery():
    """Starts, wrong measurements and stops outside the box."""
    rows = measured()

    def starts(car, name):
        new, old = (
            rows[car, f"{name}: {way}"]
            for way in ("planner in the guard", "law of the box")
        )
        return f"{old['back']} → {new['back']} of {new['runs']}"

    def faults(car, length, *kinds):
        found = [rows[car, f"{kind}, {length}"] for kind in kinds]
        gone, runs, back = (
            sum(row[name] for row in found) for name in ("departures", "runs", "back")
        )
        largest = max(row["largest_m"] or np.inf for row in found)
        return f"{largest:.2f} m; {gone} of {runs}; {back}"

    def stop(car, friction):
        kept, bare = (
            rows[car, f"brake, friction {friction}: {way}"] for way in ("guard", "bare")
        )
        return f"{kept['longest_m']:.1f}; {bare['longest_m']:.1f}"

    def beyond(car):
        # What no sensor contradicts, and what claims nothing.
        unseen = ("position bias", "drift", "yaw bias", ": bare")
        counted = [
            row
            for (whose, name), row in rows.items()
            if whose == car and "steps" in row and not any(w in name for w in unseen)
        ]
        counts = (sum(row[n] for row in counted) for n in ("beyond_claim", "steps"))
        return "{:,} of {:,}".format(*counts)

    def flagged(car):
        row = rows[car, "class"]
        return f"{row['runs_not_healthy']} of {row['runs']}; {1 - row['healthy']:.2%}"

    def found(car, way):
        row = rows[car, f"steering offset 1.0 degrees, {way}"]
        return f"{row['within_3s']:.1%}; {row['s_99'] or '–'} s"

    jumps, silent = ("jump", "alternating", "yaw"), ("frozen", "late", "lost")
    brief = faults, "brief"
    cells = {
        "starts that come back, law of the box alone → policy": (starts, "grid"),
        "the same, random to 20 m, any yaw, S3 roads": (starts, "random starts"),
        "pose jumps to 2 s: largest distance; departures; back": (*brief, *jumps),
        "frozen, late, lost to 2 s": (*brief, *silent),
        "either, for 5 s": (faults, "5 s", *jumps, *silent),
        "full braking from 10 m/s, friction 0.7 [m]; unfiltered": (stop, 0.7),
        "the same, friction 0.3": (stop, 0.3),
        "steering 1° off: found in 3 s; 99 % found after": (found, "law"),
        "the same, ν of the class": (found, "class"),
        "steps beyond the distance that `info` claims": (beyond,),
        "runs under the conditions with a flag; steps": (flagged,),
    }
    lines = [
        [name, *(cell(car, *about) for car in CARS)]
        for name, (cell, *about) in cells.items()
    ]
    return table(["outside the box", *CARS], lines)


def timing():
    """A control step of the dynamic car by samples, horizon and vehicles."""
    devices = read("benchmarks/device.json")["devices"]
    policies = [about["policies"]["dynamic_path"] for about in devices.values()]

    def case(step):
        cars = f", {step['vehicles']} cars, {step['at_once']} at once"
        return f"{step['samples']}×{step['horizon']}{cars * (step['vehicles'] > 1)}"

    def size(step):
        vehicles = step["vehicles"], step["at_once"]
        return *vehicles, step["horizon"] != 20, step["samples"], step["horizon"]

    every, lines = [sorted(one["control_step"], key=size) for one in policies], []
    for each in zip(*every, strict=True):
        sizes = each[0]["samples"], each[0]["horizon"], each[0]["vehicles"]
        if not {64, 1024, 4096, 10, 50, 16} & {*sizes}:
            took = (one["median_ms"] for one in each)
            times = (f"{ms:.{1 if ms > 1 else 2}f}" for ms in took)
            lines.append([case(each[0]), *times, f"{each[-1]['memory_mib']:.1f}"])
    many = [f"{one['s3']['steps_per_s']:.0f}" for one in policies]
    lines.append(["simulated steps per second, many episodes", *many, ""])
    return table(["samples×steps; ms a car", *devices, "memory [MiB]"], lines)


def planners():
    """Time and error of planners around one law, on the same roads."""
    policies = read("benchmarks/device.json")["devices"]["cpu"]["policies"]
    every = (policies[f"{car}_path"]["planners"] for car in CARS)

    def error(row):
        return f"{row['over_law']:.2f}±{row['standard_error']:.2f}"

    lines = [
        [rows[0]["planner"], f"{rows[0]['median_ms']:.1f}", *map(error, rows)]
        for rows in zip(*every, strict=True)
    ]
    return table(["planner", "[ms]", "dynamic, S3", "kinematic, S2"], lines)


def adaptation():
    """Errors with causes that nobody measures, dynamic car."""
    rows = read("benchmarks/adaptation.json")["rows"]
    errors = {
        (row["car"], row["case"], row["row"]): np.mean(row["rmse_mm"]) for row in rows
    }
    kinds = (
        "force, 3 s",
        "mass + 30 %",
        "stiffness - 30 %",
        "steering + 1 degree",
        "nothing, S3",
    )
    systems = ("oracle that knows", "SFKD", "SFKD, adaptive")

    def cell(car, kind):
        return "; ".join(f"{errors[car, kind, name]:.1f}" for name in systems)

    head = ["lateral RMSE [mm]: knows the cause; SFKD; SFKD, adaptive", *CARS]
    return table(head, [[kind, *(cell(car, kind) for car in CARS)] for kind in kinds])


def peers():
    """One control step beside other libraries, on one problem."""
    rows = read("benchmarks/timing.json")["rows"]
    ours = rows[0]["best_ms"]
    return table(
        ["1500 samples x 20 steps, two cores", "best [ms]", "over ours"],
        [
            [row["contender"], f"{row['best_ms']:.1f}", f"{row['best_ms'] / ours:.2f}"]
            for row in rows
        ],
    )


def wide():
    """What the certificates of the policies for lanes say."""
    about = [
        read(PRETRAINED / f"{car}_path/certificate.json")["corridor"] for car in CARS
    ]
    lines = [
        ["corridor [m]", *(f"{one['corridor_m']:.3f}" for one in about)],
        *(
            [
                f"fresh runs inside: {group.replace('_', ' ')}",
                *(f"{one['by_group'][group]['coverage']:.3f}" for one in about),
            ]
            for group in about[0]["by_group"]
        ),
        ["S3", *(f"{one['by_scenario']['s3']['coverage']:.3f}" for one in about)],
    ]
    return table(["", *CARS], lines)


def lane():
    """Obstacles that are seen late: what each system hits, and how fast it is."""
    rows = [row for row in read("benchmarks/lane.json") if "collisions" in row]
    found = {(row["car"], row["system"], row["row"]): row for row in rows}
    columns = list(dict.fromkeys((row["car"], row["system"]) for row in rows))

    def cell(car, system, label):
        row = found.get((car, system, label))
        return row and f"{row['collisions']}/{row['runs']}, {row['mean_speed']:.1f}"

    head = ["runs with a collision, mean speed [m/s]", *map(": ".join, columns)]
    labels = dict.fromkeys(label for _, _, label in found)
    lines = [
        [one, *(cell(*column, one) or "–" for column in columns)] for one in labels
    ]
    return table(head, lines)


def lane_time():
    """Milliseconds of a control step in a lane."""
    rows = [row for row in read("benchmarks/lane.json") if "step_ms" in row]
    cells = [
        [f"{row['car']}, {row['row']}", row["search_ms"], row["step_ms"]]
        for row in rows
    ]
    return table(["[ms]", "search", "whole step"], cells)


BLOCKS = {
    "README.md": {"corridor": corridor},
    "docs/corridor.md": {"wide": wide, "shield": shield, "recovery": recovery},
    "docs/lane.md": {"lane": lane, "lane_time": lane_time},
    "docs/planner.md": {"timing": timing, "planners": planners},
    "docs/adaptation.md": {"adaptation": adaptation},
    "docs/results.md": results.TABLES | {"peers": peers},
}


def written():
    """Pages with their blocks as the results say: path -> text."""
    return {
        ROOT / name: filled(
            (ROOT / name).read_text("utf-8"),
            {mark: build() for mark, build in blocks.items()},
        )
        for name, blocks in BLOCKS.items()
    }


if __name__ == "__main__":
    for path, text in written().items():
        path.write_text(text, "utf-8")
