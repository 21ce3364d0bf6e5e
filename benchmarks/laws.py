"""A trained policy driven by MPPI around different laws, with different numbers of samples, on the same episodes.

python benchmarks/laws.py RUN [--scenario s3 --episodes 6 --seconds 15], RUN a directory with policy.npz in it.
"""

import argparse
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from sfkd_jax import control, evaluation, scenarios
from sfkd_jax.assembly import build_vehicle

SENSORS = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
SPREAD = (0.02, 0.3)
KNOTS = {"noise": "rbf", "noise_knots": 4, "effective_samples": 30.0}


def contenders(plant):
    """Label -> law, number of samples, options."""
    feedback, model = control.path_feedback(wheelbase=plant.wheelbase), control.ModelLaw(dt=plant.dt)
    return {
        "path feedback, 1500": (feedback, 1500, {}),
        "path feedback, 1500, white noise": (feedback, 1500, {"noise": "white"}),
        "path feedback, 300": (feedback, 300, {}),
        "path feedback, 300, 4 knots, 30 effective": (feedback, 300, KNOTS),
        "model law, 1500": (model, 1500, {}),
        "model law, 300": (model, 300, {}),
        "model law alone": (model, 1, {"noise_std": (1e-6, 1e-6)}),
    }


def drive(policy, plant, law, samples, options, roads, keys):
    """Lateral RMSE of every episode [mm], and the mean steering rate [rad/s]."""
    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    box = {side: tuple(policy.settings["dataset"][side]) for side in ("env_low", "env_high")}
    task = control.path_tracking(policy.model, control.tracking_cost(dt=plant.dt), law, dt=plant.dt, **limits)
    planner = control.mppi(task, num_samples=samples, **{"noise_std": SPREAD, **box, **options})
    run = partial(evaluation.simulate, plant.step, planner, policy.params, dt=plant.dt, horizon=20)
    episodes = jax.jit(jax.vmap(partial(run, observation_noise=SENSORS)))(roads, keys)
    rate = np.abs(np.diff(np.asarray(episodes.controls)[..., 0], axis=1)).mean() / plant.dt
    return 1e3 * np.sqrt((np.asarray(episodes.lateral) ** 2).mean(axis=1)), rate


def main():
    """Parse, drive, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--scenario", default="s3")
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=2026)
    asked = parser.parse_args()
    policy = sfkd_jax.load(asked.run)
    plant = build_vehicle(policy.settings["vehicle"])
    sizes = {"duration": asked.seconds, "state_size": len(plant.state_names), "dt": plant.dt}
    road_key, drive_key = jax.random.split(jax.random.key(asked.seed))
    family = scenarios.scenario(name=asked.scenario, **sizes)
    roads = jax.jit(jax.vmap(family))(jax.random.split(road_key, asked.episodes))
    keys = jax.random.split(drive_key, asked.episodes)
    print(f"{plant.name} {asked.scenario}: lateral RMSE [mm], by episode, steering rate [rad/s], seconds")
    for label, (law, samples, options) in contenders(plant).items():
        began = time.perf_counter()
        found, rate = drive(policy, plant, law, samples, options, roads, keys)
        by_episode = " ".join(f"{value:.1f}" for value in found)
        print(f"{label:42} {found.mean():6.1f}  ({by_episode})  {rate:.3f}  {time.perf_counter() - began:.0f} s")
        assert jnp.all(jnp.isfinite(found))


if __name__ == "__main__":
    main()
