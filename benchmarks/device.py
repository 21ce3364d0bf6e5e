"""Control steps and parallel episodes of the shipped policies on this device.

python -m benchmarks.device [--samples 1500 8192] [--episodes 64] [--out FILE]: median and
99 % time of a jitted control step by the number of samples, and one-minute S3 episodes
simulated at once, with the share that stays in the certified corridor.
"""

import json
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import arguments
from sfkd_jax import evaluation, scenarios

SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
CARS = ("dynamic", "kinematic")
NOISE = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
HORIZON, SETTLED, PERIOD = 20, 20, 0.1
"""Steps of a plan; at the start of an episode that do not count; of the policies [s]."""


def loaded(name, samples, **changes):
    """The shipped policy along a path with another number of samples, and settings."""
    directory = SHIPPED / f"{name}_path"
    settings = sfkd_jax.load(directory).settings["controller"]
    mppi = settings["mppi"] | {"num_samples": samples}
    return sfkd_jax.load(directory, controller=settings | {"mppi": mppi} | changes)


def family(plant, name, duration, **options):
    """A scenario for a vehicle."""
    about = {"state_size": len(plant.state_names), "dt": plant.dt}
    return scenarios.scenario(name=name, duration=duration, **about, **options)


def driving(step, controller, params, **options):
    """(scenario, key) -> an episode, through the sensors."""
    options = {"dt": PERIOD, "horizon": HORIZON, "observation_noise": NOISE} | options
    return partial(evaluation.simulate, step, controller, params, **options)


def fresh_episodes(policy, scenario, duration):
    """(keys) -> distances from the path of episodes on roads of their own."""
    sample = family(policy.vehicle, scenario, duration)
    drive = driving(policy.vehicle.step, policy.controller, policy.params)

    def one(key):
        road_key, run_key = jax.random.split(key)
        return drive(sample(road_key), run_key).lateral

    return jax.jit(jax.vmap(one))


def rmse_mm(lateral):
    """Lateral RMSE of every episode [mm]."""
    lateral = np.asarray(lateral, np.float64)
    return 1e3 * np.sqrt(np.mean(lateral**2, axis=1))


def control_step(name, samples, steps, **changes):
    """Wall time of one control step, transfers of state and control included."""
    policy = loaded(name, samples, **changes)
    episode = jax.jit(family(policy.vehicle, "s3", 10.0))(jax.random.key(0))
    reference = scenarios.reference_window(
        episode.path,
        jnp.zeros(()),
        episode.speed,
        dt=policy.vehicle.dt,
        horizon=HORIZON,
    )
    act = jax.jit(policy.controller.act)
    memory = policy.controller.init(jax.random.key(0))
    seen = map(np.asarray, (episode.initial_state, episode.envs[0], reference))
    seen, times = tuple(seen), []
    for _ in range(steps + 5):
        start = time.perf_counter()
        control, memory, _ = act(policy.params, memory, *seen)
        np.asarray(control)
        times.append(1e3 * (time.perf_counter() - start))
    return {
        "median_ms": float(np.median(times[5:])),
        "p99_ms": float(np.quantile(times[5:], 0.99)),
        "first_s": 1e-3 * times[0],
        "compilations": act._cache_size(),
    }


def episodes(name, samples, count, seed):
    """One-minute episodes of S3, all at once."""
    policy, seconds = loaded(name, samples), []
    many = fresh_episodes(policy, "s3", 60.0)
    keys = jax.random.split(jax.random.key(seed), count)
    for _ in range(2):
        began = time.perf_counter()
        lateral = np.abs(many(keys))
        seconds.append(time.perf_counter() - began)
    largest = lateral.max(axis=1)
    width = policy.certificate["corridor"]["corridor_m"]
    return {
        "episodes": count,
        "seconds": seconds[1],
        "first_s": seconds[0],
        "steps_per_s": count * 600 / seconds[1],
        "rmse_mm": float(1e3 * np.sqrt(np.mean(lateral[:, SETTLED:] ** 2))),
        "largest_m": float(largest.max()),
        "corridor_m": width,
        "inside": float(np.mean(largest <= width)),
    }


def main():
    """Measure, print and store."""
    asked = arguments(
        __doc__, __file__, cars=CARS, samples=[1500], steps=200, episodes=16, seed=2026
    )
    device = jax.devices()[0].device_kind
    for name in asked.cars:
        steps = {
            str(samples): control_step(name, samples, asked.steps)
            for samples in asked.samples
        }
        found = {"control_step": steps}
        if asked.episodes:
            found["s3"] = episodes(name, asked.samples[0], asked.episodes, asked.seed)
        print(name, json.dumps(found), flush=True)
        # One file for all devices and cars: what was measured before stays.
        known = json.loads(asked.out.read_text()) if asked.out.exists() else {}
        about = known.setdefault("devices", {}).setdefault(device, {})
        about["jax"] = jax.__version__
        about.setdefault("policies", {})[f"{name}_path"] = found
        asked.out.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
