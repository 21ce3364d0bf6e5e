"""What feedback between plans is worth: a car whose control is renewed at 100 Hz.

python -m benchmarks.quality.feedback [--vehicles kinematic dynamic --episodes 16
--seconds 30 --seed 2032 --out benchmarks/quality/feedback.json]
The shipped policy on S3, 1500 samples x 20 steps. Rows: a plan at 10 Hz, its first control
held; the same with the plan's gains at 100 Hz; plans of three iterations of 500 samples;
plans at 50 Hz, held. Sensors are read at 100 Hz with the benchmark's noise; "filtered":
the state is predicted by the plan and corrected by a share of what is read. Lateral RMSE
after 2 s; differences are paired.
"""

import argparse
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import harness
from benchmarks.harness import SHIPPED
from benchmarks.quality.laws import SENSORS, episodes_of, planner_of
from sfkd_jax import control, evaluation, scenarios
from sfkd_jax.build import build_vehicle

FAST = 10
"""Control periods of the car in one of the model."""
SETTLE_S = 2.0
YAW = 2
FILTER = 0.3
"""Share of a reading in the filtered state."""
GAINS = {"gain_samples": 64}


class Row(NamedTuple):
    """Fast periods between two plans, options and samples of the planner, share of a
    reading.
    """

    every: int
    options: dict
    share: float = 1.0
    samples: int = 1500


ROWS = {
    "10 Hz": Row(10, {}),
    "10 Hz, feedback": Row(10, GAINS),
    "10 Hz, filtered": Row(10, {}, FILTER),
    "10 Hz, filtered, feedback, 3 x 500": Row(
        10, GAINS | {"iterations": 3}, FILTER, 500
    ),
    "50 Hz": Row(2, {}),
    "50 Hz, filtered": Row(2, {}, FILTER),
}


def episode(plant, fast, planner, row, params, road, key):
    """Lateral deviation and steering at every fast period."""
    planner_key, noise_key = jax.random.split(key)
    spread = jnp.asarray(SENSORS)[: road.initial_state.shape[0]]
    box = {"control_low": plant.control_low, "control_high": plant.control_high}
    box |= {"angles": (YAW,)}

    def sensed(state, number):
        """The same noise for every row."""
        return state + spread * jax.random.normal(
            jax.random.fold_in(noise_key, number), state.shape
        )

    def hold(plan_of, carry, number):
        """One fast period under the last plan."""
        state, progress, estimate = carry
        planned, seen, info, began = plan_of
        ahead, steered = info["predicted_states"][0], planned
        if "gains" in info:
            share = (number - began) / FAST
            steered = control.between_plans(
                planned, info["gains"], seen, ahead, estimate, share=share, **box
            )
        state = fast.step(state, steered, road.envs[number // FAST])
        progress, lateral = scenarios.project(
            road.path, state[:2], progress + road.speed * fast.dt
        )
        expected = estimate + (ahead - seen) / FAST
        estimate = expected + row.share * (sensed(state, number + 1) - expected)
        return (state, progress, estimate), (lateral, steered[0])

    def plan(carry, began):
        (state, progress, seen), memory = carry
        reference = scenarios.reference_window(
            road.path, progress, road.speed, dt=plant.dt, horizon=20
        )
        env = road.observed_envs[began // FAST]
        memory = control.tuned(memory, elapsed=row.every / FAST)
        planned, memory, info = planner.act(params, memory, seen, env, reference)
        moved, record = jax.lax.scan(
            partial(hold, (planned, seen, info, began)),
            (state, progress, seen),
            began + jnp.arange(row.every),
        )
        return (moved, memory), record

    count = FAST * road.envs.shape[0]
    began = road.initial_state, jnp.zeros(()), sensed(road.initial_state, 0)
    start = (began, planner.init(planner_key))
    _, record = jax.lax.scan(plan, start, jnp.arange(0, count, row.every))
    return jax.tree.map(lambda leaf: leaf.reshape(-1), record)


def measured(vehicle, args):
    """Every row of a vehicle on the same episodes."""
    policy = sfkd_jax.load(SHIPPED / vehicle)
    plant = build_vehicle(policy.settings["vehicle"])
    fast = build_vehicle(policy.settings["vehicle"] | {"dt": plant.dt / FAST})
    roads, keys = episodes_of(plant, "s3", args)
    rows = {}
    for label, row in ROWS.items():
        planner = planner_of(policy, plant, "feedback", row.samples, row.options)
        run = partial(episode, plant, fast, planner, row, policy.params)
        lateral, steering = jax.jit(evaluation.over_episodes(run))(roads, keys)
        settled = np.asarray(lateral)[:, round(SETTLE_S / fast.dt) :]
        error = 1e3 * np.sqrt(np.mean(settled**2, axis=1))
        rate = np.abs(np.diff(np.asarray(steering), axis=1)).mean() / fast.dt
        rows[label] = {"rmse_mm": error.tolist(), "steering_rate": float(rate)}
        print(
            f"{vehicle:10} {label:28} {error.mean():6.2f} mm, worst {error.max():6.1f}, {rate:.3f} rad/s",
            flush=True,
        )
    replanned = np.asarray(rows["50 Hz"]["rmse_mm"])
    for row in rows.values():
        row["minus_50_hz_mm"] = evaluation.paired_difference(
            np.asarray(row["rmse_mm"]), replanned
        )
    return rows


def main():
    """Parse, drive, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", nargs="+", default=["kinematic", "dynamic"])
    for name, value in (("episodes", 16), ("seed", 2032)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--out")
    args = parser.parse_args()
    rows = {name: measured(name, args) for name in args.vehicles}
    settings = {name: getattr(args, name) for name in ("episodes", "seed", "seconds")}
    harness.write(
        args.out,
        {"vehicles": rows, "settings": settings, "machine": harness.machine()},
    )


if __name__ == "__main__":
    main()
