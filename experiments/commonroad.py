"""Drive CommonRoad's cars with the shipped policy in path coordinates, as it is and adapting.

python -m experiments.commonroad [--cars std mb --paths 3 --seconds 60 --seed 2027] needs the
extra `plants`. Nothing is trained: no model has seen these cars. Beside the policy MPPI
plans with the textbook bicycle of our car's wheelbase, once in the world frame and once
along the path. Writes experiments/commonroad.json.
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import arguments, write
from benchmarks.device import SETTLED, SHIPPED, driving, family, rmse_mm
from sfkd_jax import adapters, build, policy

FRICTIONS = (0.9, 0.6, 0.3)


def drivers():
    """Row -> (controller, parameters); all observe the states of our dynamic car."""
    directory = SHIPPED / "dynamic_path"
    trained, world = map(policy.restore, (directory, SHIPPED / "dynamic"))
    ours, along = trained.vehicle, dict(trained.settings["controller"], shield=False)
    box = {
        f"env_{side}": trained.settings["environment"][side] for side in ("low", "high")
    }
    planner = partial(build.build_controller, plant=ours, law=trained.law)
    bicycle = build.reference_systems(ours)["nominal"]
    path = build.reference_systems(ours, trained.law)["nominal"]
    in_world = build.build_controller(world.settings["controller"], bicycle.model, ours)
    adaptive = sfkd_jax.load(directory, controller=along | {"adaptive": True})
    return {
        "nominal": (in_world, bicycle.params),
        "nominal, along the path": (planner(along, path.model), path.params),
        "SFKD": (planner(along, trained.model, **box), trained.params),
        "SFKD, adaptive": (adaptive.controller, adaptive.params),
    }


def of_seven(controller):
    """A controller of our dynamic car, which begins with the same 7 states, for these."""

    def act(params, memory, state, *rest):
        return controller.act(params, memory, state[..., :7], *rest)

    return controller._replace(act=act)


def roads(car, paths, seconds, seed):
    """S1's paths at every friction, and the same keys for each: (friction x path, …)."""
    road_key, drive_key = jax.random.split(jax.random.key(seed))
    made = jax.jit(jax.vmap(family(car, "s1", seconds)))(
        jax.random.split(road_key, paths)
    )
    tiled = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(FRICTIONS)), made)
    levels = jnp.repeat(jnp.asarray(FRICTIONS), paths)[:, None]
    envs = tiled.envs.at[..., 0].set(levels)
    keys = jnp.tile(jax.random.split(drive_key, paths), len(FRICTIONS))
    return tiled._replace(envs=envs, observed_envs=envs), keys


def drive(car, controller, params, track):
    """RMSE of the first and of the second half of every run [mm], (friction, path)."""
    one = driving(car.step, of_seven(controller), params)
    lateral = jax.jit(jax.vmap(one))(*track).lateral
    # The second half shows what is left after the causes have been estimated.
    half = lateral.shape[1] // 2
    return [
        np.round(rmse_mm(part), 3).reshape(len(FRICTIONS), -1)
        for part in (lateral[:, SETTLED:half], lateral[:, half:])
    ]


def main():
    """Parse, drive, write."""
    protocol, rows = {"paths": 3, "seconds": 60.0, "seed": 2027}, []
    given = arguments(__doc__, __file__, cars=("std", "mb"), **protocol)
    for name in given.cars:
        car = adapters.commonroad_vehicle(model=name)
        track = roads(car, given.paths, given.seconds, given.seed)
        for label, driver in drivers().items():
            began = time.perf_counter()
            halves = drive(car, *driver, track)
            spent = time.perf_counter() - began
            print(f"{name}: {label}: {spent:.0f} s", file=sys.stderr)
            for friction, first, second in zip(FRICTIONS, *halves, strict=True):
                row = {"car": name, "row": label, "friction": friction}
                row |= {"first_half_mm": first.tolist()}
                rows.append(row | {"second_half_mm": second.tolist()})
    write(given.out, {key: getattr(given, key) for key in protocol}, rows)


if __name__ == "__main__":
    main()
