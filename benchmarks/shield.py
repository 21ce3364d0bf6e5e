"""Planners that try to drive a car off its road, inside the shield of a policy and without it.

    python -m benchmarks.shield [--runs 200 --seconds 60]

The true cars of the two shipped path policies on S3 roads, observed through their sensors.
Asked for: inside the shield no car leaves its lane, whatever is planned. Writes
benchmarks/shield.json.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from sfkd_jax import build, control, evaluation, policy, scenarios, store
from sfkd_jax.geometry import LATERAL
from sfkd_jax.rollout import fold
from sfkd_jax.types import Controller

SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
CARS = ("dynamic", "kinematic")
PLANNERS = ("nothing", "worst", "bang-bang", "random", "constant", "NaN", "full lock")
"""ν = 0; at its limit, outwards of the measured e_y; to and fro with a period of 1 to 8 s;
to either side, drawn every step; to one side; not a number; u at the actuators' limits.
"""
LANE, BATCH, HORIZON = 0.85, 20, 20
"""Distance at which a car of 1.8 m leaves a lane of 3.5 m [m]; runs at once; steps."""


class Car(NamedTuple):
    """A certified policy and the plant that it drives."""

    trained: policy.TrainedModel
    params: dict
    certificate: dict

    @property
    def noise(self):
        """Standard deviation of the sensors that the corridor was calibrated with."""
        return tuple(self.certificate["corridor"]["conditions"]["sensor_noise"])


def load(name):
    """The shipped policy of a car."""
    trained = policy.restore(SHIPPED / f"{name}_path")
    certificate, _ = policy.read_certificate(SHIPPED / f"{name}_path", trained)
    params = jax.jit(partial(fold, trained.model))(trained.params)
    return Car(trained, params, certificate)


def hostile(car, kind):
    """A planner of `PLANNERS` along a path, by its index, which may be traced."""
    plant, law = car.trained.vehicle, car.trained.law
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)

    def act(params, state, xi, env, preview):
        key, step = state
        streams = (jax.random.fold_in(key, one) for one in (0, 1, 2 + step))
        side_key, period_key, now = streams
        curvature, speed = preview.road[0]
        side = jax.random.rademacher(side_key, (2,), float)
        period = jax.random.uniform(period_key, minval=1.0, maxval=8.0)
        swing = jnp.where(jnp.mod(step * plant.dt / period, 1.0) < 0.5, 1.0, -1.0)
        shares = (
            jnp.zeros(2),
            jnp.stack([jnp.where(xi[LATERAL] < 0.0, -1.0, 1.0), 1.0]),
            swing * side,
            jax.random.rademacher(now, (2,), float),
            side,
            jnp.full(2, jnp.nan),
        )
        lawful = law(xi, curvature, speed, env)
        asked = [lawful + share * law.perturbation for share in shares]
        # Full lock ignores the law; all others ask for what a planner may add to it.
        command = jnp.stack([*asked, jnp.where(side > 0.0, high, low)])[kind]
        info = {
            "predicted_states": jnp.tile(xi, (HORIZON, 1)),
            "effective_samples": jnp.ones(()),
            "healthy": jnp.asarray(True),
        }
        return jnp.clip(command, low, high), (key, step + 1), info

    return Controller(lambda key: (key, jnp.zeros((), jnp.int32)), act)


def lateral(car, shielded, kind, road, key):
    """Distance from the path at every step of one run [m]."""
    controller, plant = hostile(car, kind), car.trained.vehicle
    if shielded:
        controller = build.in_corridor(
            controller, car.trained.model, plant, car.trained.law, car.certificate
        )
    coordinates = len(plant.state_names) - 1
    controller = control.along_reference(controller, coordinates=coordinates)
    episode = evaluation.simulate(
        plant.step,
        controller,
        car.params,
        road,
        key,
        dt=plant.dt,
        horizon=HORIZON,
        observation_noise=car.noise,
    )
    return episode.lateral


def roads(car, count, seconds, seed):
    """S3 roads and keys."""
    plant = car.trained.vehicle
    family = scenarios.scenario(
        name="s3",
        duration=seconds,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )
    road_key, run_key = jax.random.split(jax.random.key(seed))
    made = jax.jit(jax.vmap(family))(jax.random.split(road_key, count))
    return made, jax.random.split(run_key, count)


def summary(distances, corridor):
    """What the runs of a planner come to; no number counts as outside."""
    worst = np.max(np.where(np.isfinite(distances), np.abs(distances), np.inf), axis=1)
    largest = float(np.max(worst))
    return {
        "drives": len(worst),
        "departures": int(np.sum(~(worst <= LANE))),
        "largest_m": round(largest, 4) if np.isfinite(largest) else None,
        "inside": float(np.mean(worst <= corridor)),
    }


def main():
    """Drive and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--planners", nargs="*", choices=PLANNERS, default=PLANNERS)
    parser.add_argument("--out", type=Path)
    given, cars = parser.parse_args(), {}
    for name in CARS:
        car = load(name)
        bounds = car.certificate["corridor"]["bounds"]
        corridor = bounds["nominal"] + bounds["vehicle_to_nominal_position"]
        made, keys = roads(car, given.runs, given.seconds, 0)
        run = {
            way: jax.jit(jax.vmap(partial(lateral, car, way == "with"), (None, 0, 0)))
            for way in ("with", "without")
        }
        scripts = {}
        for planner in given.planners:
            scripts[planner] = {}
            for way, drive in run.items():
                parts = [
                    drive(
                        PLANNERS.index(planner),
                        jax.tree.map(lambda leaf, b=b: leaf[b : b + BATCH], made),
                        keys[b : b + BATCH],
                    )
                    for b in range(0, given.runs, BATCH)
                ]
                found = summary(np.concatenate(parts), corridor)
                scripts[planner][way] = found
                print(name, planner, way, found, flush=True)
        cars[name] = {"policy_sha256": car.trained.sha256, "scripts": scripts}
    settings = {"runs": given.runs, "seconds": given.seconds}
    document = {"settings": settings, "cars": cars}
    store.write_json(given.out or Path(__file__).with_suffix(".json"), document)


if __name__ == "__main__":
    main()
