"""One control step of every contender, round-robin, each in its own process; prints a table and writes JSON.

python -m benchmarks.timing.control_step [--samples 1500 --horizon 20 --rounds 4 --steps 40
--only NAME ... --out FILE] Other libraries are used if they import; a contender that
does not is named and left out. See docs/results/performance.md.
"""

import argparse
import json
import statistics
from functools import partial

from benchmarks import harness
from benchmarks.timing.contenders import CONTENDERS, environment, same_place


def rounds_of(jobs, count, steps):
    """`count` rounds over all jobs (label -> name, samples, horizon), each time in a
    new process: label -> rounds.
    """
    result = {label: [] for label in jobs}
    for _ in range(count):
        for label, (name, samples, horizon) in jobs.items():
            words = (
                "--measure",
                name,
                "--samples",
                samples,
                "--horizon",
                horizon,
                "--steps",
                steps,
            )
            result[label].append(
                harness.in_own_process(
                    "benchmarks.timing.control_step",
                    *words,
                    environment=environment(name),
                )
            )
    return result


def summary(rounds):
    """Best and median of the rounds' medians, 99 % quantile over all steps, and the
    rest as medians.
    """
    medians = [statistics.median(one["wall_ms"]) for one in rounds]
    return {
        "best_ms": min(medians),
        "median_ms": statistics.median(medians),
        "p99_ms": harness.quantile(
            [step for one in rounds for step in one["wall_ms"]], 0.99
        ),
        "cpu_ms": statistics.median(statistics.median(one["cpu_ms"]) for one in rounds),
        "first_s": statistics.median(one["first_s"] for one in rounds),
        "memory_mb": max(one["memory_mb"] for one in rounds),
    }


def table_of(result):
    """Rounds -> summaries, and the reasons of those that did not run."""
    missing = {
        label: one["error"]
        for label, rounds in result.items()
        for one in rounds
        if "error" in one
    }
    return {
        label: summary(rounds)
        for label, rounds in result.items()
        if label not in missing
    }, missing


def arguments():
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (
        ("samples", 1500),
        ("horizon", 20),
        ("rounds", 4),
        ("steps", 40),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument(
        "--only", nargs="*", default=list(CONTENDERS), choices=list(CONTENDERS)
    )
    parser.add_argument("--out")
    parser.add_argument("--measure", choices=list(CONTENDERS), help=argparse.SUPPRESS)
    return parser.parse_args()


def main():
    """Parse, run, print, write."""
    args = arguments()
    if args.measure:
        build = partial(same_place, args.measure, args.samples, args.horizon)
        print(json.dumps(harness.first_and_then(build, args.steps)))
        return
    jobs = {name: (name, args.samples, args.horizon) for name in args.only}
    table, missing = table_of(rounds_of(jobs, args.rounds, args.steps))
    for name, row in table.items():
        print(
            f"{name:24}", "  ".join(f"{key} {value:8.2f}" for key, value in row.items())
        )
    for name, reason in missing.items():
        print(f"{name:24} not run: {reason}")
    settings = {
        key: getattr(args, key) for key in ("samples", "horizon", "rounds", "steps")
    }
    document = {
        "contenders": table,
        "not_run": missing,
        "settings": settings,
        "machine": harness.machine(),
    }
    harness.write(args.out, document)


if __name__ == "__main__":
    main()
