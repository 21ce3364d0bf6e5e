"""What latency costs along a path: known, and other than assumed.

    python -m benchmarks.latency [--cars dynamic --cases NAME ... --episodes 16]

Every row drives the same roads of S3 at 10 m/s, for `seconds`, with the sensors of the car.
`--policy DIRECTORY` drives the policy of a run in place of those that ship. The results go to
benchmarks/latency.json, one line a row.
"""

import json
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import arguments, stamp, write
from benchmarks.device import CARS, SETTLED, SHIPPED, driving, family, rmse_mm
from sfkd_jax import Latency, policy
from sfkd_jax.info import Reason

DEPARTED = 1.0
"""Distance from the path that counts as a departure [m]."""
SAMPLES = 64
"""Of the planner: the law decides."""


class Case(NamedTuple):
    """Delays in seconds: what is true of the car, and what its controller assumes.

    `environment` is by how much later than the state friction and wind are known.
    """

    sensors: float = 0.0
    controls: float = 0.0
    assumed_sensors: float | None = None
    assumed_controls: float | None = None
    environment: float = 0.0

    @property
    def true(self):
        """The latency of the car."""
        return Latency((self.sensors,), (self.controls,))

    @property
    def later(self):
        """By how much the loop is later than assumed [s]."""
        true, assumed = (
            sum((*latency.sensors, *latency.controls))
            for latency in (self.true, self.assumed)
        )
        return true - assumed

    @property
    def assumed(self):
        """The latency that the controller compensates."""
        sensors = self.assumed_sensors
        controls = self.assumed_controls
        return Latency(
            (self.sensors if sensors is None else sensors,),
            (self.controls if controls is None else controls,),
        )


CASES = {
    "on time": Case(),
    **{f"sensors {late} s": Case(late, 0.0) for late in (0.1, 0.2, 0.3)},
    **{f"controls {late} s": Case(0.0, late) for late in (0.1, 0.2, 0.3)},
    **{f"half each, {late} s": Case(late / 2, late / 2) for late in (0.1, 0.2, 0.3)},
    **{f"e known {late} s later": Case(environment=late) for late in (0.1, 0.2, 0.3)},
    "sensors 0.1 s, nothing assumed": Case(0.1, 0.0, 0.0, 0.0),
    "controls 0.1 s, nothing assumed": Case(0.0, 0.1, 0.0, 0.0),
    "sensors 0.2 s, nothing assumed": Case(0.2, 0.0, 0.0, 0.0),
    "controls 0.2 s, nothing assumed": Case(0.0, 0.2, 0.0, 0.0),
    "on time, 0.1 s assumed": Case(0.0, 0.0, 0.1, 0.0),
    "0.2 s, 0.1 s assumed": Case(0.2, 0.0, 0.1, 0.0),
    "0.1 s, 0.2 s assumed": Case(0.1, 0.0, 0.2, 0.0),
    "0.3 s, 0.2 s assumed": Case(0.3, 0.0, 0.2, 0.0),
}


def loaded(path, latency):
    """A policy with few samples, for a car with this latency."""
    settings = dict(policy.restore(path).settings["controller"])
    settings["mppi"] = settings["mppi"] | {"num_samples": SAMPLES}
    return policy.load(path, controller=settings, latency=latency)


def drive(path, case, options):
    """The numbers of a row."""
    driver = loaded(path, case.assumed)
    car = driver.vehicle
    sample = family(car, "s3", options.seconds, speed=10.0)
    road_key, drive_key = jax.random.split(jax.random.key(options.seed))
    scenes = jax.jit(jax.vmap(sample))(jax.random.split(road_key, options.episodes))
    steps = np.arange(scenes.envs.shape[1])
    known = np.maximum(steps - round(case.environment / car.dt), 0)
    scenes = scenes._replace(observed_envs=scenes.envs[:, known])
    episode = driving(
        car,
        driver.controller,
        driver.params,
        horizon=driver.interface["horizon"],
        latency=case.true,
        record={"claim": lambda info: info.claim, "gate": lambda info: info.gate},
    )
    keys = jax.random.split(drive_key, options.episodes)
    driven = jax.jit(jax.vmap(episode))(scenes, keys)
    lateral = np.abs(np.asarray(driven.lateral, dtype=np.float64))
    claim = jax.tree.map(np.asarray, driven.signals["claim"])
    largest = lateral.max(axis=1)
    claimed = claim.reason == Reason.CERTIFIED
    gate = jax.tree.map(np.asarray, driven.signals["gate"])
    off = np.abs(gate.later * car.dt - case.later)
    # Time of a run for which the estimate is off by more than half a period.
    wrong = car.dt * np.sum(off > 0.5 * car.dt + 1e-6, axis=1)
    return {
        "departures": int(np.sum(~(largest <= DEPARTED))),
        "largest_m": round(float(largest.max()), 3),
        "rmse_mm": round(float(np.mean(rmse_mm(lateral[:, SETTLED:]))), 2),
        "claimed": round(float(claimed.mean()), 4),
        "beyond_claim": int(np.sum(claimed & (lateral > claim.bound))),
        "wrong_latency_s": round(float(np.median(wrong)), 1),
        "wrong_latency_longest_s": round(float(wrong.max()), 1),
        "runs_with_alarm": int(np.sum(gate.alarm.any(axis=1))),
    }


def main():
    """Drive and write."""
    protocol = {"episodes": 16, "seconds": 60.0, "seed": 2028}
    options = arguments(
        __doc__, __file__, cars=CARS, cases=CASES, policy="", **protocol
    )
    rows = []
    for car in options.cars:
        name = f"{car}_path"
        for label in options.cases:
            numbers = drive(options.policy or SHIPPED / name, CASES[label], options)
            about = {"car": car, "case": label}
            rows.append(about | numbers | stamp(None if options.policy else name))
            print(json.dumps(rows[-1]), flush=True)
    write(options.out, {key: getattr(options, key) for key in protocol}, rows)


if __name__ == "__main__":
    main()
