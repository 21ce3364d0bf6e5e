"""Closed loop at equal time: as many samples as fit a budget per step, the model itself as plant, several seeds.

python -m benchmarks.timing.plan_quality [--budgets 10 20 --seeds 4 --steps 60 --out
benchmarks/timing/plan_quality.json] The target changes its sign half-way. Planners with a fixed
temperature are given the best of several, with all seeds.
"""

import argparse
import inspect
import json
import statistics
from functools import partial

import numpy as np

from benchmarks import harness
from benchmarks.timing import other_peers, ours, problem
from benchmarks.timing.contenders import CONTENDERS

SAMPLES = (375, 750, 1500, 3000, 6000)
HORIZON = 20
TEMPERATURES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
AIM = np.asarray([1.0, -0.5, 0.5, -1.0], np.float32)
NAMES = (
    "sfkd_jax",
    "sfkd_jax_ess",
    "sfkd_jax_knots",
    "plain_jax",
    "jax_mppi",
    "pytorch_mppi",
    "pytorch_kmppi",
)
EXTRA = {
    build.__name__: build for build in (ours.sfkd_jax_knots, other_peers.pytorch_kmppi)
}
BUILD = CONTENDERS | EXTRA


def episode(step, steps):
    """Mean cost and mean |u_k − u_{k−1}| over an episode."""
    w, z, before, total, moved = problem.weights(), problem.start(), None, 0.0, 0.0
    for k in range(steps):
        target = AIM if k < steps // 2 else -AIM
        u = np.asarray(step(z, target))
        z = problem.advance(np, w, z, u)
        total += float(problem.charge(np, w, z, u, target))
        moved += 0.0 if before is None else float(np.abs(u - before).mean())
        before = u
    return total, moved / (steps - 1)


def drive(name, samples, seeds, steps):
    """Every temperature it can have, every seed: rows of temperature, costs, movement."""
    fixed = (
        "temperature" in inspect.signature(BUILD[name]).parameters or name == "sfkd_jax"
    )
    rows = []
    for temperature in TEMPERATURES if fixed else (None,):
        chosen = {} if temperature is None else {"temperature": temperature}
        runs = [
            episode(BUILD[name](samples, HORIZON, seed, **chosen), steps)
            for seed in range(seeds)
        ]
        costs, moved = zip(*runs, strict=True)
        rows.append(
            {
                "temperature": temperature,
                "costs": costs,
                "movement": statistics.mean(moved),
            }
        )
    return rows


def fitting(name, rounds, steps):
    """Best time of a step for every number of samples [ms]."""
    result = {}
    for samples in SAMPLES:
        ask = partial(
            harness.in_own_process,
            "benchmarks.timing.plan_quality",
            "--time",
            name,
            "--samples",
            samples,
            "--steps",
            steps,
        )
        runs = [ask() for _ in range(rounds)]
        if "error" in runs[0]:
            return runs[0]
        result[samples] = min(statistics.median(run["wall_ms"]) for run in runs)
    return result


def judged(name, times, budget, args):
    """The most samples within the budget, and the best temperature's closed loop with
    them.
    """
    fit = [samples for samples, time in times.items() if time <= budget]
    if not fit:
        return {"samples": 0}
    words = (
        "--drive",
        name,
        "--samples",
        max(fit),
        "--seeds",
        args.seeds,
        "--steps",
        args.steps,
    )
    rows = harness.in_own_process("benchmarks.timing.plan_quality", *words)
    best = min(rows, key=lambda row: statistics.mean(row["costs"]))
    spread = [statistics.mean(row["costs"]) for row in rows]
    costs = {
        "cost": min(spread),
        "sd": statistics.stdev(best["costs"]),
        "worst_temperature_cost": max(spread),
    }
    return {
        "samples": max(fit),
        "temperature": best["temperature"],
        "movement": best["movement"],
    } | costs


def main():
    """Parse, run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("seeds", 4), ("steps", 60), ("rounds", 2), ("samples", 1500)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--budgets", nargs="*", type=float, default=[10.0, 20.0])
    parser.add_argument("--only", nargs="*", default=list(NAMES), choices=list(BUILD))
    parser.add_argument("--out")
    for hidden in ("--time", "--drive"):
        parser.add_argument(hidden, choices=list(BUILD), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.time:
        build = lambda: partial(
            BUILD[args.time](args.samples, HORIZON), problem.start(), AIM
        )
        print(json.dumps(harness.first_and_then(build, args.steps)))
    elif args.drive:
        print(json.dumps(drive(args.drive, args.samples, args.seeds, args.steps)))
    else:
        times = {name: fitting(name, args.rounds, args.steps) for name in args.only}
        missing = {
            name: result["error"] for name, result in times.items() if "error" in result
        }
        ran = [name for name in args.only if name not in missing]
        result = {
            budget: {name: judged(name, times[name], budget, args) for name in ran}
            for budget in args.budgets
        }
        for budget, rows in result.items():
            for name, row in rows.items():
                print(f"{budget:5} ms  {name:20}", json.dumps(row))
        settings = {key: getattr(args, key) for key in ("seeds", "steps", "budgets")}
        document = {
            "budgets": result,
            "times_ms": times,
            "not_run": missing,
            "settings": settings,
        }
        harness.write(args.out, document | {"machine": harness.machine()})


if __name__ == "__main__":
    main()
