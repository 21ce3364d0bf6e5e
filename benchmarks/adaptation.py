"""Adapting where the car, its environment or a force is not what the policy was given.

    python -m benchmarks.adaptation [--cars dynamic --cases NAME ... --episodes 16]

All rows of a case have the same law, the same planner and the same roads, and none has a
shield. Every setting was chosen on episodes of seed 100. The results go to
benchmarks/adaptation.json, one line a row.
"""

import json
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import arguments, stamp, write
from benchmarks.device import CARS, SETTLED, SHIPPED, driving, family, rmse_mm
from sfkd_jax import assembly, policy
from sfkd_jax.driving import plants
from sfkd_jax.driving.plants import equivalent_wind
from sfkd_jax.driving.scenarios import random_side_forces
from sfkd_jax.driving.simulation.metrics import room_in_lane


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
    "force, 3 s": Case(force=1000.0, hold=3.0),
    "mass + 30 %": Case(car=(("mass", 1.3),)),
    "stiffness - 30 %": Case(car=(("front_stiffness", 0.7), ("rear_stiffness", 0.7))),
    "steering + 1 degree": Case(steering=np.deg2rad(1.0)),
    "e not measured": Case(estimate_env=True),
    "nothing, S3": Case(),
    "force, 1 s": Case(force=1000.0),
    "wheelbase + 5 %": Case(car=(("front_length", 1.05), ("rear_length", 1.05))),
}


def changed_car(loaded, case):
    """The car of a case."""
    usual = loaded.settings["vehicle"]
    changes = {key: factor * usual[key] for key, factor in case.car}
    car = getattr(plants, usual["name"])(**changes)

    def step(state, command, env):
        return car.step(state, command.at[0].add(case.steering), env)

    return car._replace(step=step) if case.steering else car


def roads(plant, case, options):
    """Scenarios whose `observed_envs` lack what nobody measures, and keys of the runs."""
    sample = family(plant, case.scenario, options.seconds, speed=10.0)
    road_key, drive_key, force_key = jax.random.split(jax.random.key(options.seed), 3)
    scenes = jax.jit(jax.vmap(sample))(jax.random.split(road_key, options.episodes))

    def disturbed(key, envs):
        forces = random_side_forces(
            key, steps=len(envs), dt=plant.dt, largest=case.force, hold=case.hold
        )
        wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))
        return envs.at[:, 1].set(wind(envs[:, 1], forces))

    scenes = scenes._replace(observed_envs=scenes.envs)
    if case.force:
        keys = jax.random.split(force_key, options.episodes)
        scenes = scenes._replace(envs=jax.jit(jax.vmap(disturbed))(keys, scenes.envs))
    return scenes, jax.random.split(drive_key, options.episodes)


def planner(loaded, model, *, bounded=True, adaptive=False, source="measured"):
    """The policy's own planner with another model, without a shield."""
    settings = dict(loaded.settings["controller"], shield=False)
    ends = loaded.settings["environment"] if bounded else {}
    return assembly.build_controller(
        settings,
        model,
        loaded.vehicle,
        law=loaded.law,
        env_source=source,
        adaptive=adaptive,
        **{f"env_{side}": tuple(ends[side]) for side in ("low", "high") if ends},
    )


def systems(loaded, case, car):
    """Row -> (controller, parameters, whether it observes what nobody measures)."""
    model = loaded.model
    params = loaded.params
    # Systems that know a car have its own step as their model.
    knowing = assembly.reference_systems(car, loaded.law)["oracle"].model
    unknowing = assembly.reference_systems(loaded.vehicle, loaded.law)["oracle"].model
    source = "estimated" if case.estimate_env else "measured"
    adapting = partial(planner, loaded, adaptive=True, source=source)
    rows = {
        "oracle that knows": (planner(loaded, knowing, bounded=False), {}, True),
        "SFKD": (planner(loaded, model), params, False),
        "SFKD, adaptive": (adapting(model), params, False),
    }
    if case.force:
        rows["oracle that does not know"] = (planner(loaded, unknowing), {}, False)
    if case.estimate_env:
        rows["oracle, e estimated"] = (adapting(unknowing), {}, False)
    return rows


def drive(car, system, scenes, keys):
    """Drive all episodes of a row at once, and return its numbers."""
    controller, params, knows = system
    if knows:
        scenes = scenes._replace(observed_envs=scenes.envs)
    episodes = jax.jit(jax.vmap(driving(car, controller, params)))(scenes, keys)
    lateral = np.asarray(episodes.lateral, dtype=np.float64)
    largest = np.abs(lateral).max(axis=1)
    return {
        "left_the_lane": int(np.sum(~(largest <= room_in_lane(car.size)))),
        "largest_mm": round(1e3 * float(largest.max()), 1),
        "rmse_mm": np.round(rmse_mm(lateral[:, SETTLED:]), 3).tolist(),
    }


def main():
    """Drive and write."""
    protocol = {"episodes": 16, "seconds": 30.0, "seed": 2027}
    options = arguments(__doc__, __file__, cars=CARS, cases=CASES, **protocol)
    rows = []
    for name in options.cars:
        policy_name = f"{name}_path"
        loaded = policy.load(SHIPPED / policy_name)
        for label in options.cases:
            case = CASES[label]
            car = changed_car(loaded, case)
            scenes, keys = roads(car, case, options)
            for row, system in systems(loaded, case, car).items():
                about = {"car": name, "case": label, "row": row}
                numbers = drive(car, system, scenes, keys)
                rows.append(about | numbers | stamp(policy_name))
                print(json.dumps(rows[-1]), flush=True)
    write(options.out, {name: getattr(options, name) for name in protocol}, rows)


if __name__ == "__main__":
    main()
