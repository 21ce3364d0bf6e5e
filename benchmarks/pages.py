"""Tables of numbers on the pages, from committed results.

python -m benchmarks.pages    writes every block `<!-- NAME -->` … `<!-- end -->` again
"""

import json
import re

import numpy as np

from benchmarks import PRETRAINED, ROOT, is_old
from benchmarks.tables import Measured, measured, table
from experiments import results
from experiments.simulator import LAW, PREFIXES
from sfkd_jax import certificate, store
from sfkd_jax.driving.certificate import DrivingCertificate

CARS = ("dynamic", "kinematic")
NONE = "–"
"""What a table says where nothing was measured."""


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


def captioned(parts):
    """Several tables in one block: caption -> table."""
    return "\n\n".join(f"**{caption}**\n\n{made}" for caption, made in parts.items())


def policy_of(car):
    """The policy along a path that ships for a car."""
    return f"{car}_path"


def by_car(text, found):
    """The entries of a row that has a column a car: car -> its committed row."""
    return [
        measured(text(found[car]), found[car], policy=policy_of(car)) for car in CARS
    ]


# ---- the corridor


def shipped():
    """(corridor, proved rate, whether it is of other weights) of every car's policy."""
    for car in CARS:
        folder = PRETRAINED / policy_of(car)
        claimed = certificate.read(folder / "certificate.json", DrivingCertificate)
        _, manifest = store.read_arrays(folder / "policy.safetensors", kind="policy")
        old = claimed.provenance.policy_sha256 != manifest["content_sha256"]
        yield claimed.corridor, claimed.proof.outputs["position"].alpha, old


def claims():
    """What is claimed of every car's corridor: a list of (numbers by name, whether old).

    The shipped policies come first, whose certificates are bound to the weights, and then
    the cars of `FOREIGN`.
    """
    found = []
    for about, alpha, old in shipped():
        numbers = {
            "corridor_m": about.corridor_m,
            "coverage": about.coverage.share,
            "coverage_ci95": about.coverage.ci95,
            "coverage_s3": about.by_scenario["s3"].share,
            "alpha": alpha,
        }
        for group, counted in about.by_group.items():
            numbers[f"coverage_{group}"] = counted.coverage.share
        found.append((numbers, old))
    for foreign in foreign_lines():
        found.append((foreign, is_old(foreign)))
    for numbers, _ in found:
        numbers["lower"], numbers["upper"] = numbers["coverage_ci95"]
    return found


def claimed(lines):
    """Lines with a column a car, from (name of the line, name of the number, format)."""
    columns = claims()
    return [
        [
            name,
            *(
                Measured(form.format(numbers[number]), old)
                if number in numbers
                else NONE
                for numbers, old in columns
            ),
        ]
        for name, number, form in lines
    ]


RIVALS = {
    "sfkd": "this policy",
    "oracle": "a planner that knows the true car",
    "nominal": "MPPI with the textbook bicycle",
    "law_stanley": "Stanley's law",
    "law": "the law alone",
}
"""Row of corridor.json -> who drives, on the first page."""
SAME_ROW = {"sfkd": "", "law": LAW} | PREFIXES
"""Row of corridor.json -> prefix of the same in the line of a car of `FOREIGN`."""
FOREIGN = {"highway-env": "simulator", "slipx, 1/10": "slipx"}
"""Cars that nobody here wrote -> file of their line."""


def foreign_lines():
    """What was found of the cars that nobody here wrote."""
    return [read(f"experiments/{file}.json") for file in FOREIGN.values()]


def of_every_car(page):
    """The heads of a table with a column a car, from the folder of the page."""
    return ["", *CARS, *(f"[{name}]({page})" for name in FOREIGN)]


def corridor():
    """The first page: corridors of two shipped policies and of foreign cars; S3."""
    lines = claimed(
        [
            ("corridor half width [m]", "corridor_m", "{:.3f}"),
            ("share of fresh runs inside", "coverage", "{:.2f}"),
            ("contraction rate (proved)", "alpha", "{:.2f}"),
        ]
    )
    driven = {
        (row["vehicle"], row["row"]): row
        for row in read("experiments/corridor.json")["rows"]
        if row["scenario"] == "s3"
    }
    for system, name in RIVALS.items():
        rows = {car: driven[car, system] for car in CARS}
        line = [f"S3, lateral RMSE of {name} [mm]", *by_car(mean_error, rows)]
        line += [foreign_error(system, found) for found in foreign_lines()]
        lines.append(line)
    return table(of_every_car("docs/your-vehicle.md"), lines)


def foreign_error(system, found):
    """Mean error of a system on a car of `FOREIGN`, if it drove there."""
    prefix = SAME_ROW.get(system)
    error = found.get(f"{prefix}rmse_mm")
    if error is None:
        return NONE
    return measured(in_millimetres(error, found[f"{prefix}departures"]), found)


def mean_error(row):
    """Mean over the runs of a row of corridor.json."""
    return in_millimetres(np.mean(row["rmse_mm"]), row["left_the_lane"])


def in_millimetres(error, left_the_lane):
    """An error as people read it, or how many runs left the lane."""
    if left_the_lane:
        return f"{left_the_lane} runs leave the lane"
    return f"{error:.1f}" if error < 20.0 else f"{error:.0f}"


def wide():
    """What the certificates claim, and the same of the foreign cars."""
    inside = "share of fresh runs inside"
    lines = claimed(
        [
            ("corridor half width [m]", "corridor_m", "{:.3f}"),
            (f"{inside}, worst group of drives", "coverage", "{:.3f}"),
            ("lower end of its 95 % interval", "lower", "{:.3f}"),
            ("upper end of its 95 % interval", "upper", "{:.3f}"),
            (f"{inside}: bends", "coverage_bends", "{:.3f}"),
            (f"{inside}: changing speeds", "coverage_speeds", "{:.3f}"),
            (f"{inside}: lane changes", "coverage_lane_changes", "{:.3f}"),
            ("share of S3 runs inside, never calibrated on", "coverage_s3", "{:.3f}"),
            ("contraction rate (proved)", "alpha", "{:.3f}"),
        ]
    )
    return table(of_every_car("your-vehicle.md"), lines)


# ---- outside the box


def recovery_rows():
    """What `benchmarks.recovery` found: (car, row) -> numbers."""
    rows = read("benchmarks/recovery.json")["rows"]
    return {(row["car"], row["row"]): row for row in rows}


HOSTILE = {
    "worst": "pushes outwards with the whole ν",
    "bang-bang": "switches ν between its limits",
    "random": "draws a limit of ν at every step",
    "NaN": "asks for NaN",
    "full lock": "asks for full lock",
}
"""Row of recovery.json -> what a hostile planner does."""


def shield():
    """Hostile planners inside the shield, and without it."""
    found = recovery_rows()
    lines = []
    for car in CARS:
        for kind, does in HOSTILE.items():
            kept = found[car, f"planner {kind}: guard"]
            free = found[car, f"planner {kind}: bare"]
            numbers = [
                (str(kept["runs"]), kept),
                (str(free["left_the_lane"]), free),
                (str(kept["left_the_lane"]), kept),
                (f"{kept['largest_m']:.3f}", kept),
                (f"{100 * kept['inside']:.1f}", kept),
            ]
            cells = (measured(*one, policy=policy_of(car)) for one in numbers)
            lines.append([f"{car}: {does}", *cells])
    heads = [
        "planner",
        "runs",
        "leave the lane without the shield",
        "leave the lane with it",
        "largest distance with it [m]",
        "stay in the corridor with it [%]",
    ]
    return table(heads, lines)


def recovery():
    """Starts, wrong measurements, stops and alarms outside the box."""
    found = recovery_rows()
    tables = {
        "Starts outside the box: how many of 420 runs are back after 20 s": starts,
        "Wrong measurements on S3, 180 runs a row and car": faults,
        "Full braking from 10 m/s: the longest way to a stand [m]": stops,
        "A steering angle that is 1° off from some moment on": detection,
        "What `info` says": alarms,
    }
    return captioned({caption: made(found) for caption, made in tables.items()})


def starts(found):
    """Who comes back to the path."""
    places = {
        "grid": "grid beside a straight road, to 20 m and any heading",
        "random starts": "at random beside an S3 road, to 20 m and any heading",
    }
    drivers = {
        "law of the box": "the law of the box alone",
        "planner in the guard": "the policy",
    }
    lines = []
    for place, where in places.items():
        for driver, who in drivers.items():
            rows = {car: found[car, f"{place}: {driver}"] for car in CARS}
            assert {row["runs"] for row in rows.values()} == {420}
            lines.append([f"{where}: {who}", *by_car(lambda of: str(of["back"]), rows)])
    return table(["start", *CARS], lines)


POSE = "jump", "alternating", "yaw"
SILENT = "frozen", "late", "lost"
WRONG = {
    "pose off for up to 2 s (a jump, every other reading, or the yaw)": ("brief", POSE),
    "readings frozen or late for up to 1 s, or lost for up to 2 s": ("brief", SILENT),
    "pose off for 5 s (a jump, every other reading, or the yaw)": ("5 s", POSE),
    "readings frozen, late or lost for 5 s": ("5 s", SILENT),
}
"""Fault -> rows of recovery.json that have it."""


def faults(found):
    """What a fault of the sensors does to a run."""
    heads, lines = ["fault"], [[name] for name in WRONG]
    for car in CARS:
        heads += [
            f"{car}: largest distance [m]",
            f"{car}: runs over 2 m away",
            f"{car}: runs back at the end",
        ]
        for line, (length, kinds) in zip(lines, WRONG.values(), strict=True):
            rows = [found[car, f"{kind}, {length}"] for kind in kinds]
            assert sum(row["runs"] for row in rows) == 180
            largest = max(row["largest_m"] or np.inf for row in rows)
            texts = (
                f"{largest:.2f}",
                str(sum(row["departures"] for row in rows)),
                str(sum(row["back"] for row in rows)),
            )
            line += [measured(text, *rows, policy=policy_of(car)) for text in texts]
    return table(heads, lines)


def stops(found):
    """How far a car rolls that is asked to brake."""
    drivers = {"guard": "in the shield", "bare": "without it"}
    lines = []
    for friction in (0.7, 0.3):
        for driver, where in drivers.items():
            rows = {
                car: found[car, f"brake, friction {friction}: {driver}"] for car in CARS
            }
            longest = by_car(lambda of: f"{of['longest_m']:.1f}", rows)
            lines.append([f"friction {friction}, {where}", *longest])
    return table(["way to a stand [m]", *CARS], lines)


def detection(found):
    """When an offset of the steering is found."""
    drivers = {
        "law": "while the law drives",
        "class": "while the law drives with the ν of the class",
    }
    lines = []
    for driver, when in drivers.items():
        rows = {
            car: found[car, f"steering offset 1.0 degrees, {driver}"] for car in CARS
        }
        within = by_car(lambda of: f"{100 * of['within_3s']:.1f}", rows)
        late = by_car(lambda of: f"{of['s_99']:.1f}", rows)
        lines.append([f"found within 3 s {when} [% of runs]", *within])
        lines.append([f"time in which 99 % are found {when} [s]", *late])
    return table(["offset of 1°", *CARS], lines)


UNSEEN = "position bias", "drift", "yaw bias"
"""Errors that no sensor contradicts."""


def alarms(found):
    """How often a car is farther away than claimed, and how often alarms are false."""
    counted = {
        car: [
            row
            for (whose, name), row in found.items()
            if whose == car
            and "steps" in row
            and not any(one in name for one in UNSEEN)
        ]
        for car in CARS
    }
    quiet = {car: found[car, "class"] for car in CARS}
    lines = [
        [
            name,
            *(
                measured(
                    f"{sum(row[field] for row in rows):,}", *rows, policy=policy_of(car)
                )
                for car, rows in counted.items()
            ),
        ]
        for name, field in {
            "steps of all runs in the shield, but for those with a bias or drift": "steps",
            "of them: steps farther away than `info` claims": "beyond_claim",
        }.items()
    ]
    lines += [
        [
            "runs under the conditions of the certificate",
            *by_car(lambda of: str(of["runs"]), quiet),
        ],
        [
            "of them: runs with an alarm, which is false",
            *by_car(lambda of: str(of["runs_not_healthy"]), quiet),
        ],
    ]
    return table(["", *CARS], lines)


# ---- planners


def timing():
    """A control step of the dynamic car by samples, horizon and vehicles."""
    devices = read("benchmarks/device.json")["devices"]
    policy = policy_of("dynamic")
    found = {name: about["policies"][policy] for name, about in devices.items()}
    names = ["CPU" if name == "cpu" else name for name in found]

    def case(step):
        text = f"{step['samples']} samples × {step['horizon']} steps"
        if step["vehicles"] > 1:
            text += f", {step['vehicles']} cars in batches of {step['at_once']}"
        return text

    def size(step):
        return (
            step["vehicles"],
            step["at_once"],
            step["horizon"] != 20,
            step["samples"],
            step["horizon"],
        )

    def is_shown(step):
        left_out = {64, 1024, 4096, 10, 50, 16}
        return not left_out & {step["samples"], step["horizon"], step["vehicles"]}

    steps = [sorted(one["control_step"], key=size) for one in found.values()]
    lines = []
    for same in zip(*steps, strict=True):
        if is_shown(same[0]):
            times = [step["median_ms"] for step in same]
            texts = [f"{ms:.1f}" if ms > 1.0 else f"{ms:.2f}" for ms in times]
            cells = [
                measured(text, step, policy=policy)
                for text, step in zip(texts, same, strict=True)
            ]
            memory = measured(f"{same[-1]['memory_mib']:.1f}", same[-1], policy=policy)
            lines.append([case(same[0]), *cells, memory])
    heads = [
        "control step of one car",
        *(f"{name} [ms]" for name in names),
        "memory [MiB]",
    ]
    many = [
        measured(f"{one['s3']['steps_per_s']:.0f}", one["s3"], policy=policy)
        for one in found.values()
    ]
    episodes = ["simulated steps per second", *many]
    return "\n\n".join(
        [table(heads, lines), table(["many episodes at once", *names], [episodes])]
    )


def planners():
    """Time and error of planners around one law, on the same roads."""
    policies = read("benchmarks/device.json")["devices"]["cpu"]["policies"]
    every = [policies[policy_of(car)]["planners"] for car in CARS]
    lines = []
    for rows in zip(*every, strict=True):
        first = rows[0]
        line = [
            first["planner"],
            measured(f"{first['median_ms']:.1f}", first, policy=policy_of(CARS[0])),
        ]
        for car, row in zip(CARS, rows, strict=True):
            for number in (row["over_law"], row["standard_error"]):
                line.append(measured(f"{number:.2f}", row, policy=policy_of(car)))
        lines.append(line)
    heads = ["planner", "step [ms]"]
    for place in ("dynamic, S3", "kinematic, S2"):
        heads += [f"{place}: error over the law's", "its standard error"]
    return table(heads, lines)


CAUSES = {
    "force, 3 s": "side force up to 1 kN, another every 3 s",
    "mass + 30 %": "mass + 30 %",
    "stiffness - 30 %": "tyre stiffness − 30 %",
    "steering + 1 degree": "steering angle + 1°",
    "nothing, S3": "none",
}
"""Case of adaptation.json -> what nobody measures."""
KNOWING = {
    "oracle that knows": "knows the cause",
    "SFKD": "SFKD",
    "SFKD, adaptive": "SFKD, adapting",
}
"""Row of adaptation.json -> who drives."""


def adaptation():
    """Errors on S3 with causes that nobody measures."""
    found = {
        (row["car"], row["case"], row["row"]): row
        for row in read("benchmarks/adaptation.json")["rows"]
    }
    heads = ["unmeasured cause; lateral RMSE [mm]"]
    heads += [f"{car}: {who}" for car in CARS for who in KNOWING.values()]
    lines = []
    for case, cause in CAUSES.items():
        line = [cause]
        for car in CARS:
            rows = [found[car, case, system] for system in KNOWING]
            line += [
                measured(f"{np.mean(row['rmse_mm']):.1f}", row, policy=policy_of(car))
                for row in rows
            ]
        lines.append(line)
    return table(heads, lines)


def peers():
    """One control step beside other libraries, on one problem."""
    document = read("benchmarks/timing.json")
    rows = document["rows"]
    ours = rows[0]["best_ms"]
    lines = [
        [
            row["contender"],
            measured(f"{row['best_ms']:.1f}", document),
            measured(f"{row['best_ms'] / ours:.2f}", document),
        ]
        for row in rows
    ]
    return table(
        ["1500 samples x 20 steps, two cores", "best [ms]", "over ours"], lines
    )


def foreign_cars():
    """Errors on CommonRoad's cars over those of MPPI with the textbook bicycle."""
    found = {
        (row["row"], row["car"], row["friction"]): row
        for row in read("experiments/commonroad.json")["rows"]
    }
    drivers = {"SFKD": "the policy", "SFKD, adaptive": "the policy, adapting"}
    places = list(dict.fromkeys((car, friction) for _, car, friction in found))
    lines = []
    for system, who in drivers.items():
        line = [who]
        for place in places:
            rows = found[system, *place], found["nominal", *place]
            error, of_bicycle = (np.mean(row["second_half_mm"]) for row in rows)
            ratio = f"{error / of_bicycle:.2f}"
            line.append(measured(ratio, *rows, policy=policy_of("dynamic")))
        lines.append(line)
    cars = {"std": "drift car", "mb": "multi-body car"}
    heads = [f"{cars[car]}, friction {friction}" for car, friction in places]
    return table(["error over that of MPPI with the bicycle", *heads], lines)


# ---- systems that are no cars


def systems():
    """Systems of the examples, each in its own unit: a line a system."""
    heads = ["proved rate", "tube", "whole bound", "coverage [%]"]
    heads += ["RMSE over that of the oracle", "RMSE of nominal over ours"]
    lines = []
    for row in read("experiments/systems.json"):
        name = _name_of_system(row)
        if "refused" in row:
            lines.append([name, measured("refused", row), *[""] * (len(heads) - 1)])
            continue
        output, tube = next(iter(row["tube"].items()))
        unit = row["unit"][output]
        entries = [
            f"{row['alpha']:.2f}",
            f"{tube:.2g} {unit}",
            f"{row['total'][output]:.2g} {unit}",
            f"{100 * row['coverage']:.0f}",
            f"{row['rmse'] / row['rmse_oracle']:.2f}",
            f"{row['rmse_nominal'] / row['rmse']:.1f}",
        ]
        cells = [measured(entry, row) for entry in entries]
        lines.append([f"{name}, {output}", *cells])
    return table(["system, output", *heads], lines)


def starts_of_systems():
    """How many of the starts of a publication come back, a line a system."""
    lines = []
    for row in read("experiments/systems.json"):
        if "back" in row:
            share = f"{100 * row['back']:.0f}"
            lines.append([_name_of_system(row), measured(share, row)])
    return table(["system", "starts that come back [%]"], lines)


def _name_of_system(row):
    """Name of a system as the pages have it."""
    return row["system"].replace("c3m/", "C3M: ").replace("_", " ")


# ---- latency


def by_case(name, texts):
    """A table of a benchmark with rows of cars and cases, a line a case.

    Args:
        name: of the benchmark, whose first case has nothing wrong.
        texts: heading -> (row, row of the first case of this car) -> its number.
    """
    rows = read(f"benchmarks/{name}.json")["rows"]
    found = {(row["car"], row["case"]): row for row in rows}
    first, *_ = cases = list(dict.fromkeys(row["case"] for row in rows))
    lines = []
    for case in cases:
        line = [case]
        for car in CARS:
            row = found[car, case]
            line += [
                measured(text(row, found[car, first]), row, policy=policy_of(car))
                for text in texts.values()
            ]
        lines.append(line)
    heads = [f"{car}: {heading}" for car in CARS for heading in texts]
    return table(["what is late or wrong", *heads], lines)


def latency():
    """Errors on S3 with latency, over those without."""
    return by_case(
        "latency",
        {
            "RMSE [mm]": lambda row, _: f"{row['rmse_mm']:.1f}",
            "over that on time": lambda row, on_time: (
                f"{row['rmse_mm'] / on_time['rmse_mm']:.2f}"
            ),
            "runs that leave the road": lambda row, _: f"{row['departures']}",
        },
    )


def latency_claims():
    """What is claimed on S3 with latency, and how long it takes to find it."""
    return by_case(
        "latency",
        {
            "claimed [%]": lambda row, _: f"{100 * row['claimed']:.0f}",
            "steps beyond a claim": lambda row, _: f"{row['beyond_claim']}",
            "with a wrong latency [s]": lambda row, _: f"{row['wrong_latency_s']:.1f}",
        },
    )


def late_corridors():
    """The corridors of the policies that ship on vehicles that are later."""
    found = [(corridor, old) for corridor, _, old in shipped()]
    lines = []
    for late in ("sensors", "controls"):
        of_cars = [getattr(corridor, f"late_{late}") for corridor, _ in found]
        for rows in zip(*of_cars, strict=True):
            line = [f"{late} {rows[0].later_s:g} s later"]
            for row, (corridor, old) in zip(rows, found, strict=True):
                ratio = row.corridor_m / corridor.corridor_m
                kept = 100 * row.coverage.share
                texts = (f"{row.corridor_m:.3f}", f"{ratio:.2f}", f"{kept:.1f}")
                line += [Measured(text, old) for text in texts]
            lines.append(line)
    heads = ("corridor [m]", "over that on time", "coverage [%]")
    return table(
        ["what is late", *(f"{car}: {head}" for car in CARS for head in heads)], lines
    )


def sensors():
    """What wrong sensors and other references do, on S3."""
    return by_case(
        "sensors",
        {
            "runs that leave the road": lambda row, _: f"{row['departures']}",
            "largest distance [m]": lambda row, _: f"{row['largest_m']:.3f}",
            "steps beyond a claim": lambda row, _: f"{row['beyond_claim']}",
        },
    )


def margins():
    """The margins of the laws that ship, at some speeds."""
    found = [(corridor.margins, old) for corridor, _, old in shipped()]
    speeds = found[0][0].speed
    lines = []
    for index in range(0, len(speeds), 3):
        line = [f"{speeds[index]:g}"]
        line += [Measured(f"{of.delay_s[index]:.2f}", old) for of, old in found]
        lines.append(line)
    return table(["speed [m/s]", *(f"{car}: delay [s]" for car in CARS)], lines)


# ---- lanes

DRIVERS = {
    "lane": "the policy in its lane",
    "lane, reversing": "the same in a car that reverses",
    "oracle": "MPPI that knows the car",
    "oracle in the guard": "MPPI that knows the car, in the shield",
}
"""System of lane.json -> who drives."""
SITUATIONS = {
    "pedestrian, friction 0.9": "pedestrian, friction 0.9",
    "pedestrian, friction 0.3": "pedestrian, friction 0.3",
    "random courses": "obstacles at random",
    "enemy": "obstacles placed by a search",
}
"""Row of lane.json -> what happens."""


def lane():
    """Obstacles that are seen late: what each system hits, and how fast it is."""
    rows = [row for row in read("benchmarks/lane.json") if "collisions" in row]
    situations = list(SITUATIONS)
    drivers = list(DRIVERS)

    def order(row):
        driver = drivers.index(row["system"])
        return situations.index(row["row"]), row["car"], driver

    rows.sort(key=order)
    lines = []
    for row in rows:
        texts = (
            str(row["runs"]),
            str(row["collisions"]),
            str(row["left_the_lane"]),
            f"{row['mean_speed']:.1f}",
        )
        cells = [measured(text, row, policy=policy_of(row["car"])) for text in texts]
        driver = DRIVERS[row["system"]]
        lines.append([SITUATIONS[row["row"]], row["car"], driver, *cells])
    heads = ["situation", "car", "driver", "runs", "with a collision"]
    return table([*heads, "leave the lane", "mean speed [m/s]"], lines)


def lane_time():
    """Milliseconds of a control step in a lane."""
    rows = [row for row in read("benchmarks/lane.json") if "step_ms" in row]
    lines = [
        [
            f"{row['car']}, {row['row']}",
            *(
                measured(f"{row[name]:.1f}", row, policy=policy_of(row["car"]))
                for name in ("search_ms", "step_ms")
            ),
        ]
        for row in rows
    ]
    return table(["control step in a lane", "search [ms]", "whole step [ms]"], lines)


BLOCKS = {
    "README.md": {"corridor": corridor},
    "docs/corridor.md": {"wide": wide, "shield": shield, "recovery": recovery},
    "docs/lane.md": {"lane": lane, "lane_time": lane_time},
    "docs/planner.md": {"timing": timing, "planners": planners},
    "docs/adaptation.md": {"adaptation": adaptation},
    "docs/real-car.md": {
        "margins": margins,
        "late_corridors": late_corridors,
        "latency": latency,
        "latency_claims": latency_claims,
        "sensors": sensors,
    },
    "docs/your-system.md": {"systems": systems, "systems-back": starts_of_systems},
    "docs/results.md": results.TABLES | {"peers": peers, "commonroad": foreign_cars},
}
"""Page -> name of a block -> what fills it."""


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
