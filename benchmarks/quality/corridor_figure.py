"""Draw docs/corridor.png: hostile planners on one S3 road, with the shield of a certified policy and without it.

python -m benchmarks.quality.corridor_figure DIR [--seconds 30 --seed 3 --out docs/corridor.png]
[--film docs/corridor.gif]
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.quality import shield
from benchmarks.robustness.soak import LANE
from sfkd_jax.paper import draw_film, draw_hostile

SHOWN = ("worst", "bang-bang", "random", "constant", "full lock")
LOCKED = 5
"""When the planner of the film goes to full lock [s]."""
EACH, LATE = 4, 10
"""Drives of every planner; of the one that is hostile from a later moment on."""


def drives(car, seconds, seed):
    """What the figure shows."""
    roads, keys = shield.episodes(car, 1, seconds, seed)
    road, bounds = (
        jax.tree.map(lambda leaf: leaf[0], roads),
        car.certificate["corridor"]["bounds"],
    )
    steps, lock = len(road.envs), shield.SCRIPTS.index("full lock")

    def filtered(kind, onset, key):
        return shield.drive(
            car, shield.shielded(car, shield.scripted(car, kind, onset)), road, key
        )[0]

    def free(kind, onset, key):
        alone = shield.alone(car, shield.scripted(car, kind, onset))
        return shield.drive(car, alone, road, key)[0]

    kinds = np.repeat(
        [*map(shield.SCRIPTS.index, SHOWN), lock], [EACH] * len(SHOWN) + [LATE]
    )
    onsets = np.concatenate(
        [np.zeros(EACH * len(SHOWN), int), np.linspace(0.03, 0.93, LATE) * steps]
    ).astype(int)
    keys = jax.random.split(keys[0], len(kinds))
    late = slice(-LATE, None)
    lateral = np.asarray(
        jax.jit(jax.vmap(filtered))(jnp.asarray(kinds), jnp.asarray(onsets), keys)
    )[:, 1:]
    lost = jax.jit(jax.vmap(free))(
        jnp.asarray(kinds[late]), jnp.asarray(onsets[late]), keys[late]
    )
    return {
        "dt": car.plant.dt,
        "envs": np.asarray(road.envs),
        "width": bounds["nominal"],
        "tube": bounds["followed_position"],
        "lane": LANE,
        "kept": {
            name: lateral[EACH * row : EACH * (row + 1)]
            for row, name in enumerate(SHOWN)
        },
        "onset": onsets[late],
        "held": lateral[late],
        "free": np.asarray(lost)[:, 1:],
        "name": "full lock",
    }


def film(car, seconds, seed):
    """What the film shows: the policy's own planner, and one that loses the car, with
    the shield and without it.
    """
    roads, keys = shield.episodes(car, 1, seconds, seed)
    road, bounds = (
        jax.tree.map(lambda leaf: leaf[0], roads),
        car.certificate["corridor"]["bounds"],
    )
    lock = shield.scripted(
        car, shield.SCRIPTS.index("full lock"), round(LOCKED / car.plant.dt)
    )
    controllers = {
        "own planner, with shield": shield.planner(car, shield=True),
        f"full lock at {LOCKED} s, with shield": shield.shielded(car, lock),
        f"full lock at {LOCKED} s, without shield": lock,
    }
    cars = {}
    for name, controller in controllers.items():
        states, lateral, _ = jax.jit(partial(shield.drive_states, car, controller))(
            road, keys[0]
        )
        cars[name] = np.asarray(lateral)[1:], np.asarray(states)
    return {
        "cars": cars,
        "title": f"{car.plant.name} car on S3",
        "dt": car.plant.dt,
        "points": np.asarray(road.path.points),
        "envs": np.asarray(road.envs),
        "corridor": bounds["nominal"] + bounds["followed_position"],
    }


def main():
    """Parse, drive, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "run",
        metavar="DIR",
        help="with policy.safetensors and a certificate.json that has a corridor",
    )
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parents[2] / "docs" / "corridor.png"
    )
    parser.add_argument(
        "--film", type=Path, metavar="GIF", help="make this, and no figure"
    )
    args = parser.parse_args()
    draw, path, shown = (
        (draw_film, args.film, film) if args.film else (draw_hostile, args.out, drives)
    )
    print(draw(path, **shown(shield.load(args.run), args.seconds, args.seed)))


if __name__ == "__main__":
    main()
