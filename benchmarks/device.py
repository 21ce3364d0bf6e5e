"""Control steps and parallel episodes of the shipped policies on this device.

python -m benchmarks.device [--samples 1500 8192] [--episodes 64] [--out FILE]: median and
99 % time of a jitted control step by the number of samples, and one-minute S3 episodes
simulated at once, with the share that stays in the certified corridor.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from sfkd_jax import evaluation, policy, scenarios

PRETRAINED = Path(sfkd_jax.__file__).with_name("pretrained")
HORIZON = 20


def loaded(name: str, samples: int, **changes):
    """The shipped policy with another number of samples, and other settings."""
    directory = PRETRAINED / name
    trained = policy.restore(directory)
    settings = trained.settings["controller"]
    mppi = settings["mppi"] | {"num_samples": samples}
    return trained, sfkd_jax.load(
        directory, controller=settings | {"mppi": mppi} | changes
    )


def family(trained: policy.TrainedModel, duration: float):
    """S3 for the vehicle of a policy."""
    plant = trained.vehicle
    states = len(plant.state_names)
    return scenarios.scenario(
        name="s3", duration=duration, state_size=states, dt=plant.dt
    )


def control_step(name: str, samples: int, steps: int, **changes) -> dict[str, float]:
    """Wall time of one control step, transfers of state and control included."""
    trained, loaded_policy = loaded(name, samples, **changes)
    episode = jax.jit(family(trained, 10.0))(jax.random.key(0))
    start, dt = jnp.zeros(()), trained.vehicle.dt
    reference = scenarios.reference_window(
        episode.path, start, episode.speed, dt=dt, horizon=HORIZON
    )
    act = jax.jit(loaded_policy.controller.act)
    memory = loaded_policy.controller.init(jax.random.key(0))
    x, e = np.asarray(episode.initial_state), np.asarray(episode.envs[0])
    reference = np.asarray(reference)
    times = []
    began = time.perf_counter()
    for step in range(steps + 5):
        start = time.perf_counter()
        control, memory, _ = act(loaded_policy.params, memory, x, e, reference)
        np.asarray(control)
        if step == 0:
            compiled = time.perf_counter() - began
        if step >= 5:
            times.append(1e3 * (time.perf_counter() - start))
    return {
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.quantile(times, 0.99)),
        "first_s": compiled,
        "compilations": act._cache_size(),
    }


def episodes(name: str, samples: int, count: int, seed: int) -> dict[str, float]:
    """One-minute episodes of S3, all at once."""
    trained, loaded_policy = loaded(name, samples)
    sample, plant = family(trained, 60.0), trained.vehicle
    run = partial(evaluation.simulate, plant.step, loaded_policy.controller)

    def one(key):
        road_key, run_key = jax.random.split(key)
        noise = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
        episode = run(
            loaded_policy.params,
            sample(road_key),
            run_key,
            dt=plant.dt,
            horizon=HORIZON,
            observation_noise=noise,
        )
        return jnp.max(jnp.abs(episode.lateral)), jnp.mean(episode.lateral[20:] ** 2)

    many = jax.jit(jax.vmap(one))
    keys = jax.random.split(jax.random.key(seed), count)
    began = time.perf_counter()
    jax.block_until_ready(many(keys))
    first = time.perf_counter() - began
    began = time.perf_counter()
    largest, squared = jax.block_until_ready(many(keys))
    seconds = time.perf_counter() - began
    width = (loaded_policy.certificate or {}).get("corridor", {}).get("corridor_m")
    result = {
        "episodes": count,
        "seconds": seconds,
        "first_s": first,
        "steps_per_s": count * 600 / seconds,
        "rmse_mm": float(1e3 * np.sqrt(np.mean(squared))),
        "largest_m": float(np.max(largest)),
    }
    if width:
        result |= {"corridor_m": width, "inside": float(np.mean(largest <= width))}
    return result


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="+", default=[1500])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument(
        "--policies", nargs="+", default=["dynamic_path", "kinematic_path"]
    )
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    device = jax.devices()[0].device_kind
    policies = {}
    for name in asked.policies:
        steps = {
            str(samples): control_step(name, samples, asked.steps)
            for samples in asked.samples
        }
        policies[name] = {"control_step": steps}
        print(name, json.dumps(steps), flush=True)
        if asked.episodes:
            found = episodes(name, asked.samples[0], asked.episodes, asked.seed)
            policies[name]["s3"] = found
            print(name, json.dumps(found), flush=True)
    if asked.out:
        # One file for all devices: the others' measurements stay.
        known = json.loads(asked.out.read_text()) if asked.out.exists() else {}
        known.setdefault("devices", {})[device] = {
            "jax": jax.__version__,
            "policies": policies,
        }
        asked.out.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
