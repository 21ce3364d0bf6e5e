"""What wrong sensors and other references do to the policies along a path that ship.

    python -m benchmarks.sensors [--cars dynamic --cases NAME ... --episodes 24]

Every case drives the same roads of S3 at 10 m/s, for `seconds`, with the noise of the car's
sensors. The results go to benchmarks/sensors.json, one line a row.
"""

import json
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import arguments, stamp, write
from benchmarks.device import CARS, family, loaded
from benchmarks.latency import DEPARTED, SAMPLES
from sfkd_jax.driving.paths import project, reference_window
from sfkd_jax.info import Reason

FIRST = 60
"""Call at which a fault begins at the earliest."""
BEHIND = 1.0
"""Distance from a way-point back to which a reference still begins there [m]."""


class Faults(NamedTuple):
    """What is wrong at each call; arrays begin with the call.

    Attributes:
        held: whether all sensors show what they showed before, with fresh noise.
        lost: whether the reading is NaN.
        scale: of the position.
        ahead: by how much the reference begins further ahead [m].
        spacing: of the way-points at one of which the reference begins [m]; 0 without.
    """

    held: np.ndarray
    lost: np.ndarray
    scale: np.ndarray
    ahead: np.ndarray
    spacing: np.ndarray


def right(steps):
    """Faults of right sensors."""
    never = np.zeros(steps, bool)
    none = np.zeros(steps)
    return Faults(never, never, none + 1.0, none, none)


def held(steps, random):
    """All sensors stand still once, for 0.1 to 2.5 s."""
    first = random.integers(FIRST, 2 * FIRST)
    last = first + random.integers(1, 26)
    calls = np.arange(steps)
    return right(steps)._replace(held=(calls >= first) & (calls < last))


def lost(steps, random):
    """10 to 80 % of the readings are lost."""
    share = random.uniform(0.1, 0.8)
    gone = random.uniform(size=steps) < share
    return right(steps)._replace(lost=gone & (np.arange(steps) > 5))


def sparse(steps, random):
    """One reading in six arrives."""
    del random
    calls = np.arange(steps)
    return right(steps)._replace(lost=(calls % 6 != 0) & (calls > 5))


def scaled(steps, random):
    """The map is 2 % too large."""
    del random
    return right(steps)._replace(scale=np.full(steps, 1.02))


def replanned(steps, random):
    """The reference begins 2 to 4 m further ahead at one call in 20."""
    ahead = random.uniform(2.0, 4.0, steps) * (random.uniform(size=steps) < 0.05)
    return right(steps)._replace(ahead=ahead)


def way_points(steps, random):
    """The reference begins at way-points 3 to 5 m apart."""
    return right(steps)._replace(spacing=np.full(steps, random.uniform(3.0, 5.0)))


CASES = {
    "right sensors": lambda steps, random: right(steps),
    "sensors stand still, with noise, 0.1 to 2.5 s": held,
    "10 to 80 % of the readings lost": lost,
    "one reading in six": sparse,
    "position 2 % too far from the origin": scaled,
    "reference 2 to 4 m further ahead, now and then": replanned,
    "reference begins at way-points 3 to 5 m apart": way_points,
}


def episode(policy, scene, faults, key):
    """What is recorded of an episode, (time, …)."""
    car = policy.vehicle
    noise = jnp.asarray(car.sensor_noise)
    window = partial(
        reference_window,
        dt=car.dt,
        horizon=policy.interface["horizon"],
    )

    def step(carry, now):
        state, along, memory, kept = carry
        env, fault, noise_key = now
        kept = jnp.where(fault.held, kept, state)
        fresh = noise * jax.random.normal(noise_key, state.shape)
        seen = kept.at[:2].multiply(fault.scale) + fresh
        seen = jnp.where(fault.lost, jnp.nan, seen)
        points = jnp.maximum(fault.spacing, 1e-3)
        point = points * jnp.floor((along + BEHIND) / points) - BEHIND
        begins = jnp.where(fault.spacing > 0.0, point, along + fault.ahead)
        reference = window(scene.path, begins, scene.speed)
        control, memory, info = policy.controller.act(
            policy.params, memory, seen, env, reference
        )
        state = car.step(state, control, env)
        along, lateral = project(scene.path, state[:2], along + scene.speed * car.dt)
        recorded = lateral, info.claim, jnp.all(info.gate.measured), info.gate.alarm
        return (state, along, memory, kept), recorded

    planner_key, noise_key = jax.random.split(key)
    start = scene.initial_state
    carry = (start, jnp.zeros(()), policy.controller.init(planner_key), start)
    keys = jax.random.split(noise_key, len(scene.envs))
    return jax.lax.scan(step, carry, (scene.envs, faults, keys))[1]


def drive(car, cases, options):
    """The rows of a car; all cases are one program."""
    policy = loaded(car, SAMPLES)
    sample = family(policy.vehicle, "s3", options.seconds, speed=10.0)
    road_key, drive_key = jax.random.split(jax.random.key(options.seed))
    scenes = jax.jit(jax.vmap(sample))(jax.random.split(road_key, options.episodes))
    keys = jax.random.split(drive_key, options.episodes)
    steps = scenes.envs.shape[1]
    run = jax.jit(jax.vmap(partial(episode, policy)))
    for label in cases:
        random = np.random.default_rng(options.seed)
        faults = [CASES[label](steps, random) for _ in range(options.episodes)]
        faults = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *faults)
        lateral, claim, measured, alarm = jax.tree.map(
            np.asarray, run(scenes, faults, keys)
        )
        distance = np.abs(lateral.astype(float))
        claimed = claim.reason == Reason.CERTIFIED
        wrong = np.asarray(faults.held | faults.lost)
        yield (
            label,
            {
                "departures": int(np.sum(~(distance.max(axis=1) <= DEPARTED))),
                "largest_m": round(float(distance.max()), 3),
                "rmse_mm": round(1e3 * float(np.sqrt(np.mean(distance**2))), 1),
                "claimed": round(float(claimed.mean()), 4),
                "beyond_claim": int(np.sum(claimed & (distance > claim.bound))),
                "blind_with_right_sensors": int(np.sum(~measured & ~wrong)),
                "runs_with_alarm": int(np.sum(alarm.any(axis=1))),
            },
        )


def main():
    """Drive and write."""
    protocol = {"episodes": 24, "seconds": 30.0, "seed": 2029}
    options = arguments(__doc__, __file__, cars=CARS, cases=CASES, **protocol)
    rows = []
    for car in options.cars:
        for label, numbers in drive(car, options.cases, options):
            rows.append({"car": car, "case": label} | numbers | stamp(f"{car}_path"))
            print(json.dumps(rows[-1]), flush=True)
    write(options.out, {key: getattr(options, key) for key in protocol}, rows)


if __name__ == "__main__":
    main()
