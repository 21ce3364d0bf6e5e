"""Control steps and parallel episodes of the shipped policies on this device.

    python -m benchmarks.device [--samples 1500 8192] [--episodes 64] [--out FILE]

measures time and memory of a jitted control step by the number of samples; with several
numbers also by horizon and by the number of vehicles. Then it simulates one-minute S3
episodes at once and counts the share that stays in the certified corridor.

    python -m benchmarks.device --planners 16

drives so many roads with each planner instead. With the environment variable
XLA_FLAGS=--xla_force_host_platform_device_count=2 the samples are spread over two devices.
"""

import json
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import arguments, stamp
from sfkd_jax.driving import paths, scenarios, simulation

SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
CARS = ("dynamic", "kinematic")
FEW = 300
"""Samples of each of several vehicles."""
DEFAULTS = {
    "samples": [1500],
    "steps": 200,
    "episodes": 16,
    "planners": 0,
    "seed": 2026,
}
PERIOD = 0.1
"""Of the control [s]."""
HORIZON = 20
"""Steps of a plan."""
SETTLED = 20
"""Steps at the start of an episode that do not count."""
PLANNERS = {
    "law alone": {"num_samples": 1},
    "MPPI, 16 samples": {"num_samples": 16},
    "MPPI, 300 samples": {"num_samples": 300},
    "MPPI, 1500 samples": {"num_samples": 1500},
    "MPPI, 16 samples, no shrinkage": {"num_samples": 16, "shrinkage": False},
    "MPPI, 1500 samples, no shrinkage": {"num_samples": 1500, "shrinkage": False},
    "CEM, 3 × 500 samples": {"planner": "cem", "num_samples": 500, "elites": 50},
    "gradient, 1 iteration": {"planner": "gradient", "iterations": 1},
    "gradient, 5 iterations": {"planner": "gradient", "iterations": 5},
}
"""What differs from the shipped planner."""
ROADS = {"dynamic": "s3", "kinematic": "s2"}
"""Scenarios on which planners are compared."""


def loaded(name, samples=1500, *, planner="mppi", **changes):
    """The shipped policy along a path with another planner, or with changed settings."""
    directory = SHIPPED / f"{name}_path"
    settings = dict(sfkd_jax.load(directory).settings["controller"])
    shipped = settings.pop("mppi") | {"num_samples": samples}
    if planner != "mppi":
        shipped = {key: shipped[key] for key in ("noise_std", "horizon")}
    settings |= {"planner": planner, planner: shipped | changes}
    return sfkd_jax.load(directory, controller=settings)


def family(plant, name, duration, **options):
    """A scenario for a vehicle: (key) -> Scenario."""
    return scenarios.scenario(
        name=name,
        duration=duration,
        state_size=len(plant.state_names),
        dt=plant.dt,
        **options,
    )


def driving(plant, controller, params, **options):
    """(scenario, key) -> an episode of a vehicle, through its sensors."""
    options = {
        "dt": PERIOD,
        "horizon": HORIZON,
        "observation_noise": plant.sensor_noise,
        "size": plant.size,
    } | options
    return partial(simulation.simulate, plant.step, controller, params, **options)


def fresh_episodes(policy, scenario, duration):
    """(keys) -> distances from the path of episodes on roads of their own."""
    sample = family(policy.vehicle, scenario, duration)
    drive = driving(policy.vehicle, policy.controller, policy.params)

    def one(key):
        road_key, run_key = jax.random.split(key)
        return drive(sample(road_key), run_key).lateral

    return jax.jit(jax.vmap(one))


def rmse_mm(lateral):
    """Lateral RMSE of every episode [mm]."""
    lateral = np.asarray(lateral, np.float64)
    return 1e3 * np.sqrt(np.mean(lateral**2, axis=1))


def control_step(name, steps, *, vehicles=1, at_once=1, **changes):
    """Time of one control step of one of several vehicles, in batches of `at_once`.

    What a single vehicle observes comes from the host, and its control goes back; its
    samples are spread over all devices.
    """
    policy = loaded(name, **changes)
    keys = jax.random.key(0)
    horizon = policy.interface["horizon"]
    steps = max(steps // vehicles, 10)
    episode = jax.jit(family(policy.vehicle, "s3", 15.0))(keys)
    ahead = paths.reference_window(
        episode.path, jnp.zeros(()), episode.speed, dt=PERIOD, horizon=horizon
    )
    seen = episode.initial_state, episode.envs[0], ahead
    init = policy.controller.init
    act_of_one = partial(policy.controller.act, policy.params)
    act = act_of_one
    if vehicles > 1:
        seen = jax.tree.map(lambda leaf: jnp.stack([leaf] * vehicles), seen)
        keys = jax.random.split(keys, vehicles)
        init = jax.vmap(init)

        def act(*of_all):
            return jax.lax.map(
                lambda inputs: act_of_one(*inputs), of_all, batch_size=at_once
            )

    seen = jax.tree.map(np.asarray, seen)
    axis_types = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((jax.device_count(),), ("samples",), axis_types)
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    # As it comes back, or the second step would compile again.
    memory = jax.device_put(init(keys), everywhere)
    jitted = jax.jit(act)
    times = []
    with jax.set_mesh(mesh):
        needed = jitted.lower(memory, *seen).compile().memory_analysis()
        for _ in range(steps + 5):
            start = time.perf_counter()
            control, memory, _ = jitted(memory, *seen)
            np.asarray(control)
            times.append(1e3 * (time.perf_counter() - start) / vehicles)
    return {
        "samples": changes.get("num_samples"),
        "vehicles": vehicles,
        "at_once": at_once,
        "horizon": horizon,
        "devices": jax.device_count(),
        "median_ms": float(np.median(times[5:])),
        "p99_ms": float(np.quantile(times[5:], 0.99)),
        "memory_mib": needed.temp_size_in_bytes / 2**20,
        "compilations": jitted._cache_size(),
    }


def scales(samples):
    """What is measured: samples, horizons, vehicles."""
    for number in samples:
        yield {"num_samples": number}
    if len(samples) > 1:
        for horizon in (10, 50, 100):
            yield {"num_samples": samples[0], "horizon": horizon}
        for at_once, vehicles in ((16, 16), (16, 256), (256, 256)):
            yield {"num_samples": FEW, "vehicles": vehicles, "at_once": at_once}


def episodes(name, samples, count, seed):
    """One-minute episodes of S3, all at once."""
    policy = loaded(name, samples)
    many = fresh_episodes(policy, "s3", 60.0)
    keys = jax.random.split(jax.random.key(seed), count)
    # The first call compiles.
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        lateral = np.abs(many(keys))
        seconds.append(time.perf_counter() - began)
    largest = lateral.max(axis=1)
    width = policy.certificate.corridor.corridor_m
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


def compared(name, count, seed):
    """Time of a control step and error of every planner, on the same roads."""
    keys = jax.random.split(jax.random.key(seed), count)
    errors_of_law = None
    for label, changes in PLANNERS.items():
        took = control_step(name, 200, **changes)["median_ms"]
        drive = fresh_episodes(loaded(name, **changes), ROADS[name], 30.0)
        errors = rmse_mm(drive(keys)[:, SETTLED:])
        if errors_of_law is None:
            errors_of_law = errors
        ratio = errors / errors_of_law
        yield {
            "planner": label,
            "median_ms": took,
            "rmse_mm": float(np.mean(errors)),
            "over_law": float(np.mean(ratio)),
            "standard_error": float(np.std(ratio, ddof=1) / np.sqrt(count)),
        }


def main():
    """Measure, print and store."""
    options = arguments(__doc__, __file__, cars=CARS, **DEFAULTS)
    device = jax.devices()[0].device_kind
    if jax.device_count() > 1:
        device = f"{jax.device_count()} x {device}"
    for name in options.cars:
        policy = f"{name}_path"
        made_by = stamp(policy)
        if options.planners:
            roads = options.planners, options.seed
            rows = [row | made_by for row in compared(name, *roads)]
            found = {"roads, seed": roads, "planners": rows}
        else:
            steps = [
                control_step(name, options.steps, **scale) | made_by
                for scale in scales(options.samples)
            ]
            found = {"control_step": steps}
            if options.episodes:
                driven = episodes(
                    name, options.samples[0], options.episodes, options.seed
                )
                found["s3"] = driven | made_by
        print(name, json.dumps(found), flush=True)
        # One file for all devices and cars: what was measured before stays.
        known = json.loads(options.out.read_text()) if options.out.exists() else {}
        about = known.setdefault("devices", {}).setdefault(device, {})
        about["jax"] = jax.__version__
        policies = about.setdefault("policies", {})
        policies.setdefault(policy, {}).update(found)
        options.out.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
