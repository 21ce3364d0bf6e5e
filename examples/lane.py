"""A car drives in a lane and passes obstacles that it sees from 60 m on.

A policy that ships with the package drives `--runs` random courses of one minute each.
Friction, side wind and the noise of the sensors change while it drives. The program
prints how near the car came to the obstacles and to the limits of its certificate. Then
the same policy drives one course that ends before a blocked lane, and a film of that
drive is written.

    python examples/lane.py [--runs 1] [--seed 0] [--vehicle dynamic] [--film lane.gif]
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp

import sfkd_jax
from sfkd_jax import assembly
from sfkd_jax.driving import scenarios, simulation
from sfkd_jax.report import film as films
from sfkd_jax.report.lane_film import LaneFilm

SECONDS = 60.0
ROAD = {
    "name": "obstacles",
    "peak_curvature": 0.004,  # [1/m]
    "wavelengths": (100.0, 300.0),  # of the bends [m]
}
RECORDED = {
    "inside": lambda info: info.claim.holds,
    "reference": lambda info: info.lane.reference,
    "corridor": lambda info: info.claim.bound,
}
"""Signals of every control step that the film and the summary need."""
OBSTACLES_OF_THE_FILM = [
    (34.0, 1.2),
    (64.0, -2.2),
    (102.0, -3.5),
    (102.0, 0.0),
    (102.0, 3.5),
]
"""Distance along the road and to the left of its middle [m]; three block the lane."""


def compile_drive(policy):
    """Return the compiled function (scene, key) -> episode of a policy in its lane."""
    plant = policy.vehicle
    controller = policy.in_lane()
    sensor_noise = policy.certificate.corridor.conditions.sensor_noise

    def drive(scene, key):
        return simulation.simulate(
            plant.step,
            controller,
            policy.params,
            scene,
            key,
            dt=plant.dt,
            horizon=20,
            observation_noise=sensor_noise,
            size=plant.size,
            record=RECORDED,
        )

    return jax.jit(drive)


def replace_obstacles(scene, places):
    """Return the scene with other obstacles, (distance along, distance to the left)."""
    count = scene.course.along.shape[0]
    # The number of rows is fixed: those beyond the last obstacle are not present.
    padding = places[-1:] * (count - len(places))
    along, left = jnp.asarray(places + padding).T
    obstacles = scene.course.obstacles._replace(
        position=scenarios.beside(scene.path, along, left)[:, None],
        present=jnp.arange(count) < len(places),
    )
    course = scene.course._replace(obstacles=obstacles, along=along)
    return scene._replace(course=course)


def summarise(episodes, corridor):
    """Return what happened, over all runs and control steps.

    Args:
        episodes: whose arrays begin (run, time).
        corridor: certified half width [m].
    """
    gap = episodes.signals["gap"]
    clearance = episodes.signals["clearance"]
    return {
        "runs": len(gap),
        "collisions": (gap.min(axis=1) < 0.0).sum(),
        "clearance_below_claim": (gap < clearance).sum(),
        "worst_lateral_m": abs(episodes.lateral).max(),
        "mean_speed": episodes.progress[:, -1].mean() / SECONDS,
        "corridor_m": corridor,
        "in_domain": episodes.signals["inside"].mean(),
    }


def main(runs=1, seed=0, vehicle="dynamic", film="lane.gif"):
    """Drive random courses, write the film, and return the summary of the courses."""
    policy = sfkd_jax.load(f"{vehicle}_path")
    plant = policy.vehicle
    draw_scene = jax.jit(assembly.build_scenario(ROAD, plant, duration=SECONDS))
    drive = compile_drive(policy)

    keys = jax.random.split(jax.random.key(seed), runs)
    episodes = [drive(draw_scene(key), key) for key in keys]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *episodes)

    scene = replace_obstacles(draw_scene(keys[0]), OBSTACLES_OF_THE_FILM)
    episode = drive(scene, keys[0])
    picture = LaneFilm(scene, episode, dt=plant.dt, car=plant.size.half)
    films.write(Path(film), picture)

    summary = summarise(stacked, policy.certificate.corridor.corridor_m)
    return {name: float(value) for name, value in summary.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=1, help="number of random courses")
    parser.add_argument("--seed", type=int, default=0, help="of courses and noise")
    parser.add_argument(
        "--vehicle", default="dynamic", choices=("dynamic", "kinematic")
    )
    parser.add_argument("--film", default="lane.gif", help="file that the film goes to")
    print(json.dumps(main(**vars(parser.parse_args()))))
