"""Drive the shipped policies for 10^5 steps and more while what they are told is wrong every few seconds.

python -m benchmarks.robustness.soak [--steps 100000 --short 5000 --full 2000 --only LEG ... --out
benchmarks/robustness/soak.json] Legs that a file of the same settings has already are kept beside
those that are driven. The controller is a user's: certified, watched, holding its plan
where the monitor objects, its `act` jitted once and its state never started anew, while
roads of 1000 steps follow each other. Every leg has a process of its own. Asked for: no
control outside the limits, one compilation, memory that does not grow, a state that is
finite after a fault.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.robustness import faults
from benchmarks.robustness.faulty_road import HORIZON, ROAD, SAMPLES, not_finite, track

LANE = 0.85
"""Distance from the path at which a car of 1.8 m leaves a lane of 3.5 m [m]."""
SETTLED = 100
"""Steps after a fault from which on a car should keep its lane."""
COMPILED = "/jax/core/compile/backend_compile_duration"
ENVIRONMENT = {
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""Steps as small as these take longer to hand to another thread than to compute."""
PAGE_KB = os.sysconf("SC_PAGE_SIZE") / 1024
VARIANTS = {
    "measured": ("steps", {}),
    "estimated": ("short", {"env_source": "estimated", "adaptive": True}),
    "delayed": ("short", {"delay": 2}),
    "no_faults": ("short", {"faulty": False}),
    "full": ("full", {"samples": 1500}),
    "adaptive": ("short", {"adaptive": True}),
}
"""Name -> which option says how many steps, and what is not as in `track`."""
LEGS = {
    f"{plant}_{name}": (steps, {"plant": plant, **settings})
    for plant in ("kinematic", "dynamic")
    for name, (steps, settings) in VARIANTS.items()
}


def resident_kb():
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_KB


def drive(loop, steps, seed):
    """`steps` control steps one by one: (records by step, by road what is held in
    memory, compilations).
    """
    compiled, random = [], np.random.default_rng(seed)
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name == COMPILED)
    )
    act = jax.jit(loop.act)

    @jax.jit
    def move(road, world, control, state, healthy):
        world, lateral, lost = loop.advance(road, world, control)
        flags = [
            jnp.asarray(value, float)
            for value in (lateral, lost, healthy, not_finite(state))
        ]
        return *loop.sense(road, world), jnp.concatenate([control, jnp.stack(flags)])

    enter = jax.jit(lambda road: loop.sense(road, loop.enter(road)))
    state = loop.init(jax.random.key(seed))
    records, kinds = (
        np.full((steps, len(loop.low) + 4), np.nan, np.float32),
        np.full(steps, -1),
    )
    saved = {"resident_kb": [], "arrays": [], "compiled": []}
    for begin in range(0, steps, ROAD):
        road = loop.road(jax.random.key(seed + begin), random)
        kinds[begin : begin + ROAD] = np.asarray(road.faults.kind)[: steps - begin]
        world, observed = enter(road)
        for k in range(begin, min(begin + ROAD, steps)):
            control, state, info = act(loop.params, state, observed)
            world, observed, records[k] = move(
                road, world, control, state, info["healthy"]
            )
        del road, world, observed, control, info
        now = resident_kb(), len(jax.live_arrays()), sum(compiled)
        for name, value in zip(saved, now, strict=True):
            saved[name].append(value)
    return records, kinds, saved | {"act": act._cache_size()}


def summary(records, kinds, saved, low, high):
    """What a leg comes to."""
    controls, (lateral, lost, healthy, left) = (
        records[:, : len(low)],
        records[:, len(low) :].T,
    )
    steps, distance, healthy = len(kinds), np.abs(lateral), healthy > 0
    disturbed = kinds >= 0
    disturbed[ROAD::ROAD] = True  # another road: for the controller, a jump
    disturbed[1:] |= lost[:-1] > 0  # put back: likewise
    since = np.arange(steps) - np.maximum.accumulate(
        np.where(disturbed, np.arange(steps), -SETTLED - 1)
    )
    settled, away = since > SETTLED, distance > LANE
    return {
        "steps": steps,
        "outside_limits": int(np.sum((controls < low) | (controls > high))),
        "not_finite": int(np.sum(~np.isfinite(controls))),
        "compilations": saved["act"],
        "compiled_later": saved["compiled"][-1] - saved["compiled"][0],
        "memory": growth(np.asarray(saved["resident_kb"])),
        "arrays": {"start": saved["arrays"][0], "end": saved["arrays"][-1]},
        "state_not_finite_after": int(np.max(left[kinds < 0])),
        "healthy": float(np.mean(healthy)),
        "rmse_settled_m": float(np.sqrt(np.mean(lateral[settled] ** 2))),
        "off_lane": {
            "steps": int(away.sum()),
            "settled_steps": int(np.sum(away & settled)),
            "of": int(settled.sum()),
        },
        "largest_m": float(np.max(distance)),
        "put_back": int(lost.sum()),
        "faults": recoveries(kinds, disturbed, healthy, away),
    }


def growth(resident):
    """Memory at the first, middle and last road, what a line through the second half
    grows by, and what it misses.
    """
    late = resident[len(resident) // 2 :]
    at = np.arange(len(late))
    slope, start = np.polyfit(at, late, 1) if len(late) > 1 else (0.0, late[0])
    return {
        "start_kb": resident[0],
        "middle_kb": resident[len(resident) // 2],
        "end_kb": resident[-1],
        "slope_kb_per_1000_steps": float(slope) * 1000 / ROAD,
        "noise_kb": float(np.std(late - slope * at - start)),
    }


def recoveries(kinds, disturbed, healthy, away):
    """By kind of fault: how many, steps until the plan is trusted again, steps until
    the car stays in its lane.
    """
    result = {
        name: {"count": 0, "until_healthy": [], "until_in_lane": []}
        for name in faults.KINDS
    }
    ends = np.flatnonzero((kinds[:-1] >= 0) & (kinds[1:] < 0)) + 1
    for end in ends:
        fault, later = (
            result[faults.KINDS[kinds[end - 1]]],
            np.flatnonzero(disturbed[end:]),
        )
        after = slice(end, end + later[0] if len(later) else len(kinds))
        fault["count"] += 1
        if after.stop - end < faults.PAUSE[0]:  # cut short by the end of the road
            continue
        trusted, off = np.flatnonzero(healthy[after]), np.flatnonzero(away[after])
        fault["until_healthy"].append(int(trusted[0]) if len(trusted) else None)
        fault["until_in_lane"].append(int(off[-1]) + 1 if len(off) else 0)
    return {
        name: fault | {key: spread(fault[key]) for key in fault if key != "count"}
        for name, fault in result.items()
    }


def spread(counts):
    """Median and largest; how many never came to an end."""
    ended = [count for count in counts if count is not None]
    if not ended:
        return {"median": None, "max": None, "never": len(counts)}
    return {
        "median": statistics.median(ended),
        "max": max(ended),
        "never": len(counts) - len(ended),
    }


def table(document):
    """What was found, as docs/failures.md has it."""
    heads = [
        "leg",
        "steps",
        "controls outside limits or not finite",
        "compilations of `act`",
    ]
    heads += [
        f"memory [MB] {when}"
        for when in ("at the start", "in the middle", "at the end")
    ]
    heads += [
        "growth in the second half [kB per 1000 steps]",
        "longest until `healthy` [steps]",
    ]
    heads += ["steps off the lane", "of those 10 s after a fault", "put back"]
    lines = [heads, ["---"] * len(heads)]
    for name, leg in (
        (name, document["legs"][name]) for name in LEGS if name in document["legs"]
    ):
        memory, waits = (
            leg["memory"],
            [fault["until_healthy"] for fault in leg["faults"].values()],
        )
        longest = (
            "never"
            if any(wait["never"] for wait in waits)
            else max(wait["max"] or 0 for wait in waits)
        )
        cells = [
            name.replace("_", " "),
            leg["steps"],
            leg["outside_limits"] + leg["not_finite"],
        ]
        cells += [leg["compilations"] + leg["compiled_later"]]
        cells += [
            f"{memory[f'{when}_kb'] / 1024:.1f}" for when in ("start", "middle", "end")
        ]
        cells += [
            f"{round(memory['slope_kb_per_1000_steps'], 1) + 0.0:.1f}",
            longest,
        ]  # no -0.0
        lines.append(
            [
                *cells,
                leg["off_lane"]["steps"],
                leg["off_lane"]["settled_steps"],
                leg["put_back"],
            ]
        )
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def main():
    """Parse, drive every leg in a process of its own, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (
        ("steps", 100000),
        ("short", 5000),
        ("full", 2000),
        ("seed", 0),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--only", nargs="*", default=list(LEGS), choices=list(LEGS))
    parser.add_argument("--out")
    parser.add_argument("--measure", choices=list(LEGS), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        steps, settings = LEGS[args.measure]
        loop, began = track(**settings), time.perf_counter()
        driven = drive(loop, getattr(args, steps), args.seed)
        print(
            json.dumps(
                summary(*driven, loop.low, loop.high)
                | {"seconds": time.perf_counter() - began}
            )
        )
        return
    settings = {key: getattr(args, key) for key in ("steps", "short", "full", "seed")}
    words = [word for key, value in settings.items() for word in (f"--{key}", value)]
    settings |= {"samples": SAMPLES, "horizon": HORIZON}
    known = (
        json.loads(Path(args.out).read_text())
        if args.out and Path(args.out).exists()
        else {}
    )
    legs = known["legs"] if known.get("settings") == settings else {}
    document = {"legs": legs, "settings": settings, "machine": harness.machine()}
    for leg in args.only:
        document["legs"][leg] = harness.in_own_process(
            "benchmarks.robustness.soak",
            "--measure",
            leg,
            *words,
            environment=ENVIRONMENT,
        )
        print(leg, json.dumps(document["legs"][leg]), flush=True)
        harness.write(args.out, document)
    print(table(document), flush=True)


if __name__ == "__main__":
    main()
