"""The car passes parked cars on the road of S3: collisions with and without the certified corridor.

python -m benchmarks.quality.obstacles [--vehicles dynamic kinematic --episodes 200
--seconds 24 --seed 2030 --out benchmarks/quality/obstacles.json]
Every 60 m a car is parked so that a car in the middle of the lane would touch it, by 0.05
to 0.2 m, now left, now right. A planner chooses a path around them: 512 samples of its
curvature over 50 m ahead, constrained to keep the rectangles of the cars apart. "corridor
counted" keeps them apart by the certified half width of the corridor too. The shipped
policy follows the path inside its shield.
"""

import argparse
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import harness
from benchmarks.harness import SHIPPED
from benchmarks.quality.laws import SENSORS
from sfkd_jax import control, evaluation, scenarios
from sfkd_jax.build import build_vehicle

LENGTH, WIDTH = 4.5, 1.8
FIRST_M, EVERY_M = 60.0, 60.0
OVERLAP_M = (0.05, 0.2)
STEP_M, HORIZON = 1.0, 50
BEND = 0.01
"""Largest curvature on top of the road's [1/m]."""
ROWS = ("middle of the lane", "corridor not counted", "corridor counted")


def parked(road, key, length):
    """Boxes beside the path of a road: x, y, yaw, length, width, (car, 5)."""
    places = jnp.arange(FIRST_M, length, EVERY_M)
    side_key, overlap_key = jax.random.split(key)
    side = jax.random.rademacher(side_key, places.shape, float)
    low, high = OVERLAP_M
    overlap = jax.random.uniform(overlap_key, places.shape, minval=low, maxval=high)
    points = jax.vmap(partial(scenarios.point_at, road.path))(places)
    x, y = beside(points, side * (WIDTH - overlap))
    size = jnp.broadcast_to(jnp.asarray([LENGTH, WIDTH]), (places.size, 2))
    return jnp.column_stack([x, y, points[:, 2], size])


def beside(points, away):
    """x and y at a distance to the left of points of a path."""
    yaw = points[..., 2]
    return points[..., 0] - away * jnp.sin(yaw), points[..., 1] + away * jnp.cos(yaw)


def depth(xp, car, boxes):
    """How deep a car lies in others [m], negative apart: the separating axes.

    Args:
        xp: numpy or jax.numpy.
        car: x, y, yaw, (…, 3).
        boxes: x, y, yaw, length, width, (car, 5).
    """
    car = car[..., None, :]
    away = boxes[:, :2] - car[..., :2]
    apart = boxes[:, 2] - car[..., 2]
    cos, sin = xp.abs(xp.cos(apart)), xp.abs(xp.sin(apart))
    found = []
    for yaw in (car[..., 2], boxes[:, 2]):
        along = xp.abs(away[..., 0] * xp.cos(yaw) + away[..., 1] * xp.sin(yaw))
        aside = xp.abs(away[..., 1] * xp.cos(yaw) - away[..., 0] * xp.sin(yaw))
        found += [
            0.5 * (LENGTH + LENGTH * cos + WIDTH * sin) - along,
            0.5 * (WIDTH + LENGTH * sin + WIDTH * cos) - aside,
        ]
    return xp.min(xp.stack(found), axis=0)


def clearance(data, state, u, target, at):
    """The constraint of the path: rectangles apart by the margin."""
    point = scenarios.point_at(data["path"], state[0])
    x, y = beside(point, state[1])
    car = jnp.stack([x, y, point[2] + state[2]])
    return depth(jnp, car, data["boxes"]) + data["margin"]


def path_around(road, boxes, key, *, length, margin):
    """A path around parked cars, and whether every plan kept clear of them.

    State: arc length, offset [m] and its slope; control: curvature on top of the road's.
    """

    def dynamics(params, x, u, env):
        return x + STEP_M * jnp.stack([1.0, x[2], u[0]])

    def stage(weights, x, u, before, target):
        return 10.0 * x[1] ** 2 + 20.0 * x[2] ** 2 + 500.0 * u[0] ** 2

    task = control.free_task(
        dynamics, stage, control_low=(-BEND,), control_high=(BEND,)
    )
    data = {"path": road.path, "boxes": boxes, "margin": margin}
    planner = control.mppi(
        control.constrained(task, clearance, data),
        num_samples=512,
        horizon=HORIZON,
        noise="rbf",
        noise_knots=6,
        noise_std=(0.5 * BEND,),
        effective_samples=5.0,
    )

    def step(carry, _):
        x, memory = carry
        u, memory, info = planner.act({}, memory, x, jnp.zeros(0), ())
        after = dynamics({}, x, u, None)
        return (after, memory), (x, info["constraints_kept"])

    first = (jnp.zeros(3), planner.init(key))
    _, (along, kept) = jax.lax.scan(step, first, length=round(length / STEP_M))
    return shifted(road.path, along), jnp.all(kept)


def shifted(path, along):
    """The path at the offsets (arc length, offset, slope), resampled at its own length."""
    at = jax.vmap(partial(scenarios.point_at, path))
    x, y = beside(at(along[:, 0]), along[:, 1])
    moved = jnp.hypot(jnp.diff(x), jnp.diff(y))
    length = jnp.concatenate([jnp.zeros(1), jnp.cumsum(moved)])
    even = STEP_M * jnp.arange(length.size)
    s, away, slope = (jnp.interp(even, length, column) for column in along.T)
    points = at(s)
    yaw = points[:, 2] + jnp.arctan2(slope, 1.0 - points[:, 3] * away)
    bend = jnp.gradient(yaw) / STEP_M
    return scenarios.Path(
        jnp.column_stack([*beside(points, away), yaw, bend]), jnp.asarray(STEP_M)
    )


def measured(vehicle, args):
    """Every row of a vehicle on the same episodes."""
    policy = sfkd_jax.load(SHIPPED / f"{vehicle}_path")
    plant = build_vehicle(policy.settings["vehicle"])
    corridor = policy.certificate["corridor"]["corridor_m"]
    keys = jax.random.split(jax.random.key(args.seed), 4 * args.episodes)
    road_keys, car_keys, plan_keys, drive_keys = keys.reshape(4, args.episodes)
    family = scenarios.scenario(
        name="s3", duration=args.seconds, state_size=len(plant.state_names), dt=plant.dt
    )
    roads = jax.jit(jax.vmap(family))(road_keys)
    length = 10.0 * args.seconds
    boxes = jax.vmap(lambda road, key: parked(road, key, length - 20.0))(
        roads, car_keys
    )
    margins = dict(zip(ROWS, (None, 0.0, corridor), strict=True))
    rows = {}
    for row, margin in margins.items():
        driven, kept = roads, np.ones(args.episodes, bool)
        if margin is not None:
            around = partial(path_around, length=length + 60.0, margin=margin)
            path, kept = jax.jit(jax.vmap(around))(roads, boxes, plan_keys)
            driven = roads._replace(path=path)
        run = partial(
            evaluation.simulate,
            plant.step,
            policy.controller,
            policy.params,
            dt=plant.dt,
            horizon=20,
            observation_noise=SENSORS,
        )
        episodes = jax.jit(evaluation.over_episodes(run))(driven, drive_keys)
        states = np.asarray(episodes.states, np.float64)
        deepest = [
            depth(np, drive[:, :3], cars).max()
            for drive, cars in zip(states, np.asarray(boxes, np.float64), strict=True)
        ]
        rows[row] = {
            "collisions": int(np.sum(np.asarray(deepest) > 0.0)),
            "smallest_gap_m": float(-np.max(deepest)),
            "paths_that_keep_clear": int(np.sum(np.asarray(kept))),
            "largest_deviation_m": float(np.abs(np.asarray(episodes.lateral)).max()),
            "largest_curvature": float(
                np.abs(np.asarray(driven.path.points)[..., 3]).max()
            ),
        }
        print(vehicle, row, rows[row], flush=True)
    return {"rows": rows, "corridor_m": corridor, "cars": int(boxes[..., 0].size)}


def main():
    """Parse, drive, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", nargs="+", default=["dynamic", "kinematic"])
    for name, value in (("episodes", 200), ("seed", 2030)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--out")
    args = parser.parse_args()
    found = {name: measured(name, args) for name in args.vehicles}
    settings = {name: getattr(args, name) for name in ("episodes", "seed", "seconds")}
    settings |= {"overlap_m": OVERLAP_M, "every_m": EVERY_M}
    harness.write(
        args.out,
        {"vehicles": found, "settings": settings, "machine": harness.machine()},
    )


if __name__ == "__main__":
    main()
