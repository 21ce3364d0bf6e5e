"""Round obstacles that are seen late: placed by chance, by an enemy, and pedestrians.

    python -m benchmarks.lane [--cars dynamic --systems lane --rows random --runs 200]

Three systems drive the true cars on the same roads, with the schedule and the sensor noise
of S3: the policy in its lane; MPPI that knows the car (oracle), whose plans must keep clear
of what is in view; and the same inside the gate and shield of the policy, along
the road. A fourth one, the policy with `reverse=True` in a car that drives backwards as well,
meets the pedestrians alone. The results go to benchmarks/lane.json, one line a row. A row that is there is not
measured again.
"""

import json
import time
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import arguments, as_lines, device, search, stamp, total
from benchmarks.device import CARS, HORIZON, PERIOD, driving
from benchmarks.recovery import shown
from sfkd_jax import control, models
from sfkd_jax.driving import path_following, paths, scenarios
from sfkd_jax.driving.lanes import circles, clearance
from sfkd_jax.types import Controller

STEPS = 600
"""Of a run."""
IN_VIEW = 4
"""Obstacles that are shown at once."""
MARGIN = 0.3
"""Distance that MPPI keeps from obstacles [m]."""
EDGE = 5.25
"""Distance from the middle of the road to its edges [m]."""
APPEAR = 40.0
"""Distance at which an enemy's obstacle is seen at the latest [m]."""
SUDDEN = 15.0
"""Distance at which a pedestrian is seen [m]."""
GUARDED = " in the guard"
REVERSING = "lane, reversing"
SYSTEMS = ("lane", "oracle", "oracle" + GUARDED, REVERSING)


class Car:
    """A shipped policy, its true car, and the systems that drive it."""

    def __init__(self, name, samples):
        self.policy = device.loaded(name, samples)
        self.plant = self.policy.vehicle
        self.samples = samples

    def system(self, name):
        """A controller of scenes, whose params are those of the policy."""
        if name in ("lane", REVERSING):
            return self.policy.in_lane(reverse=name == REVERSING)
        task = path_following.path_tracking(
            models.physics(self.plant.step),
            path_following.tracking_cost(dt=PERIOD),
            path_following.path_feedback(wheelbase=self.plant.wheelbase),
            dt=PERIOD,
            control_low=self.plant.control_low,
            control_high=self.plant.control_high,
        )
        nothing = jnp.zeros((IN_VIEW, 2)), jnp.zeros(IN_VIEW), jnp.zeros(IN_VIEW)
        clear = control.constrained(task, partial(too_near, self.plant.size), nothing)
        planner = control.mppi(clear, num_samples=self.samples, horizon=HORIZON)
        free = Controller(planner.init, lambda _, *rest: planner.act({}, *rest))
        return on_road(self.policy.shield(free) if name.endswith(GUARDED) else free)

    def program(self, name):
        """(scenarios) -> what is recorded of their episodes, (run, time)."""
        # The oracle claims nothing.
        record = {"corridor": lambda info: info.claim.bound} if name != "oracle" else {}
        plant = that_reverses(self.plant) if name == REVERSING else self.plant
        episode = driving(plant, self.system(name), self.policy.params, record=record)

        def run(scenario, key):
            made = episode(scenario, key)
            # From the middle of the road, also where another reference is followed.
            foot = jax.vmap(paths.point_at, (None, 0))(scenario.path, made.progress)
            away = made.states[1:, :2] - foot[:, :2]
            yaw = foot[:, 2]
            middle = away[:, 1] * jnp.cos(yaw) - away[:, 0] * jnp.sin(yaw)
            return {
                "along": made.progress,
                "speed": made.states[1:, 3],
                "corridor": jnp.full(STEPS, jnp.nan),
                **made.signals,
                "lateral": made.lateral,
                "middle": middle,
            }

        alone = jax.jit(run)
        together = jax.jit(jax.vmap(run))

        def drive(roads):
            # The same noise for every system.
            keys = jax.random.split(jax.random.key(36), len(roads.speed))
            if jax.default_backend() != "cpu":
                return jax.tree.map(np.asarray, together(roads, keys))
            runs = (
                jax.tree.map(lambda leaf, number=number: leaf[number], (roads, keys))
                for number in range(len(keys))
            )
            driven = [alone(scenario, key) for scenario, key in runs]
            return jax.tree.map(lambda *leaves: np.stack(leaves), *driven)

        return drive


def that_reverses(plant):
    """A car that drives backwards where it is told to at rest; slowly, without slip."""

    def step(state, control, env):
        steering, drive = control[:2]
        speed = state[3]
        after = speed + PERIOD * drive
        way = 0.5 * PERIOD * (speed + after)
        turned = way * jnp.tan(steering) / plant.wheelbase
        yaw = state[2] + 0.5 * turned
        moved = jnp.zeros_like(state).at[:2].set(state[:2])
        moved = moved.at[:2].add(way * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]))
        moved = moved.at[2:4].set(jnp.stack([state[2] + turned, after]))
        backwards = (speed < 0.0) | ((speed == 0.0) & (drive < 0.0))
        return jnp.where(backwards, moved, plant.step(state, control, env))

    return plant._replace(step=step)


def too_near(size, data, state, action, target, at):
    """How much nearer than `MARGIN` a car of this size is to the circles in view [m]."""
    position, radius, present = data
    seen = circles(position, radius)._replace(present=present > 0.5)
    direction = jnp.stack([jnp.cos(state[2]), jnp.sin(state[2])])
    apart = clearance(seen, state[:2], direction=direction, half=size.half)
    return jnp.maximum(MARGIN - apart, -1e3)


def on_road(controller):
    """A controller of references, given the middle of the road and what is in view."""

    def act(params, memory, seen, env, scene):
        lane, obstacles = scene
        along, inner = memory
        along, _ = paths.project(lane.path, seen[:2], along + 1.0)
        ahead = paths.reference_window(
            lane.path, along, lane.speed[0], dt=PERIOD, horizon=HORIZON
        )
        present = obstacles.present.astype(float)
        data = obstacles.position[:, 0], obstacles.radius, present
        inner = control.tuned(inner, constraints=data)
        action, inner, info = controller.act(params, inner, seen, env, ahead)
        return action, (along, inner), info

    return Controller(lambda key: (jnp.zeros(()), controller.init(key)), act)


def courses(car, count, seed):
    """Roads of the scenario."""
    bends = {"peak_curvature": 0.004, "wavelengths": (100.0, 300.0)}
    family = device.family(car.plant, "obstacles", STEPS * PERIOD, **bends)
    return jax.jit(jax.vmap(family))(jax.random.split(jax.random.key(seed), count))


def placed(roads, along, aside, view, *, radius, until):
    """The same roads with other obstacles.

    Args:
        roads: from `courses`.
        along: arc length of every obstacle [m], (run, obstacle).
        aside: distance from the middle of the road to the left [m].
        view: distance at which each is seen first [m].
        radius: of all of them [m].
        until: arc length after which there is none [m].
    """
    along, aside, view = (
        jnp.asarray(np.broadcast_to(one, np.shape(along)), jnp.float32)
        for one in (along, aside, view)
    )
    place = jax.jit(jax.vmap(scenarios.beside))(roads.path, along, aside)
    every = roads.course.obstacles._replace(
        position=place[:, :, None],
        radius=jnp.full(along.shape, radius),
        present=along < until,
    )
    course = roads.course._replace(obstacles=every, along=along, view=view)
    return roads._replace(course=course)


def counted(car, made):
    """What a row says about its runs."""
    gap = made["gap"]
    nearest = gap.min(axis=1)
    far = np.abs(made["lateral"])
    claim = made["corridor"]
    side = np.abs(made["middle"]) + car.plant.size.half[1]
    return {
        "runs": len(gap),
        "collisions": int((nearest < 0.0).sum()),
        "left_the_lane": int((side > EDGE).any(axis=1).sum()),
        "clearance_below_claim": int((gap < made["clearance"]).sum()),
        "beyond_corridor": int((far > claim).sum()),
        "steps": gap.size,
        "in_domain": shown(np.isfinite(claim).mean(), 4),
        "worst_lateral_m": shown(np.where(np.isfinite(claim), far, 0.0).max()),
        "corridor_m": shown(car.policy.certificate.corridor.corridor_m),
        "smallest_clearance_m": shown(nearest.min()),
        "mean_speed": shown(made["speed"].mean(), 2),
        "progress_m": shown(made["along"][:, -1].mean(), 1),
        "stand": int((made["speed"][:, -1] < 0.1).sum()),
    }


def random_rows(car, drive, options):
    """Courses of the scenario."""
    yield "random courses", counted(car, drive(courses(car, options.runs, 35)))


def pedestrian_rows(car, drive, options):
    """Somebody steps out onto the road and stands there, once in a run."""
    draw = np.random.default_rng(37)
    roads = courses(car, options.runs, 37)
    half = options.runs // 2
    shape = roads.course.along.shape
    along = 90.0 + 200.0 * np.arange(shape[1]) + draw.uniform(0.0, 10.0, (shape[0], 1))
    aside = draw.uniform(-1.5, 1.5, shape)
    envs = np.zeros(roads.envs.shape, np.float32)
    envs[:half, :, 0] = 0.9
    envs[half:, :, 0] = 0.3
    roads = roads._replace(envs=jnp.asarray(envs), observed_envs=jnp.asarray(envs))
    made = drive(placed(roads, along, aside, SUDDEN, radius=0.3, until=150.0))
    for friction, mine in ((0.9, slice(half)), (0.3, slice(half, None))):
        part = jax.tree.map(lambda leaf, mine=mine: leaf[mine], made)
        yield f"pedestrian, friction {friction}", counted(car, part)


def enemy_rows(car, drive, options):
    """Places, and when they are seen first, by a cross-entropy search."""
    draw = np.random.default_rng(39)
    base = courses(car, options.runs, 39)
    found = []
    hits = []

    def roads(genes, latest):
        gaps, sides, sight = np.split(np.clip(genes, -1.0, 1.0), 3, axis=1)
        along = 45.0 + np.cumsum(40.0 + 20.0 * gaps, axis=1)
        view = latest + 10.0 * (sight + 1.0)
        return placed(base, along, 3.0 * sides, view, radius=0.8, until=640.0)

    def reward(genes):
        made = drive(roads(genes, APPEAR))
        near = made["gap"].min(axis=1)
        found.append(counted(car, made))
        # Whoever sees all at once and passes had a reference that was admissible.
        if (near < 0.0).any():
            known = drive(roads(genes, 500.0))["gap"].min(axis=1)
            hits.append(int(((near < 0.0) & (known >= 0.0)).sum()))
        # Of those that come as near, the slower run is worse.
        return -near - 1e-4 * made["along"][:, -1]

    size = options.runs, 3 * base.course.along.shape[1]
    search(draw, size, options.generations, reward)
    whole = total(found)
    whole["smallest_clearance_m"] = min(one["smallest_clearance_m"] for one in found)
    whole["avoidable"] = sum(hits)
    yield "enemy", whole


def time_rows(car, drive, options):
    """A step of the controller, with a search for a reference and without one."""
    driver = car.system("lane")
    act = jax.jit(driver.act)
    roads = courses(car, 1, 41)
    path, lane = jax.tree.map(lambda leaf: leaf[0], (roads.path, roads.course.lane))
    along = jnp.asarray([30.0, 55.0, 75.0, 95.0])
    aside = jnp.asarray([1.0, -1.0, 1.0, -1.0])
    place = scenarios.beside(path, along, aside)
    params = car.policy.params
    env = jnp.asarray([0.9, 0.0])
    state = jnp.zeros(len(car.plant.state_names))
    state = state.at[:4].set(path.points[0].at[3].set(10.0))
    for label, steps in (("standing", 1), ("moving", 60)):
        walk = 0.02 * jnp.arange(steps)[:, None] * jnp.asarray([0.0, 1.0])
        seen = circles(place, 0.8)._replace(position=place[:, None] + walk)
        scene = lane, seen
        first = driver.init(jax.random.key(0))
        _, memory, _ = act(params, first, state, env, scene)
        fastest = {}
        # With a wait of 0 every step searches, with 2 none does.
        for wait in (0, 2):
            began = memory._replace(wait=jnp.asarray(wait))
            times = []
            for _ in range(300):
                start = time.perf_counter()
                jax.block_until_ready(act(params, began, state, env, scene))
                times.append(1e3 * (time.perf_counter() - start))
            # The least: other programs on the machine only add.
            fastest[wait] = min(times)
        yield (
            f"obstacles {label}",
            {
                "step_ms": shown(fastest[0], 2),
                "search_ms": shown(fastest[0] - fastest[2], 2),
            },
        )


ROWS = {
    "random": random_rows,
    "pedestrian": pedestrian_rows,
    "enemy": enemy_rows,
    "time": time_rows,
}


def main():
    """Drive, print and write."""
    options = arguments(
        __doc__,
        __file__,
        cars=CARS,
        systems=SYSTEMS,
        rows=ROWS,
        runs=200,
        generations=4,
        samples=1500,
    )
    began = time.perf_counter()
    rows = json.loads(options.out.read_text("utf-8")) if options.out.exists() else []
    about = {"samples": options.samples, "device": jax.devices()[0].device_kind}
    done = {(row["car"], row["system"], row["group"]) for row in rows}
    for name, system in product(options.cars, options.systems):
        missing = [
            group
            for group in options.rows
            if (name, system, group) not in done
            and (group != "time" or system == "lane")
            and (group == "pedestrian" or system != REVERSING)
        ]
        if not missing:
            continue
        car = Car(name, options.samples)
        drive = car.program(system)
        made_by = stamp(f"{name}_path")
        for group in missing:
            for label, found in ROWS[group](car, drive, options):
                named = {"car": name, "system": system, "group": group, "row": label}
                rows.append(named | found | about | made_by)
                print(f"{time.perf_counter() - began:6.1f} s", rows[-1], flush=True)
            # After every group: a run that is cut off goes on where it was.
            options.out.write_text(as_lines(rows) + "\n", "utf-8")


if __name__ == "__main__":
    main()
