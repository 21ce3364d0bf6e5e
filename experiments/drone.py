"""A drone through random windows, each as wide as what its certificate guarantees.

    python -m experiments.drone RUN [--runs N] [--write]

RUN is a certified run of examples/systems/quadrotor.py, such as that of
`bash experiments/systems.sh quadrotor`, in runs/systems/quadrotor. The drone flies in a
round cage, with a payload and in wind that switch. A reference leads through the middle
of every window, and half the opening of a window is the radius of the cage plus the
certified bound. Prints a line of JSON. With --write it becomes experiments/drone.json,
and a flight becomes docs/drone.gif.
"""

import argparse
import json
import runpy
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import stamp
from experiments.drone_film import DroneFilm
from sfkd_jax.experiment.system_runs import random_scenes, rivals, run_controller
from sfkd_jax.report import film
from sfkd_jax.schedules import within

HOME = Path(__file__).parent
EXAMPLE = HOME.parent / "examples" / "systems" / "quadrotor.py"
RADIUS = 0.3
"""Of the cage, which is round whatever the roll [m]."""
WINDOWS = 5
"""Number of windows of a flight."""
HALF = (14, 24)
"""Fewest and most steps from a window to the middle of the way to the next."""
RUN_UP = 20
"""Steps over which the drone gains its speed at the start."""
PUSH = (0.8, 1.2)
"""Range of the acceleration on the run-up [m/s²]."""
SUBSTEPS = 5
"""Number of places between two states at which the distance to a wall is taken."""
SEED = 5


class Course(NamedTuple):
    """Windows in walls without thickness, and a reference through their middles.

    Attributes:
        points: of the reference: x, vx, z and vz.
        windows: x and z of the middle of each window [m].
        steps: of the flight, on which the last window is passed.
    """

    points: jax.Array
    windows: jax.Array
    steps: jax.Array


def random_course(tracked, key, *, length):
    """Draw a course whose reference is of the class of the certificate.

    Both accelerations are constant over half the way between two windows, and opposite
    over the other half, so that the drone passes each with the same velocity. After the
    last window it flies on.

    Args:
        tracked: the drone in the coordinates of its frame.
        key: consumed.
        length: number of steps of the reference.
    """
    push_key, half_key, across_key, rise_key = jax.random.split(key, 4)
    halves = jax.random.randint(half_key, (WINDOWS,), HALF[0], HALF[1] + 1)
    low, high = tracked.frame.input_box
    rises = within((low[1], high[1]), rise_key, WINDOWS)
    # Along the way less: the drone does not fly backwards.
    across = 0.5 * within((low[0], high[0]), across_key, WINDOWS)
    passed = RUN_UP + jnp.cumsum(2 * halves)
    step = jnp.arange(length)
    window = jnp.searchsorted(passed, step, side="right")
    known = jnp.minimum(window, WINDOWS - 1)
    side = jnp.where(step < passed[known] - halves[known], 1.0, -1.0)
    side = jnp.where(window < WINDOWS, side, 0.0)
    between = jnp.stack([across[known], rises[known]], axis=1) * side[:, None]
    start = jnp.stack([within(PUSH, push_key), jnp.zeros(())])
    rates = jnp.where(step[:, None] < RUN_UP, start, between)

    def advance(point, rate):
        after = tracked.advance(point, rate)
        return after, after

    first = jnp.zeros(len(tracked.followed))
    _, after = jax.lax.scan(advance, first, rates)
    points = jnp.concatenate([first[None], after])
    places = points[:, jnp.asarray([0, 2])]
    return Course(points, places[passed], passed[-1])


def clearances(positions, windows, half):
    """Distance between the cage and the next wall in each step of a flight [m].

    Below 0 it hits.

    Args:
        positions: of the drone, (time, 2).
        windows: (window, 2).
        half: of the opening of the windows [m].
    """
    share = np.linspace(0.0, 1.0, SUBSTEPS, endpoint=False)[:, None, None]
    between = positions[:-1] + share * np.diff(positions, axis=0)
    away = between[:, :, None] - windows
    beside = np.maximum(half - np.abs(away[..., 1]), 0.0)
    return np.min(np.hypot(away[..., 0], beside), axis=(0, 2)) - RADIUS


def flights(policy, system, *, runs):
    """Fly the policy, its law and the nominal planner through the same windows.

    Args:
        policy: of the drone.
        system: with its step.
        runs: number of flights.

    Returns:
        The courses; what is flown through; and the runs by the name of the controller.
    """
    tracked = policy.loop.tracked
    course_key, scene_key, fly_key = jax.random.split(jax.random.key(SEED), 3)
    steps = RUN_UP + 2 * WINDOWS * HALF[1] + 10
    scenes = random_scenes(policy, scene_key, runs=runs, duration=steps * system.dt)
    keys = jax.random.split(course_key, runs)
    courses = jax.vmap(
        lambda key: random_course(tracked, key, length=steps + policy.horizon)
    )(keys)

    def start(points, env):
        rates = tracked.rates_between(points[:2])[0]
        steady = policy.loop.law.at(tracked.inputs(points[0], rates), env)
        return tracked.state(steady.state, points[0])

    starts = jax.vmap(start)(courses.points, scenes.envs[:, 0])
    scenes = scenes._replace(reference=courses.points, start=starts)
    controllers = {"policy": (policy.controller, policy.params)}
    for name, controller in rivals(policy, system).items():
        controllers[name] = controller, {}
    flown = {
        name: run_controller(policy, system.step, controller, params, scenes, fly_key)
        for name, (controller, params) in controllers.items()
    }
    return courses, scenes, flown


def line_of(policy, courses, flown):
    """The line of JSON of flights."""
    bound = policy.certificate.tubes.outputs["position"].total
    half = RADIUS + bound
    windows = np.asarray(courses.windows)
    line = {"flights": len(windows), "windows": windows.shape[1], "opening_m": 2 * half}
    line["bound_m"] = bound
    for name, run in flown.items():
        positions = np.asarray(run.states)[..., :2]
        clear = np.array(
            [
                clearances(path[: steps + 10], gaps, half).min()
                for path, gaps, steps in zip(
                    positions, windows, np.asarray(courses.steps), strict=True
                )
            ]
        )
        line[name] = {
            "collisions": int(np.sum(clear <= 0.0)),
            "clearance_m": round(float(clear.min()), 4),
            "largest_error_m": round(float(np.max(run.errors)), 4),
        }
    line["policy"]["beyond"] = flown["policy"].beyond
    line["policy"]["claimed"] = float(flown["policy"].claimed.mean())
    return line


def flight_for_film(courses, scenes, flown, half):
    """Arrays of the flight in which the nominal planner is farthest off.

    The film ends soon after the last window.

    Args:
        courses: of `flights`, like the two that follow.
        scenes: what is flown through.
        flown: runs by controller.
        half: of the opening of the windows [m].
    """
    number = int(np.argmax(np.max(flown["nominal"].errors, axis=(1, 2))))
    shown = slice(0, int(courses.steps[number]) + 10)
    flight = {
        name: np.asarray(flown[name].states[number, shown])
        for name in ("policy", "nominal")
    }
    # Beyond the end: it is seen ahead of the drone.
    flight["reference"] = np.asarray(courses.points[number])
    flight["envs"] = np.asarray(scenes.envs[number, shown])
    flight["windows"] = np.asarray(courses.windows[number])
    # Where the nominal drone stops, if it hits a wall.
    gaps = clearances(flight["nominal"][:, :2], flight["windows"], half)
    hits = np.flatnonzero(gaps <= 0.0)
    flight["end"] = hits[0] if len(hits) else len(gaps)
    return flight


def main():
    """Print the line, and write it with a film if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="run directory of the quadrotor")
    parser.add_argument("--runs", type=int, default=200, help="number of flights")
    parser.add_argument(
        "--write", action="store_true", help="write drone.json and film"
    )
    given = parser.parse_args()
    system, _ = runpy.run_path(str(EXAMPLE))["make"]()
    policy = sfkd_jax.load(given.run)
    courses, scenes, flown = flights(policy, system, runs=given.runs)
    line = line_of(policy, courses, flown)
    print(json.dumps(line | stamp()), flush=True)
    if given.write:
        text = f"{json.dumps(line | stamp())}\n"
        HOME.joinpath("drone.json").write_text(text, "utf-8")
        bound = line["bound_m"]
        flight = flight_for_film(courses, scenes, flown, RADIUS + bound)
        pictures = DroneFilm(flight, dt=system.dt, radius=RADIUS, bound=bound)
        film.write(HOME.parent / "docs" / "drone.gif", pictures)


if __name__ == "__main__":
    main()
