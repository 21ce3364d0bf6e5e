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
from sfkd_jax import report
from sfkd_jax.report import style

COLOURS = style.ACCENT, style.THIRD, "#8b5fbf", style.SECOND, style.MUTED
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
        "tube": bounds["vehicle_to_nominal_position"],
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
    colours = style.ACCENT, style.THIRD, style.DEPARTED
    return report.Film(
        title=f"{car.plant.name} car on S3",
        dt=car.plant.dt,
        points=np.asarray(road.path.points),
        envs=np.asarray(road.envs),
        cars=[
            report.Car(name, colour, *arrays)
            for (name, arrays), colour in zip(cars.items(), colours, strict=True)
        ],
        corridor=bounds["nominal"] + bounds["vehicle_to_nominal_position"],
    )


def draw(shown):
    """Hostile planners in the corridor; below them one of them without the shield."""
    figure = style.canvas(7.2)
    ratios = {"sharex": True, "height_ratios": [5, 4.2, 1, 1]}
    panels = inside, lost, friction, wind = figure.subplots(4, 1, **ratios)
    dt, edge = shown["dt"], shown["width"] + shown["tube"]
    time = dt * np.arange(1, len(shown["envs"]) + 1)
    for (name, lateral), color in zip(shown["kept"].items(), COLOURS, strict=True):
        inside.plot(time, lateral.T, color=color, linewidth=0.7, zorder=3)
        inside.plot([], [], color=color, label=name)
    inside.set(ylim=(-1.25 * edge, 1.25 * edge))
    inside.set_title("With the shield, every planner hostile", pad=22)
    for onset, held, free in zip(
        shown["onset"], shown["held"], shown["free"], strict=True
    ):
        gone = np.flatnonzero(~(np.abs(free) < 3 * shown["lane"]))
        end = gone[0] + 1 if len(gone) else len(free)
        look = {"color": style.DEPARTED, "linewidth": 1.0}
        lost.plot(time[onset:end], free[onset:end], **look)
        lost.plot(time[onset:], held[onset:], color=style.ACCENT, linewidth=0.7)
    lost.plot([], [], color=style.DEPARTED, label="without the shield")
    lost.plot([], [], color=style.ACCENT, label="with the shield")
    for side in (-shown["lane"], shown["lane"]):
        lost.axhline(side, color=style.DARK, linestyle="--", linewidth=1.2)
    lost.set(ylim=(-2.2 * shown["lane"], 2.2 * shown["lane"]))
    title = f"{shown['name'].capitalize()} from one moment on; dashed: leaves its lane"
    lost.set_title(title, pad=22)
    for axes in (inside, lost):
        style.draw_corridor(axes, edge)
        axes.set_ylabel("lateral error [m]")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5)
    style.draw_conditions(friction, wind, shown["envs"], dt)
    for axes in panels:
        axes.grid(visible=False, axis="x")
        for switch in style.switches(shown["envs"]):
            axes.axvline(switch * dt, **style.SWITCH)
    wind.set(xlabel="time [s]", xlim=(0.0, time[-1]))
    figure.align_ylabels()
    return figure


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
    given = shield.load(args.run), args.seconds, args.seed
    if args.film:
        print(report.write_film(film(*given), args.film, every=1))
    else:
        print(style.save(args.out, draw, drives(*given)))


if __name__ == "__main__":
    main()
