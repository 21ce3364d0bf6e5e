"""Round obstacles seen at 60 m: python examples/lane.py --runs 1 --seed 0."""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

import sfkd_jax
from sfkd_jax import build, evaluation, scenarios
from sfkd_jax.report import film

asked = {"--runs": 1, "--seed": 0, "--vehicle": "dynamic", "--film": "lane.gif"}
asked |= dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
policy = sfkd_jax.load(f"{sfkd_jax.__path__[0]}/pretrained/{asked['--vehicle']}_path")
plant, bound = policy.vehicle, policy.certificate["corridor"]
loop = {"dt": plant.dt, "observation_noise": bound["conditions"]["sensor_noise"]}
loop["size"] = plant.size
told = {"inside": "shield_healthy", "reference": "reference", "corridor": "corridor"}
loop["record"] = {k: lambda info, name=name: info[name] for k, name in told.items()}
road = {"name": "obstacles", "peak_curvature": 0.004, "wavelengths": (100.0, 300.0)}
course = jax.jit(build.build_scenario(road, plant, duration=60.0))
car = plant.step, policy.in_lane(), policy.params
run = jax.jit(lambda *given: evaluation.simulate(*car, *given, horizon=20, **loop))
keys = jax.random.split(jax.random.key(int(asked["--seed"])), int(asked["--runs"]))
drives = jax.tree.map(lambda *x: jnp.stack(x), *(run(course(k), k) for k in keys))
# The film: two obstacles, and a lane that is blocked.
place = jnp.array([[34.0, 64.0, 102.0, 102.0, 102.0], [1.2, -2.2, -3.5, 0.0, 3.5]])
scene, (along, aside) = course(keys[0]), jnp.pad(place, ((0, 0), (0, 11)), "edge")
there = {"position": scenarios.beside(scene.path, along, aside)[:, None]}
posts = scene.course.obstacles._replace(**there, present=jnp.arange(16) < 5)
scene = scene._replace(course=scene.course._replace(obstacles=posts, along=along))
shown = film.LaneFilm(scene, run(scene, keys[0]), dt=plant.dt, car=plant.size.half)
film.write(Path(asked["--film"]), shown)
seen, speed = drives.signals, drives.progress[:, -1].mean() / 60.0
found = {"runs": len(keys), "collisions": (seen["gap"].min(axis=1) < 0.0).sum()}
found |= {"clearance_below_claim": (seen["gap"] < seen["clearance"]).sum()}
found |= {"worst_lateral_m": abs(drives.lateral).max(), "mean_speed": speed}
found |= {"corridor_m": bound["corridor_m"], "in_domain": seen["inside"].mean()}
print(json.dumps({name: float(value) for name, value in found.items()}))
