"""Drive a shipped policy for a long time while its readings are wrong every few seconds.

    python -m benchmarks.soak [--steps 5000 --car kinematic]

The controller is used as on a car: `act` is jitted once, its state never starts anew, and a
step is a call. Asked for: every control finite and within the limits, one compilation,
memory that does not grow, a state that is finite after a fault. Writes benchmarks/soak.json.
"""

import argparse
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from sfkd_jax import scenarios

SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
HORIZON, ROAD, LOST = 20, 1000, 20.0
"""Steps of a plan; of a road; distance at which the car is put back onto it [m]."""
FAULT, PAUSE = (1, 30), (100, 200)
"""Steps that a fault lasts, and steps without one after it."""
KINDS = ("NaN", "infinite", "huge", "frozen", "jump")
NOISE = np.asarray((0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001), np.float32)


def faults(random, steps):
    """Index into KINDS of the fault at every step, -1 without one."""
    kinds, at = np.full(steps, -1), random.integers(*PAUSE)
    while at < steps:
        length = random.integers(*FAULT, endpoint=True)
        kinds[at : at + length] = random.integers(len(KINDS))
        at += length + random.integers(*PAUSE, endpoint=True)
    return kinds


def wrong(random, kind, reading, last):
    """A reading as its sensor reports it under a fault."""
    hit = random.random(reading.shape) < 0.5
    sign = random.choice((-1.0, 1.0), reading.shape)
    value = {
        "NaN": np.full_like(reading, np.nan),
        "infinite": sign * np.inf,
        "huge": sign * 10.0 ** random.uniform(4, 38),
        "frozen": last,
        "jump": reading + 5.0 * sign,
    }[kind]
    return np.where(hit | (kind == "frozen"), value, reading).astype(np.float32)


def resident_mb():
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text("utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main():
    """Drive, summarise, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--car", choices=("kinematic", "dynamic"), default="kinematic")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    given = parser.parse_args()
    policy = sfkd_jax.load(SHIPPED / f"{given.car}_path")
    plant = policy.vehicle
    size = len(plant.state_names)
    family = jax.jit(
        scenarios.scenario(
            name="s3", duration=ROAD * plant.dt, state_size=size, dt=plant.dt
        )
    )
    act = jax.jit(policy.controller.act)

    @jax.jit
    def window(road, progress):
        return scenarios.reference_window(
            road.path, progress, road.speed, dt=plant.dt, horizon=HORIZON
        )

    @jax.jit
    def move(road, k, state, progress, control):
        state = plant.step(state, control, road.envs[k])
        guess = progress + road.speed * plant.dt
        progress, lateral = scenarios.project(road.path, state[:2], guess)
        lost = ~(jnp.abs(lateral) < LOST)
        # A lost car goes back onto the road, as a driver would put it there.
        back = road.initial_state.at[:3].set(scenarios.point_at(road.path, guess)[:3])
        state = jnp.where(lost, back, state)
        return state, jnp.where(lost, guess, progress), lateral, lost

    random = np.random.default_rng(given.seed)
    memory = policy.controller.init(jax.random.key(given.seed))
    low, high = np.float32(plant.control_low), np.float32(plant.control_high)
    outside = not_finite = put_back = left = 0
    kinds, lateral, resident = faults(random, given.steps), [], []
    for step in range(given.steps):
        k = step % ROAD
        if k == 0:
            road = family(jax.random.fold_in(jax.random.key(given.seed), step))
            state, progress = road.initial_state, jnp.zeros(())
            last = np.asarray(state)
            resident.append(resident_mb())
        reading = np.asarray(state) + NOISE[:size] * random.normal(size=size)
        reading = reading.astype(np.float32)
        seen = reading
        if kinds[step] >= 0:
            seen = wrong(random, KINDS[kinds[step]], reading, last)
        else:
            last = reading
        control, memory, _ = act(
            policy.params, memory, seen, road.envs[k], window(road, progress)
        )
        control = np.asarray(control)
        not_finite += int(not np.all(np.isfinite(control)))
        outside += int(np.any((control < low) | (control > high)))
        if kinds[step] >= 0 and (step + 1 == given.steps or kinds[step + 1] < 0):
            floats = (
                np.asarray(leaf) for leaf in jax.tree.leaves(memory) if _real(leaf)
            )
            left += sum(int(np.sum(~np.isfinite(leaf))) for leaf in floats)
        state, progress, distance, lost = move(road, k, state, progress, control)
        lateral.append(float(distance))
        put_back += int(lost)
    document = {
        "car": given.car,
        "steps": given.steps,
        "faults": int(np.sum((kinds[1:] >= 0) & (kinds[:-1] < 0))),
        "controls_not_finite": not_finite,
        "controls_outside_limits": outside,
        "state_entries_not_finite_after_a_fault": left,
        "compilations": act._cache_size(),
        "resident_mb": [round(one, 1) for one in resident],
        "put_back": put_back,
        "median_distance_m": round(float(np.median(np.abs(lateral))), 4),
    }
    given.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    print(json.dumps(document))


def _real(leaf):
    """Whether a leaf of a controller's state holds real numbers."""
    return jnp.issubdtype(leaf.dtype, jnp.floating)


if __name__ == "__main__":
    main()
