"""How the control step grows with samples and horizon, what compiling costs, episodes against steps, and the floor.

python -m benchmarks.timing.scaling [--rounds 3 --steps 30 --episode 200 --out
benchmarks/timing/scaling.json]
"""

import argparse
import itertools
import math

from benchmarks import harness
from benchmarks.timing.contenders import CONTENDERS
from benchmarks.timing.control_step import rounds_of, table_of

SAMPLES = (375, 750, 1500, 3000, 6000, 12000, 24000)
HORIZONS = (10, 20, 40)
USUAL = (1500, 20)
SHOWN = ("sfkd_jax", "plain_jax", "pytorch_mppi")


def exponent(sizes, times):
    """p of time ∝ size^p, by least squares of the logarithms."""
    x, y = ([math.log(value) for value in values] for values in (sizes, times))
    x_mean, y_mean = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - x_mean) ** 2 for a in x)
    return sum((a - x_mean) * (b - y_mean) for a, b in zip(x, y, strict=True)) / spread


def sweep(names, samples, rounds, steps):
    """Every contender at every size, round-robin: name -> rows of (samples, horizon,
    summary).
    """
    sizes = [(count, USUAL[1]) for count in samples] + [
        (USUAL[0], horizon) for horizon in HORIZONS
    ]
    sizes = list(dict.fromkeys(sizes))
    jobs = {
        f"{name} {m} {t}": (name, m, t)
        for name, (m, t) in itertools.product(names, sizes)
    }
    table, missing = table_of(rounds_of(jobs, rounds, steps))
    rows = [
        dict(zip(("name", "samples", "horizon"), jobs[label], strict=True)) | row
        for label, row in table.items()
    ]
    return rows, missing


def growth(rows, name, samples):
    """Exponents of the best round's time, over all numbers of samples and over the
    large ones.
    """
    times = {
        row["samples"]: row["best_ms"]
        for row in rows
        if row["name"] == name and row["horizon"] == USUAL[1]
    }
    ranges = {
        "all": list(samples),
        "from_1500": [count for count in samples if count >= USUAL[0]],
    }
    return {
        part: exponent(sizes, [times[m] for m in sizes])
        for part, sizes in ranges.items()
        if len(sizes) > 1
    }


def main():
    """Parse, run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (
        ("rounds", 3),
        ("steps", 30),
        ("episode", 200),
        ("compilations", 3),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument(
        "--only", nargs="*", default=list(SHOWN), choices=list(CONTENDERS)
    )
    parser.add_argument("--samples", nargs="*", type=int, default=list(SAMPLES))
    parser.add_argument("--out")
    args = parser.parse_args()
    rows, missing = sweep(args.only, args.samples, args.rounds, args.steps)
    ran = [name for name in args.only if any(row["name"] == name for row in rows)]
    document = {
        "sweep": rows,
        "not_run": missing,
        "exponents": {name: growth(rows, name, args.samples) for name in ran},
        "episode": harness.in_own_process(
            "benchmarks.timing.episode",
            "--steps",
            args.episode,
            "--rounds",
            2 * args.rounds,
        ),
        "compile": harness.in_own_process(
            "benchmarks.timing.compiling", "--rounds", args.compilations
        ),
        "floor": harness.in_own_process(
            "benchmarks.timing.floor", "--rounds", 5 * args.rounds
        ),
        "settings": {
            key: getattr(args, key)
            for key in ("rounds", "steps", "episode", "compilations")
        },
        "machine": harness.machine(),
    }
    for row in rows:
        print(
            f"{row['name']:24} {row['samples']:6} x {row['horizon']:3}  best {row['best_ms']:8.2f} ms"
        )
    for part in ("not_run", "exponents", "episode", "compile", "floor"):
        print(part, document[part])
    harness.write(args.out, document)


if __name__ == "__main__":
    main()
