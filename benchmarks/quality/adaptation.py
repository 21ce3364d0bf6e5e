"""Shipped policies in path coordinates where the car, its environment or a force is not what they were told.

python -m benchmarks.quality.adaptation --vehicle dynamic [--cases NAME ... --episodes 16
--seconds 30 --seed 2027 --root runs --out benchmarks/quality/adaptation_dynamic.json]
Law, planner and episodes are equal in all rows of a case. A row that is in the file
already is not driven again. All settings were chosen on episodes of seed 100. The
neural ODE of the baselines is trained first, unless it is below --root.
"""

import argparse
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.quality import adaptive_baselines
from sfkd_jax import build, control, evaluation, plants, policy, scenarios, store
from sfkd_jax.evaluation import metrics
from sfkd_jax.plants import equivalent_wind
from sfkd_jax.scenarios import random_side_forces

SPEED = 3
"""Index of the speed in a state."""
SETTLED = 20
"""Steps at the start of an episode that do not count: 2 s."""
STEERING_OFFSET = np.deg2rad(1.0)
LEADS = (1, 5, 10, 20)
"""Steps ahead whose coverage is reported."""
NODE = "neural_ode_path"
LAST_LAYER = {"prior": 0.02, "drift": 0.08, "forgetting": 0.9}
"""Of the neural ODE's filter, chosen among nine as its own settings were."""
BANK_STEPS = 2
"""Window of the bank [steps], chosen among four."""
GRIP = 1.2
"""Lateral acceleration that is trusted at the start [m/s²], in the cautious rows."""
LATE = 5
"""Steps after which the oracle is told, in the row that is told late."""
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
        friction: real and told; None for those of the scenario.
        speed: [m/s].
        count: of episodes; None for that of the command.
        rivals: whether ablations and baselines are driven as well.
    """

    scenario: str = "s3"
    force: float = 0.0
    hold: float = 1.0
    car: tuple[tuple[str, float], ...] = ()
    steering: float = 0.0
    estimate_env: bool = False
    friction: tuple[float, float] | None = None
    speed: float = 10.0
    count: int | None = None
    rivals: bool = False


CASES = {
    "nothing, S1": Case("s1"),
    "force, 3 s": Case(force=1000.0, hold=3.0, rivals=True),
    "friction 0.2, told 0.9, 12 m/s": Case(
        "s1", friction=(0.2, 0.9), speed=12.0, count=24
    ),
    "mass + 30 %": Case(car=(("mass", 1.3),)),
    "stiffness - 30 %": Case(car=(("front_stiffness", 0.7), ("rear_stiffness", 0.7))),
    "steering + 1 degree": Case(steering=STEERING_OFFSET),
    "e not measured": Case(estimate_env=True),
    "nothing, S3": Case(rivals=True),
    "force, 1 s": Case(force=1000.0),
    "wheelbase + 5 %": Case(car=(("front_length", 1.05), ("rear_length", 1.05))),
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
    car = getattr(plants, name)(**changes)
    if not case.steering:
        return car

    def step(state, command, env):
        return car.step(state, command.at[0].add(case.steering), env)

    return car._replace(step=step)


def roads(plant, case, count, seconds, seed):
    """Scenarios whose `observed_envs` lack what nobody measures, and keys."""
    count = case.count or count
    family = scenarios.scenario(
        name=case.scenario,
        speed=case.speed,
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
    told = made.envs
    if case.friction:
        actual, told = (made.envs.at[..., 0].set(level) for level in case.friction)
    made = made._replace(envs=actual, observed_envs=told)
    return made, jax.random.split(drive_key, count)


class Rows(NamedTuple):
    """A shipped policy and the cars that it is driven on."""

    name: str
    loaded: policy.Policy
    plant: plants.Vehicle

    @property
    def box(self):
        """Of the environment."""
        about = self.loaded.settings["environment"]
        return {f"env_{side}": tuple(about[side]) for side in ("low", "high")}

    def planner(self, model, *, bounded=True):
        """The policy's own planner with another model, without a shield."""
        settings = dict(self.loaded.settings["controller"], shield=False)
        box = self.box if bounded else {}
        return build.build_controller(
            settings, model, self.plant, law=self.loaded.law, **box
        )

    def adaptive(self, model=None, *, tube, estimate_env=False, **settings):
        """The same planner, adapting, with the settings of its online tube."""
        chosen = dict(self.loaded.settings["controller"], shield=False)
        chosen |= {
            "adaptation": chosen["adaptation"] | settings,
            "online_tube": chosen["online_tube"] | tube,
        }
        return build.build_controller(
            chosen,
            self.loaded.model if model is None else model,
            self.plant,
            law=self.loaded.law,
            env_source="estimated" if estimate_env else "measured",
            adaptive=True,
            **self.box,
        )

    def oracle(self, car):
        """A car's own step as a model."""
        return build.reference_systems(car, self.loaded.law)["oracle"].model


def shipped(name):
    """The policy of a vehicle that is part of the package."""
    loaded = policy.load(Path(policy.__file__).parent / "pretrained" / f"{name}_path")
    return Rows(name, loaded, build.build_vehicle(loaded.settings["vehicle"]))


def with_tube(controller, **settings):
    """Calibrated while driving; slower with the default lane."""
    tube = control.OnlineTube(inner=controller, horizon=20, **settings)
    return tube.controller()


def neural_ode(name, root):
    """The policy of the baselines: the same law, data and planner; trained if missing."""
    directory = root / f"adaptation_{name}" / NODE / "seed=0"
    if not (directory / "policy.safetensors").exists():
        command = [sys.executable, "-m", "sfkd_jax.train", "+experiment=s3"]
        command += [f"vehicle={name}", f"model={NODE}", "training=state_model"]
        command += ["controller.shield=false", f"name=adaptation_{name}"]
        subprocess.run([*command, f"root={root}"], check=True)
    return policy.restore(directory)


def baselines(rows, rival):
    """Two ways to adapt from the field, see `adaptive_baselines`."""
    sensors = np.delete(sensor_noise(rows), 1)
    error = (0.001, 0.0003, 0.003, 0.003, 0.0015, 0.0005)[: len(sensors)]
    learned = adaptive_baselines.last_layer_filter(
        rows.planner(rival.model),
        adaptive_baselines.Loop(rival.model, rival.law),
        rival.params,
        layer=max(rival.params),
        sensors=sensors,
        error=error,
        **LAST_LAYER,
    )
    low, high = (np.asarray(rows.box[f"env_{side}"]) for side in ("low", "high"))
    force = np.linspace(-1.0, 1.0, 17)
    wind = high[1] * np.sign(force) * np.sqrt(np.abs(force))
    grid = np.meshgrid(np.linspace(low[0], high[0], 7), wind, indexing="ij")
    bank = adaptive_baselines.look_back_bank(
        rows.planner(rows.loaded.model),
        adaptive_baselines.Loop(rows.loaded.model, rows.loaded.law),
        jnp.asarray(np.stack(grid, axis=-1).reshape(-1, 2)),
        sensors=sensors,
        steps=BANK_STEPS,
    )
    return {
        "neural ODE": (rows.planner(rival.model), rival.params, False),
        "neural ODE, last layer": (learned, rival.params, False),
        "SFKD, bank": (bank, rows.loaded.params, False),
    }


def systems(rows, case, car, rival):
    """Row -> (controller, parameters, if it is told or steps after which it is)."""
    own = rows.loaded.params
    unknown = {"estimate_env": case.estimate_env}
    knows = rows.planner(rows.oracle(car), bounded=False)
    adapting = partial(rows.adaptive, **unknown)
    made = {
        "oracle that knows": (knows, {}, True),
        "SFKD": (rows.planner(rows.loaded.model), own, False),
        "SFKD, adaptive": (adapting(tube={"lane": None}), own, False),
    }
    if not (case.car or case.steering):
        made["SFKD, adaptive, slower"] = (adapting(tube={}), own, False)
    if case.friction or case == CASES["nothing, S3"]:
        careful = adapting(tube={"grip": GRIP})
        made["SFKD, adaptive, cautious"] = (careful, own, False)
    if case.friction:
        guessing = rows.adaptive(tube={"grip": GRIP}, estimate_env=True)
        made["SFKD, e estimated, cautious"] = (guessing, own, False)
        made["oracle told late, cautious"] = (with_tube(knows, grip=GRIP), {}, LATE)
    if case.force:
        nominal = rows.planner(rows.oracle(rows.plant))
        made["oracle that does not know"] = (nominal, {}, False)
    if case.rivals:
        single, fast = (
            rows.adaptive(tube={"lane": None}, **change)
            for change in (ONE_FILTER, FAST_ONLY)
        )
        made["SFKD, one filter"] = (single, own, False)
        made["SFKD, no slow causes"] = (fast, own, False)
    if case.estimate_env:
        best = adapting(rows.oracle(rows.plant), tube={"lane": None})
        made["oracle, e estimated"] = (best, {}, False)
    return made | (baselines(rows, rival) if case.rivals else {})


def reported(info):
    """Of every step: whether the tube was missed, whether that is known, its radius."""
    if "tube" not in info:
        return ()
    at = jnp.asarray(LEADS) - 1
    known = jnp.isfinite(info["tube_errors"])[at]
    return info["tube_missed"][at], known, info["tube"][at]


def summary(episodes):
    """What the episodes of a row come to."""
    lateral = np.asarray(episodes.lateral, dtype=np.float64)
    largest = np.abs(lateral).max(axis=1)
    rmse = np.sqrt(np.mean(lateral[:, SETTLED:] ** 2, axis=1))
    margin = metrics.LANE_HALF_WIDTH - metrics.VEHICLE_HALF_WIDTH
    result = {
        "rmse_mm": 1e3 * float(np.mean(rmse)),
        "rmse_episodes_mm": (1e3 * rmse).tolist(),
        "largest_mm": (1e3 * largest).tolist(),
        "left_the_lane": int(np.sum(~(largest <= margin))),
        "speed_m_per_s": float(np.mean(episodes.states[..., SPEED])),
    }
    if episodes.signals["tube"]:
        missed, known, radius = map(np.asarray, episodes.signals["tube"])
        covered = 1.0 - np.sum(missed & known, axis=(0, 1)) / np.sum(known, axis=(0, 1))
        result["coverage"] = dict(zip(map(str, LEADS), covered.tolist(), strict=True))
        radius = np.median(radius, axis=(0, 1)).tolist()
        result["tube_m"] = dict(zip(map(str, LEADS), radius, strict=True))
    return result


def drive(rows, case, car, given, scene):
    """One row: all episodes at once."""
    controller, params, told = given
    made, keys = scene
    if told:
        late = jnp.arange(made.envs.shape[1]) < (0 if told is True else told)
        seen = jnp.where(late[:, None], made.observed_envs, made.envs)
        made = made._replace(observed_envs=seen)

    scene = made, keys
    return summary(
        episodes_of(rows, car, (controller, params), scene, record={"tube": reported})
    )


def episodes_of(rows, car, system, scene, **options):
    """All episodes of a (controller, parameters) on a car, at once."""

    def one(inputs):
        return evaluation.simulate(
            car.step,
            *system,
            *inputs,
            dt=car.dt,
            horizon=20,
            observation_noise=sensor_noise(rows),
            **options,
        )

    return jax.jit(jax.vmap(one))(scene)


def sensor_noise(rows):
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
    parser.add_argument("--seed", type=int, default=2027)
    parser.add_argument("--root", type=Path, default=Path("runs"))
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
        document = store.read_json(out, keys=("protocol", "cases"))
        if document["protocol"] != protocol:
            raise SystemExit(f"{out}: another protocol; choose another --out")
    rows = shipped(name)
    rival = neural_ode(name, given.root)
    for label in given.cases:
        case = CASES[label]
        car = changed_car(name, case)
        sizes = given.episodes, given.seconds, given.seed
        done = document["cases"].setdefault(label, {})
        for row, system in systems(rows, case, car, rival).items():
            if row in done:
                continue
            began = time.perf_counter()
            scene = roads(car, case, *sizes)
            done[row] = drive(rows, case, car, system, scene)
            took = time.perf_counter() - began
            line = f"{label}: {row}: {done[row]['rmse_mm']:.1f} mm ({took:.0f} s)"
            print(line, file=sys.stderr, flush=True)
            document["machine"] = harness.machine()
            document["versions"] = store.versions()
            store.write_json(out, document)
    print(json.dumps({"results": str(out)}))


if __name__ == "__main__":
    main()
