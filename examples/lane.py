"""Round obstacles seen at 60 m: python examples/lane.py --runs 1 --seed 0."""

import json
import sys

import jax
import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation

import sfkd_jax
from sfkd_jax import evaluation, scenarios

asked = {"--runs": 1, "--seed": 0, "--vehicle": "dynamic"}
asked |= dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
policy = sfkd_jax.load(f"{sfkd_jax.__path__[0]}/pretrained/{asked['--vehicle']}_path")
plant, bound = policy.vehicle, policy.certificate["corridor"]
loop = {"dt": plant.dt, "observation_noise": bound["conditions"]["sensor_noise"]}
loop |= {"horizon": 20, "record": {"inside": lambda info: info["shield_healthy"]}}
road = {"peak_curvature": 0.004, "wavelengths": (100.0, 300.0), "duration": 60.0}
size = {"state_size": len(plant.state_names), "dt": plant.dt}
course = scenarios.scenario(name="obstacles", **road, **size)
car = plant.step, policy.in_lane(), policy.params
run = jax.jit(lambda key: evaluation.simulate(*car, course(key), key, **loop))
keys = jax.random.split(jax.random.key(int(asked["--seed"])), int(asked["--runs"]))
drives, first = jax.lax.map(run, keys), course(keys[0]).course
_, axes = plt.subplots(figsize=(9, 3), subplot_kw={"aspect": "equal"})
axes.plot(*first.lane.path.points[:, :2].T, ":", *drives.states[0, :, :2].T, "-")
_ = [axes.add_patch(plt.Circle(at, 0.8)) for at in first.obstacles.position[:, 0]]
axes.plot(9 / 59, 0.5, "ks", transform=axes.transAxes)
FuncAnimation(
    axes.figure,
    lambda at: axes.set(xlim=(at[0] - 9, at[0] + 50), ylim=(at[1] - 9, at[1] + 9)),
    drives.states[0, ::4],
).save("lane.gif", fps=8)
seen, speed = drives.signals, drives.progress[:, -1].mean() / 60.0
found = {"runs": len(keys), "collisions": (seen["gap"].min(axis=1) < 0.0).sum()}
found |= {"clearance_below_claim": (seen["gap"] < seen["clearance"]).sum()}
found |= {"worst_lateral_m": abs(drives.lateral).max(), "mean_speed": speed}
found |= {"corridor_m": bound["corridor_m"], "in_domain": seen["inside"].mean()}
print(json.dumps({name: float(value) for name, value in found.items()}))
