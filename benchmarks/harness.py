"""What the benchmarks share: steps timed one by one, processes of their own, quantiles,
the machine, JSON.
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
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "src" / "sfkd_jax" / "pretrained"
WARM_UP = 9
LOAD = os.getloadavg()[0]
"""How many processes wanted a core in the minute before: another job beside a benchmark
makes its times void.
"""
HOST_DEVICES = {
    "XLA_FLAGS": f"--xla_force_host_platform_device_count={len(os.sched_getaffinity(0))}"
}
PACKAGES = ("jax", "torch", "pytorch_mppi", "jax_mppi", "evosax", "torchrl", "tau_ctrl")


def timed(step, count):
    """Wall and CPU time of every one of `count` calls [ms]."""
    wall, cpu = [], []
    for _ in range(count):
        wall_began, cpu_began = time.perf_counter(), time.process_time()
        step()
        wall.append(1e3 * (time.perf_counter() - wall_began))
        cpu.append(1e3 * (time.process_time() - cpu_began))
    return wall, cpu


def first_and_then(build, count):
    """Build a step and take it: seconds to the first answer, times of `count` warm
    steps [ms], peak memory [MB].
    """
    began = time.perf_counter()
    step = build()
    step()
    first = time.perf_counter() - began
    timed(step, WARM_UP)
    wall, cpu = timed(step, count)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"first_s": first, "wall_ms": wall, "cpu_ms": cpu, "memory_mb": memory}


def quantile(values, share):
    """The smallest value with at least that share of all at or below it, less one: no
    interpolation.
    """
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def in_own_process(module, *words, environment=None):
    """Run a module; return the JSON of its last line, or {"error": its last line}."""
    command = [sys.executable, "-m", module, *map(str, words)]
    variables = os.environ | (environment or {})
    done = subprocess.run(
        command, cwd=ROOT, env=variables, capture_output=True, text=True, check=False
    )
    if done.returncode:
        return {
            "error": (
                done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            )[-1]
        }
    return json.loads(done.stdout.splitlines()[-1])


def machine():
    """Where this was measured, with what."""
    cores, python = len(os.sched_getaffinity(0)), platform.python_version()
    return {
        "cores": cores,
        "processor": platform.machine(),
        "python": python,
        "load": LOAD,
        "versions": _versions(),
    }


def _versions():
    """Of the packages that are installed; one used from its source is not named."""
    result = {}
    for name in PACKAGES:
        try:
            result[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return result


def write(path, document):
    """JSON, if there is a path."""
    if path:
        Path(path).write_text(json.dumps(document, indent=1) + "\n")


def in_turn(jobs, rounds, steps=3):
    """Jobs of no arguments in this process, round-robin: label -> best, median and CPU
    time of a call [ms].
    """
    for job in jobs.values():
        timed(job, 2)
    wall, cpu = {label: [] for label in jobs}, {label: [] for label in jobs}
    for _ in range(rounds):
        for label, job in jobs.items():
            for saved, new in zip((wall, cpu), timed(job, steps), strict=True):
                saved[label] += new
    middle = statistics.median
    return {
        label: {
            "best_ms": min(wall[label]),
            "median_ms": middle(wall[label]),
            "cpu_ms": middle(cpu[label]),
        }
        for label in jobs
    }


def of_vehicle(description, measure, show):
    """The command of a measurement of steps in turn: parse, measure, print, write.

    `measure(vehicle, rounds)` gives label -> row, `show(row)` the words of a row.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", default="kinematic")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out")
    args = parser.parse_args()
    rows = measure(args.vehicle, args.rounds)
    for label, row in rows.items():
        print(f"{label:36} {show(row)}")
    settings = {"vehicle": args.vehicle, "rounds": args.rounds}
    write(args.out, {"rows": rows, "settings": settings, "machine": machine()})
