"""Shipped policies in path coordinates where the car, its environment or a force is not what they were told.

python -m benchmarks.quality.adaptation --vehicle dynamic [--cases NAME ... --episodes 16
--seconds 30 --seed 2026 --out benchmarks/quality/adaptation_dynamic.json] Law, planner
and episodes are equal in all rows of a case. A case that is in the file already is not
driven again. The settings of adaptation were chosen on episodes of seed 100.
"""

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from sfkd_jax import artefacts, build, control, evaluation, policy, scenarios, vehicle
from sfkd_jax.core.offsets import with_offset
from sfkd_jax.scenarios import random_side_forces
from sfkd_jax.vehicle import equivalent_wind

SPEED = 3
"""Index of the speed in a state."""
SETTLED = 20
"""Steps at the start of an episode that do not count: 2 s."""
STEERING_OFFSET = np.deg2rad(1.0)
LEADS = (1, 5, 10, 20)
"""Steps ahead whose coverage is reported."""
LANE = 0.1
"""Half width of the lane [m] in the row that slows down."""
ONE_FILTER = {"jump": 1e-6, "force_drift": 0.25}
FAST_ONLY = {"slow_prior": (1e-6,) * 4, "slow_drift": (1e-8,) * 4}


class Case(NamedTuple):
    """What a policy does not know.

    Attributes:
        scenario: of the roads.
        force: largest side force that nobody measures [N].
        hold: how long each force lasts [s].
        car: factors of its own parameters.
        steering: added to the steering angle [rad].
        estimate_env: whether friction and wind are not measured either.
    """

    scenario: str = "s3"
    force: float = 0.0
    hold: float = 1.0
    car: tuple[tuple[str, float], ...] = ()
    steering: float = 0.0
    estimate_env: bool = False


CASES = {
    "nothing, S1": Case("s1"),
    "nothing, S3": Case(),
    "force, 1 s": Case(force=1000.0),
    "force, 3 s": Case(force=1000.0, hold=3.0),
    "mass + 30 %": Case(car=(("mass", 1.3),)),
    "wheelbase + 5 %": Case(car=(("front_length", 1.05), ("rear_length", 1.05))),
    "stiffness - 30 %": Case(car=(("front_stiffness", 0.7), ("rear_stiffness", 0.7))),
    "steering + 1 degree": Case(steering=STEERING_OFFSET),
    "e not measured": Case(estimate_env=True),
}
DEFAULTS = {
    "kinematic": {"front_stiffness": 6.0e4, "rear_stiffness": 7.0e4},
    "dynamic": {"front_stiffness": 9.0e4, "rear_stiffness": 1.05e5},
}
SHARED = {"mass": 1500.0, "front_length": 1.2, "rear_length": 1.5}


def changed_car(name, case):
    """The car of a case."""
    own = SHARED | DEFAULTS[name]
    changes = {key: factor * own[key] for key, factor in case.car}
    car = getattr(vehicle, name)(**changes)
    if not case.steering:
        return car

    def step(state, command, env):
        return car.step(state, command.at[0].add(case.steering), env)

    return car._replace(step=step)


def roads(plant, case, count, seconds, seed):
    """Scenarios whose `observed_envs` lack the forces, and keys."""
    family = scenarios.scenario(
        name=case.scenario,
        duration=seconds,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )
    road_key, drive_key, force_key = jax.random.split(jax.random.key(seed), 3)
    made = jax.jit(jax.vmap(family))(jax.random.split(road_key, count))

    def disturbed(key, envs):
        forces = random_side_forces(
            key, steps=len(envs), dt=plant.dt, largest=case.force, hold=case.hold
        )
        wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))
        return envs.at[:, 1].set(wind(envs[:, 1], forces))

    actual = made.envs
    if case.force:
        actual = jax.jit(jax.vmap(disturbed))(
            jax.random.split(force_key, count), made.envs
        )
    made = made._replace(envs=actual, observed_envs=made.envs)
    return made, jax.random.split(drive_key, count)


class Rows(NamedTuple):
    """A shipped policy and the cars that it is driven on."""

    name: str
    loaded: policy.Policy
    plant: vehicle.Vehicle

    @property
    def box(self):
        """Of the environment."""
        about = self.loaded.settings["dataset"]
        return {side: tuple(about[side]) for side in ("env_low", "env_high")}

    def planner(self, model, *, bounded=True):
        """The policy's own planner with another model, without a shield."""
        settings = dict(self.loaded.settings["controller"], shield=False)
        box = self.box if bounded else {}
        return build.build_controller(
            settings, model, self.plant, law=self.loaded.law, **box
        )

    def adaptive(self, model=None, **settings):
        """The same planner, adapting."""
        model = self.loaded.model if model is None else model
        return control.adaptive(
            self.planner(with_offset(model)),
            model,
            self.loaded.law,
            coordinates=len(self.plant.state_names) - 1,
            control_low=self.plant.control_low,
            control_high=self.plant.control_high,
            **self.box,
            **settings,
        )

    def oracle(self, car):
        """A car's own step as a model."""
        return build.reference_systems(car, self.loaded.law)["oracle"].model


def with_tube(controller, **settings):
    """Calibrated while driving."""
    return control.online_tube(controller, horizon=20, **settings)


def systems(rows, case, car):
    """Row -> (controller, parameters, whether it is told of the force)."""
    own = rows.loaded.params
    unknown = {"estimate_env": case.estimate_env}
    made = {
        "oracle that knows": (rows.planner(rows.oracle(car), bounded=False), {}, True),
        "SFKD": (rows.planner(rows.loaded.model), own, False),
        "SFKD, adaptive": (with_tube(rows.adaptive(**unknown)), own, False),
        "SFKD, adaptive, slower": (
            with_tube(rows.adaptive(**unknown), lane=LANE, fall=0.01),
            own,
            False,
        ),
    }
    if case.force:
        nominal = rows.planner(rows.oracle(rows.plant))
        made["oracle that does not know"] = (nominal, {}, False)
    if case.force or case.car or case.steering:
        single, fast = rows.adaptive(**ONE_FILTER), rows.adaptive(**FAST_ONLY)
        made["SFKD, one filter"] = (single, own, False)
        made["SFKD, no slow causes"] = (fast, own, False)
    if case.estimate_env:
        best = rows.adaptive(rows.oracle(rows.plant), **unknown)
        made["oracle, e estimated"] = (best, {}, False)
    return made


def reported(info):
    """Of every step: whether the tube was missed, whether that is known, its radius."""
    if "tube" not in info:
        return ()
    at = jnp.asarray(LEADS) - 1
    known = jnp.isfinite(info["tube_errors"])[at]
    return info["tube_missed"][at], known, info["tube"][at]


def summary(episodes):
    """What the episodes of a row come to."""
    lateral = np.asarray(episodes.lateral, dtype=np.float64)[:, SETTLED:]
    rmse = np.sqrt(np.mean(lateral**2, axis=1))
    result = {
        "rmse_mm": 1e3 * float(np.mean(rmse)),
        "rmse_episodes_mm": (1e3 * rmse).tolist(),
        "largest_mm": 1e3 * float(np.abs(lateral).max()),
        "speed_m_per_s": float(np.mean(episodes.states[..., SPEED])),
    }
    if len(episodes.report):
        missed, known, radius = (np.asarray(part) for part in episodes.report)
        covered = 1.0 - np.sum(missed & known, axis=(0, 1)) / np.sum(known, axis=(0, 1))
        result["coverage"] = dict(zip(map(str, LEADS), covered.tolist(), strict=True))
        radius = np.median(radius, axis=(0, 1)).tolist()
        result["tube_m"] = dict(zip(map(str, LEADS), radius, strict=True))
    return result


def drive(rows, case, car, given, scene):
    """One row: all episodes, one after the other in one program."""
    controller, params, told = given
    made, keys = scene
    if told:
        made = made._replace(observed_envs=made.envs)
    noise = control_noise(rows)

    def one(inputs):
        return evaluation.simulate(
            car.step,
            controller,
            params,
            *inputs,
            dt=car.dt,
            horizon=20,
            observation_noise=noise,
            report=reported,
        )

    return summary(jax.jit(lambda batch: jax.lax.map(one, batch))((made, keys)))


def control_noise(rows):
    """Standard deviations of the benchmark's sensors."""
    full = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
    return full[: len(rows.plant.state_names)]


def main():
    """Parse, drive what is missing, write after every case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", choices=DEFAULTS, required=True)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    name = given.vehicle
    out = given.out or harness.ROOT / f"benchmarks/quality/adaptation_{name}.json"
    protocol = {
        "vehicle": name,
        "episodes": given.episodes,
        "seconds": given.seconds,
        "seed": given.seed,
    }
    document = {"protocol": protocol, "cases": {}}
    if out.exists():
        document = artefacts.read_json(out, keys=("protocol", "cases"))
        if document["protocol"] != protocol:
            raise SystemExit(f"{out}: another protocol; choose another --out")
    shipped = Path(policy.__file__).parent / "pretrained" / f"{name}_path"
    loaded = policy.load(shipped)
    rows = Rows(name, loaded, build.build_vehicle(loaded.settings["vehicle"]))
    for label in given.cases:
        case = CASES[label]
        car = changed_car(name, case)
        sizes = given.episodes, given.seconds, given.seed
        done = document["cases"].setdefault(label, {})
        for row, system in systems(rows, case, car).items():
            if row in done:
                continue
            began = time.perf_counter()
            scene = roads(car, case, *sizes)
            done[row] = drive(rows, case, car, system, scene)
            took = time.perf_counter() - began
            line = f"{label}: {row}: {done[row]['rmse_mm']:.1f} mm ({took:.0f} s)"
            print(line, file=sys.stderr, flush=True)
            document["machine"] = harness.machine()
            document["versions"] = artefacts.versions()
            artefacts.write_json(out, document)
    print(json.dumps({"results": str(out)}))


if __name__ == "__main__":
    main()
