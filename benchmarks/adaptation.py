"""Adapting where the car, its environment or a force is not what the policy was given.

    python -m benchmarks.adaptation [--cars dynamic --cases NAME ... --episodes 16]

Law, planner and roads are equal in all rows of a case; no shield. Every setting was chosen
on episodes of seed 100. Writes benchmarks/adaptation.json, one line a row.
"""

import json
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import arguments, write
from benchmarks.device import CARS, SETTLED, SHIPPED, driving, family, rmse_mm
from sfkd_jax import build, plants, policy
from sfkd_jax.evaluation.metrics import room_in_lane
from sfkd_jax.plants import equivalent_wind
from sfkd_jax.scenarios import random_side_forces


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


def roads(plant, case, given):
    """Scenarios whose `observed_envs` lack what nobody measures, and keys."""
    sample = family(plant, case.scenario, given.seconds, speed=10.0)
    road_key, drive_key, force_key = jax.random.split(jax.random.key(given.seed), 3)
    made = jax.jit(jax.vmap(sample))(jax.random.split(road_key, given.episodes))

    def disturbed(key, envs):
        forces = random_side_forces(
            key, steps=len(envs), dt=plant.dt, largest=case.force, hold=case.hold
        )
        wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))
        return envs.at[:, 1].set(wind(envs[:, 1], forces))

    made = made._replace(observed_envs=made.envs)
    if case.force:
        keys = jax.random.split(force_key, given.episodes)
        made = made._replace(envs=jax.jit(jax.vmap(disturbed))(keys, made.envs))
    return made, jax.random.split(drive_key, given.episodes)


def planner(loaded, model, *, bounded=True, adaptive=False, source="measured"):
    """The policy's own planner with another model, without a shield."""
    settings = dict(loaded.settings["controller"], shield=False)
    ends = loaded.settings["environment"] if bounded else {}
    return build.build_controller(
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
    model, own = loaded.model, loaded.params
    # Systems that know a car have its own step as their model.
    oracle, unknowing = (
        build.reference_systems(one, loaded.law)["oracle"].model
        for one in (car, loaded.vehicle)
    )
    source = "estimated" if case.estimate_env else "measured"
    adapting = partial(planner, loaded, adaptive=True, source=source)
    made = {
        "oracle that knows": (planner(loaded, oracle, bounded=False), {}, True),
        "SFKD": (planner(loaded, model), own, False),
        "SFKD, adaptive": (adapting(model), own, False),
    }
    if case.force:
        made["oracle that does not know"] = (planner(loaded, unknowing), {}, False)
    if case.estimate_env:
        made["oracle, e estimated"] = (adapting(unknowing), {}, False)
    return made


def drive(car, system, scene):
    """All episodes of a row at once, in short."""
    (controller, params, knows), (made, keys) = system, scene
    if knows:
        made = made._replace(observed_envs=made.envs)

    episodes = jax.jit(jax.vmap(driving(car, controller, params)))(made, keys)
    lateral = np.asarray(episodes.lateral, dtype=np.float64)
    largest = np.abs(lateral).max(axis=1)
    return {
        "left_the_lane": int(np.sum(~(largest <= room_in_lane(car.size)))),
        "largest_mm": round(1e3 * float(largest.max()), 1),
        "rmse_mm": np.round(rmse_mm(lateral[:, SETTLED:]), 3).tolist(),
    }


def main():
    """Drive and write."""
    protocol, rows = {"episodes": 16, "seconds": 30.0, "seed": 2027}, []
    given = arguments(__doc__, __file__, cars=CARS, cases=CASES, **protocol)
    for name in given.cars:
        loaded = policy.load(SHIPPED / f"{name}_path")
        for label in given.cases:
            case = CASES[label]
            car = changed_car(loaded, case)
            scene = roads(car, case, given)
            for row, system in systems(loaded, case, car).items():
                about = {"car": name, "case": label, "row": row}
                rows.append(about | drive(car, system, scene))
                print(json.dumps(rows[-1]), flush=True)
    write(given.out, {key: getattr(given, key) for key in protocol}, rows)


if __name__ == "__main__":
    main()
