"""Thousands of control steps at full speed, alone and beside a process that keeps one core busy; tails and misses.

python -m benchmarks.timing.realtime [--steps 10000 --beside 2000 --slow 2000 --only NAME ...
--out benchmarks/timing/realtime.json]
"""

import argparse
import json
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from functools import partial

from benchmarks import harness
from benchmarks.timing.contenders import CONTENDERS, environment, same_place

PERIOD_MS = 100.0
OURS = ("sfkd_jax", "sfkd_jax_ess", "own_model")
PEERS = ("plain_jax", "pytorch_mppi", "pytorch_mppi_one_thread")
SHARES = {"p50_ms": 0.5, "p99_ms": 0.99, "p999_ms": 0.999}


@contextmanager
def competing():
    """A process that does nothing but keep one core busy."""
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        busy.kill()
        busy.wait()


def tail(times):
    """Quantiles, the worst step, and how many missed the period."""
    result = {name: harness.quantile(times, share) for name, share in SHARES.items()}
    return result | {
        "max_ms": max(times),
        "missed": sum(time > PERIOD_MS for time in times),
        "steps": len(times),
    }


def drive(name, steps, beside):
    """One contender in a process of its own."""
    words = ("--measure", name, "--steps", steps)
    with competing() if beside else nullcontext():
        return harness.in_own_process(
            "benchmarks.timing.realtime", *words, environment=environment(name)
        )


def main():
    """Parse, run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (
        ("samples", 1500),
        ("horizon", 20),
        ("steps", 10000),
        ("beside", 2000),
        ("slow", 2000),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument(
        "--only", nargs="*", default=[*OURS, *PEERS], choices=list(CONTENDERS)
    )
    parser.add_argument("--out")
    parser.add_argument("--measure", choices=list(CONTENDERS), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        build = partial(same_place, args.measure, args.samples, args.horizon)
        print(json.dumps(tail(harness.first_and_then(build, args.steps)["wall_ms"])))
        return
    result = {}
    for name in args.only:
        steps = args.steps if name in OURS else args.slow
        both = {
            "alone": drive(name, steps, False),
            "beside": drive(name, min(steps, args.beside), True),
        }
        result[name] = both
        print(name, json.dumps(both))
    settings = {
        key: getattr(args, key)
        for key in ("samples", "horizon", "steps", "beside", "slow")
    }
    document = {
        "contenders": result,
        "period_ms": PERIOD_MS,
        "settings": settings,
        "machine": harness.machine(),
    }
    harness.write(args.out, document)


if __name__ == "__main__":
    main()
