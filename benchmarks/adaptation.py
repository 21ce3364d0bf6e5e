"""Adapting where the car, its environment or a force is not what the policy was given.

    python -m benchmarks.adaptation [--cars dynamic --cases NAME ... --episodes 16]

Law, planner and roads are equal in all rows of a case; no shield. Every setting was chosen
on episodes of seed 100. Writes benchmarks/adaptation.json, one line a row.
"""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, evaluation, plants, policy, scenarios
from sfkd_jax.evaluation import metrics
from sfkd_jax.plants import equivalent_wind
from sfkd_jax.scenarios import random_side_forces

SETTLED, HORIZON = 20, 20
"""Steps at the start that do not count, 2 s; steps of a plan."""
NOISE = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
LEADS = (1, 5, 10, 20)
"""Steps ahead whose coverage is reported."""
GRIP = 1.2
"""Lateral acceleration that is trusted at the start [m/s²], in the cautious rows."""


class Case(NamedTuple):
    """What a policy does not know.

    Attributes:
        scenario: of the roads.
        force: largest side force that nobody measures [N].
        hold: how long each force lasts [s].
        car: factors of its own parameters.
        steering: added to the steering angle [rad].
        estimate_env: whether friction and wind are not measured either.
        friction: on the road, and as reported; None for that of the scenario.
        speed: [m/s].
    """

    scenario: str = "s3"
    force: float = 0.0
    hold: float = 1.0
    car: tuple[tuple[str, float], ...] = ()
    steering: float = 0.0
    estimate_env: bool = False
    friction: tuple[float, float] | None = None
    speed: float = 10.0


CASES = {
    "nothing, S1": Case("s1"),
    "force, 3 s": Case(force=1000.0, hold=3.0),
    "friction 0.2, told 0.9, 12 m/s": Case("s1", friction=(0.2, 0.9), speed=12.0),
    "mass + 30 %": Case(car=(("mass", 1.3),)),
    "stiffness - 30 %": Case(car=(("front_stiffness", 0.7), ("rear_stiffness", 0.7))),
    "steering + 1 degree": Case(steering=np.deg2rad(1.0)),
    "e not measured": Case(estimate_env=True),
    "nothing, S3": Case(),
    "force, 1 s": Case(force=1000.0),
    "wheelbase + 5 %": Case(car=(("front_length", 1.05), ("rear_length", 1.05))),
}
SHARED = {"mass": 1500.0, "front_length": 1.2, "rear_length": 1.5}
CARS = {
    "dynamic": SHARED | {"front_stiffness": 9.0e4, "rear_stiffness": 1.05e5},
    "kinematic": SHARED | {"front_stiffness": 6.0e4, "rear_stiffness": 7.0e4},
}


def changed_car(name, case):
    """The car of a case."""
    changes = {key: factor * CARS[name][key] for key, factor in case.car}
    car = getattr(plants, name)(**changes)

    def step(state, command, env):
        return car.step(state, command.at[0].add(case.steering), env)

    return car._replace(step=step) if case.steering else car


def roads(plant, case, count, seconds, seed):
    """Scenarios whose `observed_envs` lack what nobody measures, and keys."""
    # Where friction is reported wrong an accident is rare: half as many episodes more.
    count = 3 * count // 2 if case.friction else count
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

    actual = reported = made.envs
    if case.force:
        keys = jax.random.split(force_key, count)
        actual = jax.jit(jax.vmap(disturbed))(keys, made.envs)
    if case.friction:
        actual, reported = (made.envs.at[..., 0].set(one) for one in case.friction)
    made = made._replace(envs=actual, observed_envs=reported)
    return made, jax.random.split(drive_key, count)


class Rows(NamedTuple):
    """A shipped policy and the car that it was trained on."""

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

    def adaptive(self, model, *, estimate_env=False, **tube):
        """The same planner, adapting, with settings of its online tube."""
        settings = dict(self.loaded.settings["controller"], shield=False)
        settings["online_tube"] = dict(settings.get("online_tube") or {}, **tube)
        return build.build_controller(
            settings,
            model,
            self.plant,
            law=self.loaded.law,
            env_source="estimated" if estimate_env else "measured",
            adaptive=True,
            **self.box,
        )

    def oracle(self, car):
        """A car's own step as a model."""
        return build.reference_systems(car, self.loaded.law)["oracle"].model


def systems(rows, case, car):
    """Row -> (controller, parameters, whether it observes what nobody measures)."""
    model, own = rows.loaded.model, rows.loaded.params
    adapting = partial(rows.adaptive, model, estimate_env=case.estimate_env)
    knows = rows.planner(rows.oracle(car), bounded=False)
    made = {
        "oracle that knows": (knows, {}, True),
        "SFKD": (rows.planner(model), own, False),
        "SFKD, adaptive": (adapting(lane=None), own, False),
    }
    if not (case.car or case.steering):
        made["SFKD, adaptive, slower"] = (adapting(), own, False)
    if case.friction or case == CASES["nothing, S3"]:
        made["SFKD, adaptive, cautious"] = (adapting(grip=GRIP), own, False)
    if case.force:
        unknowing = rows.planner(rows.oracle(rows.plant))
        made["oracle that does not know"] = (unknowing, {}, False)
    if case.estimate_env:
        best = rows.adaptive(rows.oracle(rows.plant), estimate_env=True, lane=None)
        made["oracle, e estimated"] = (best, {}, False)
    return made


def missed(info):
    """Of every step: whether the tube was missed, and whether that is known."""
    at = jnp.asarray(LEADS) - 1
    # A controller without a tube misses none.
    if "tube" not in info:
        return jnp.zeros((2, len(LEADS)), bool)
    return jnp.stack([info["tube_missed"], jnp.isfinite(info["tube_errors"])])[:, at]


def drive(car, system, scene):
    """All episodes of a row at once, in short."""
    (controller, params, knows), (made, keys) = system, scene
    if knows:
        made = made._replace(observed_envs=made.envs)

    def one(road, key):
        return evaluation.simulate(
            car.step,
            controller,
            params,
            road,
            key,
            dt=car.dt,
            horizon=HORIZON,
            observation_noise=NOISE,
            record={"missed": missed},
        )

    episodes = jax.jit(jax.vmap(one))(made, keys)
    lateral = np.asarray(episodes.lateral, dtype=np.float64)
    largest = np.abs(lateral).max(axis=1)
    margin = metrics.LANE_HALF_WIDTH - metrics.VEHICLE_HALF_WIDTH
    errors = 1e3 * np.sqrt(np.mean(lateral[:, SETTLED:] ** 2, axis=1))
    result = {
        "left_the_lane": int(np.sum(~(largest <= margin))),
        "largest_mm": round(1e3 * float(largest.max()), 1),
        "rmse_mm": np.round(errors, 3).tolist(),
    }
    left, known = np.moveaxis(np.asarray(episodes.signals["missed"]), 2, 0)
    if known.any():
        inside = 1.0 - np.sum(left & known, axis=(0, 1)) / np.sum(known, axis=(0, 1))
        shares = np.round(inside, 4).tolist()
        result["coverage"] = dict(zip(map(str, LEADS), shares, strict=True))
    return result


def main():
    """Drive and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cars", nargs="*", choices=CARS, default=list(CARS))
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=2027)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    given, lines = parser.parse_args(), []
    shipped = Path(policy.__file__).parent / "pretrained"
    for name in given.cars:
        loaded = policy.load(shipped / f"{name}_path")
        rows = Rows(loaded, loaded.vehicle)
        for label in given.cases:
            case = CASES[label]
            car = changed_car(name, case)
            scene = roads(car, case, given.episodes, given.seconds, given.seed)
            for row, system in systems(rows, case, car).items():
                about = {"car": name, "case": label, "row": row}
                lines.append(json.dumps(about | drive(car, system, scene)))
                print(lines[-1], flush=True)
    protocol = {key: getattr(given, key) for key in ("episodes", "seconds", "seed")}
    body = ",\n  ".join(lines)
    text = f'{json.dumps(protocol)[:-1]}, "rows": [\n  {body}\n]}}\n'
    given.out.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
