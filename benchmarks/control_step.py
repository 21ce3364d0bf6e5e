"""One control step of every contender, round-robin, each in its own process; prints a table and writes JSON.

python benchmarks/control_step.py [--samples 1500 --horizon 20 --rounds 4 --steps 40 --only NAME ... --out FILE]
Needs torch and pytorch-mppi beside this package for the second; a contender that does not import is named and left out.
"""

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time

from contenders import CONTENDERS

WARM_UP = 9


def measure(name, samples, horizon, steps):
    """In this process: first call, then wall and CPU time of every step [ms], and peak memory [MB]."""
    began = time.perf_counter()
    step = CONTENDERS[name](samples, horizon)
    step()
    first = time.perf_counter() - began
    for _ in range(WARM_UP):
        step()
    wall, cpu = [], []
    for _ in range(steps):
        wall_began, cpu_began = time.perf_counter(), time.process_time()
        step()
        wall.append(1e3 * (time.perf_counter() - wall_began))
        cpu.append(1e3 * (time.process_time() - cpu_began))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"first_s": first, "wall_ms": wall, "cpu_ms": cpu, "memory_mb": memory}


def in_own_process(name, asked):
    """One round of one contender, or why there is none."""
    command = [sys.executable, __file__, "--measure", name, "--samples", asked.samples, "--horizon", asked.horizon]
    command = [str(part) for part in [*command, "--steps", asked.steps]]
    environment = os.environ | getattr(CONTENDERS[name], "environment", {})
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def summary(rounds):
    """Best and median of the rounds' medians, 99 % quantile over all steps, and the rest as medians."""
    medians = [statistics.median(one["wall_ms"]) for one in rounds]
    steps = sorted(step for one in rounds for step in one["wall_ms"])
    return {
        "best_ms": min(medians),
        "median_ms": statistics.median(medians),
        "p99_ms": steps[min(len(steps) - 1, int(0.99 * len(steps)))],
        "cpu_ms": statistics.median(statistics.median(one["cpu_ms"]) for one in rounds),
        "first_s": statistics.median(one["first_s"] for one in rounds),
        "memory_mb": max(one["memory_mb"] for one in rounds),
    }


def main():
    """Parse, run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("samples", 1500), ("horizon", 20), ("rounds", 4), ("steps", 40)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--only", nargs="*", default=list(CONTENDERS), choices=list(CONTENDERS))
    parser.add_argument("--out")
    parser.add_argument("--measure", choices=list(CONTENDERS), help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measure(asked.measure, asked.samples, asked.horizon, asked.steps)))
        return
    found = {name: [] for name in asked.only}
    for _ in range(asked.rounds):
        for name in asked.only:
            found[name].append(in_own_process(name, asked))
    missing = {name: rounds[0]["error"] for name, rounds in found.items() if "error" in rounds[0]}
    table = {name: summary(rounds) for name, rounds in found.items() if name not in missing}
    for name, row in table.items():
        print(f"{name:20}", "  ".join(f"{key} {value:8.2f}" for key, value in row.items()))
    for name, reason in missing.items():
        print(f"{name:20} not run: {reason}")
    cores, python = len(os.sched_getaffinity(0)), platform.python_version()
    machine = {"cores": cores, "processor": platform.machine(), "python": python}
    settings = {key: getattr(asked, key) for key in ("samples", "horizon", "rounds", "steps")}
    document = {"contenders": table, "not_run": missing, "settings": settings, "machine": machine}
    if asked.out:
        with open(asked.out, "w") as file:
            json.dump(document, file, indent=1)


if __name__ == "__main__":
    main()
