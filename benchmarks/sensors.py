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
from benchmarks.device import CARS, PERIOD, SHIPPED, family, loaded
from benchmarks.latency import DEPARTED, SAMPLES
from benchmarks.latency import loaded as restored
from sfkd_jax import Latency
from sfkd_jax.driving.paths import project, reference_window
from sfkd_jax.geometry import rotate
from sfkd_jax.info import Reason
from sfkd_jax.latency import ReadingBuffer

FIRST = 60
"""Call at which a fault begins at the earliest."""
LATEST = 2
"""Largest delay of a reading [periods]."""
BEHIND = 1.0
"""Distance from a way-point back to which a reference still begins there [m]."""
STAMPED = "every reading 0 to 0.2 s late, with stamps"
"""The case that `ReadingBuffer` mends."""


class Faults(NamedTuple):
    """What is wrong at each call; arrays begin with the call.

    Attributes:
        held: whether all sensors show what they showed before, with fresh noise.
        lost: whether the reading is NaN.
        late: by how many periods the reading is late.
        scale: of the position.
        ahead: by how much the reference begins further ahead [m].
        spacing: of the way-points at one of which the reference begins [m]; 0 without.
        offset: added to the position, ahead and to the left of the vehicle [m], and to
            the yaw [rad].
    """

    held: np.ndarray
    lost: np.ndarray
    late: np.ndarray
    scale: np.ndarray
    ahead: np.ndarray
    spacing: np.ndarray
    offset: np.ndarray


def right(steps):
    """Faults of right sensors."""
    never = np.zeros(steps, bool)
    none = np.zeros(steps)
    return Faults(
        held=never,
        lost=never,
        late=none.astype(int),
        scale=none + 1.0,
        ahead=none,
        spacing=none,
        offset=np.zeros((steps, 3)),
    )


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


def jitter(steps, random):
    """Every reading is 0 to 0.2 s late, without a stamp."""
    return right(steps)._replace(late=random.integers(0, LATEST + 1, steps))


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


def since(steps, random, shortest, longest):
    """Time since a fault began [s], which lasts so long; NaN before and after it."""
    first = random.integers(FIRST, 2 * FIRST)
    length = random.uniform(shortest, longest)
    time = PERIOD * (np.arange(steps) - first)
    return np.where((time >= 0.0) & (time <= length), time, np.nan)


def turned(steps, random, largest):
    """The yaw is wrong by an angle once, for 2 to 6 s."""
    angle = random.uniform(0.0, largest) * random.choice((-1.0, 1.0))
    on = np.isfinite(since(steps, random, 2.0, 6.0))
    return right(steps)._replace(offset=angle * on[:, None] * np.eye(3)[2])


def mounted(steps, random):
    """The yaw is 0.04 rad off from the start."""
    angle = 0.04 * random.choice((-1.0, 1.0))
    return right(steps)._replace(offset=np.tile(angle * np.eye(3)[2], (steps, 1)))


def dragged(steps, random):
    """The position is dragged off once, by 2 to 50 cm/s for 2 to 6 s."""
    time = np.nan_to_num(since(steps, random, 2.0, 6.0))
    direction = random.uniform(-np.pi, np.pi)
    towards = np.asarray([np.cos(direction), np.sin(direction), 0.0])
    way = random.uniform(0.02, 0.5) * time
    return right(steps)._replace(offset=way[:, None] * towards)


def jumped(steps, random):
    """The position jumps 0.07 m to a side, and is dragged off to the other side."""
    time = since(steps, random, 2.6, 2.6)
    way = random.choice((-1.0, 1.0)) * np.nan_to_num(0.29 * time - 0.07)
    return right(steps)._replace(offset=way[:, None] * np.eye(3)[1])


CASES = {
    "right sensors": lambda steps, random: right(steps),
    "sensors stand still, with noise, 0.1 to 2.5 s": held,
    "10 to 80 % of the readings lost": lost,
    "one reading in six": sparse,
    "every reading 0 to 0.2 s late, no stamps": jitter,
    "position 2 % too far from the origin": scaled,
    "position dragged off by 2 to 50 cm/s, for 2 to 6 s": dragged,
    "position jumps 0.07 m to a side, then 0.29 m/s to the other, for 2.6 s": jumped,
    "yaw up to 0.03 rad off, for 2 to 6 s": partial(turned, largest=0.03),
    "yaw up to 0.1 rad off, for 2 to 6 s": partial(turned, largest=0.1),
    "yaw 0.04 rad off from the start": mounted,
    "reference 2 to 4 m further ahead, now and then": replanned,
    "reference begins at way-points 3 to 5 m apart": way_points,
    STAMPED: None,
}


def driven_on(car, start):
    """States of the last periods of a car that has driven straight on, newest last."""
    way = start[3] * jnp.stack([jnp.cos(start[2]), jnp.sin(start[2])])
    ago = car.dt * jnp.arange(LATEST, -1, -1)
    return jnp.tile(start, (LATEST + 1, 1)).at[:, :2].add(-ago[:, None] * way)


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
        states, along, memory, kept = carry
        env, fault, noise_key = now
        state = states[-1]
        kept = jnp.where(fault.held, kept, states[LATEST - fault.late])
        fresh = noise * jax.random.normal(noise_key, state.shape)
        shift = rotate(state[2], fault.offset[:2])
        seen = kept.at[:2].multiply(fault.scale) + fresh
        seen = seen.at[:2].add(shift).at[2].add(fault.offset[2])
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
        states = jnp.concatenate([states[1:], state[None]])
        return (states, along, memory, kept), recorded

    planner_key, noise_key = jax.random.split(key)
    start = scene.initial_state
    states = driven_on(car, start)
    carry = (states, jnp.zeros(()), policy.controller.init(planner_key), start)
    keys = jax.random.split(noise_key, len(scene.envs))
    return jax.lax.scan(step, carry, (scene.envs, faults, keys))[1]


def scenes_of(policy, options):
    """Scenes of S3 and keys of the episodes."""
    sample = family(policy.vehicle, "s3", options.seconds, speed=10.0)
    road_key, drive_key = jax.random.split(jax.random.key(options.seed))
    scenes = jax.jit(jax.vmap(sample))(jax.random.split(road_key, options.episodes))
    return scenes, jax.random.split(drive_key, options.episodes)


def numbers(recorded, wrong):
    """What a row says of the recorded episodes, whose readings were wrong at times."""
    lateral, claim, measured, alarm = jax.tree.map(np.asarray, recorded)
    distance = np.abs(lateral.astype(float))
    claimed = claim.reason == Reason.CERTIFIED
    return {
        "departures": int(np.sum(~(distance.max(axis=1) <= DEPARTED))),
        "largest_m": round(float(distance.max()), 3),
        "rmse_mm": round(1e3 * float(np.sqrt(np.mean(distance**2))), 1),
        "claimed": round(float(claimed.mean()), 4),
        "beyond_claim": int(np.sum(claimed & (distance > claim.bound))),
        "blind_with_right_sensors": int(np.sum(~measured & ~wrong)),
        "runs_with_alarm": int(np.sum(alarm.any(axis=1))),
    }


def drive(car, cases, options):
    """The rows of a car; all cases are one program."""
    policy = loaded(car, SAMPLES)
    scenes, keys = scenes_of(policy, options)
    steps = scenes.envs.shape[1]
    run = jax.jit(jax.vmap(partial(episode, policy)))
    for label in cases:
        random = np.random.default_rng(options.seed)
        faults = [CASES[label](steps, random) for _ in range(options.episodes)]
        faults = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *faults)
        off = jnp.any(faults.offset != 0.0, axis=-1)
        wrong = np.asarray(faults.held | faults.lost | (faults.late > 0) | off)
        yield label, numbers(run(scenes, faults, keys), wrong)


def drive_stamped(car, options):
    """The row of readings that are 0 to 0.2 s late, and have a stamp.

    `ReadingBuffer` lives on the host, so the episodes are driven call by call.
    """
    latest = LATEST * PERIOD
    policy = restored(SHIPPED / f"{car}_path", Latency((latest,)))
    vehicle = policy.vehicle
    scenes, keys = scenes_of(policy, options)
    act = jax.jit(jax.vmap(partial(policy.controller.act, policy.params)))
    window = partial(
        reference_window, dt=vehicle.dt, horizon=policy.interface["horizon"]
    )
    references = jax.jit(jax.vmap(window))

    @jax.jit
    @jax.vmap
    def advance(scene, state, along, control, env):
        state = vehicle.step(state, control, env)
        guess = along + scene.speed * vehicle.dt
        return state, *project(scene.path, state[:2], guess)

    random = np.random.default_rng(options.seed)
    memory = jax.jit(jax.vmap(policy.controller.init))(keys)
    state = scenes.initial_state
    along = jnp.zeros(options.episodes)
    buffers = [ReadingBuffer(latest) for _ in keys]
    past = jax.vmap(partial(driven_on, vehicle))(state)
    states = [np.asarray(past[:, index]) for index in range(LATEST + 1)]
    ago = vehicle.dt * np.arange(LATEST, -1, -1)
    places = [along - scenes.speed * time for time in ago]
    recorded = []
    for call in range(scenes.envs.shape[1]):
        seen = []
        for index, buffer in enumerate(buffers):
            late = random.integers(0, LATEST + 1)
            reading = states[-1 - late][index]
            noise = np.asarray(vehicle.sensor_noise) * random.normal(size=len(reading))
            buffer.push((call - late) * vehicle.dt, reading + noise)
            seen.append(buffer.at(call * vehicle.dt))
        env = scenes.envs[:, call]
        reference = references(scenes.path, places[-1 - LATEST], scenes.speed)
        control, memory, info = act(memory, jnp.asarray(np.stack(seen)), env, reference)
        state, along, lateral = advance(scenes, state, along, control, env)
        states = [*states[1:], np.asarray(state)]
        places = [*places[1:], along]
        measured = jnp.all(info.gate.measured, axis=-1)
        recorded.append((lateral, info.claim, measured, info.gate.alarm))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *recorded)
    return numbers(stacked, np.zeros(stacked[0].shape, bool))


def main():
    """Drive and write."""
    protocol = {"episodes": 24, "seconds": 30.0, "seed": 2029}
    options = arguments(__doc__, __file__, cars=CARS, cases=CASES, **protocol)
    rows = []
    for car in options.cars:
        plain = [label for label in options.cases if label != STAMPED]
        found = list(drive(car, plain, options))
        if STAMPED in options.cases:
            found.append((STAMPED, drive_stamped(car, options)))
        for label, about in found:
            rows.append({"car": car, "case": label} | about | stamp(f"{car}_path"))
            print(json.dumps(rows[-1]), flush=True)
    write(options.out, {key: getattr(options, key) for key in protocol}, rows)


if __name__ == "__main__":
    main()
