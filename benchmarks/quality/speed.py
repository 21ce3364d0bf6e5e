"""How fast may the car go? The corridor of certified policies for every friction and speed of their box.

python -m benchmarks.quality.speed DIR ... [--room 0.5 --drives 150 --out benchmarks/quality/speed.json]
DIR: with policy.npz and a certificate.json that has a corridor. Every cell is
calibrated by itself, on drives that have its friction and its speed. --room: what the
lane leaves on either side of the car [m].
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.quality import shield
from benchmarks.quality.speed_page import answer, table
from sfkd_jax import store
from sfkd_jax.corridor import corridor_by_speed

FRICTIONS, SPEEDS = 5, 6
"""Values of each, evenly over the certified box, its ends among them."""


def cells(run, drives):
    """The table of one run directory."""
    car = shield.load(run)
    about = car.certificate["corridor"]["class"]
    low, high = (corner[0] for corner in about["env_box"])
    frictions, speeds = (
        np.linspace(low, high, FRICTIONS),
        np.linspace(*about["speed"], SPEEDS),
    )
    grid = {
        "frictions": frictions.round(6).tolist(),
        "speeds": speeds.round(6).tolist(),
    }
    result = corridor_by_speed(car.trained, car.certificate, **grid, drives=drives)
    return {"policy_sha256": car.certificate["policy_sha256"]} | result


def main():
    """Parse, drive, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", metavar="DIR")
    parser.add_argument("--room", type=float, default=0.5)
    parser.add_argument("--drives", type=int, default=150)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    document = {"room_m": args.room, "cars": {}}
    for run in args.runs:
        result = cells(run, args.drives)
        name = shield.load(run).plant.name
        document["cars"][name] = result
        print(table(name, result), answer(result, args.room), sep="\n", flush=True)
        if args.out:
            store.write_json(args.out, document | {"versions": store.versions()})


if __name__ == "__main__":
    main()
