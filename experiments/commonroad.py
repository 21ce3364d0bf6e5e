"""Drive CommonRoad's cars with the shipped policy along a path, as it is and adapting.

    python -m experiments.commonroad [--cars std mb --paths 3 --seconds 60 --seed 2027]

It needs the extra `plants`. Nothing is trained: no model has seen these cars. Beside the
policy, MPPI plans with the textbook bicycle of our car's wheelbase, once in the world frame
and once along the path. The results go to experiments/commonroad.json.
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks import arguments, stamp, write
from benchmarks.device import SETTLED, SHIPPED, driving, family, rmse_mm
from sfkd_jax import adapters, assembly, policy

POLICY = "dynamic_path"
FRICTIONS = (0.9, 0.6, 0.3)


def drivers():
    """Row -> (controller, parameters); all observe the states of our dynamic car."""
    directory = SHIPPED / POLICY
    trained = policy.restore(directory)
    in_body_frame = policy.restore(SHIPPED / "dynamic")
    plant = trained.vehicle
    settings = dict(trained.settings["controller"], shield=False)
    box = trained.settings["environment"]
    along_path = partial(
        assembly.build_controller, settings, plant=plant, law=trained.law
    )
    bicycle = assembly.reference_systems(plant)["nominal"]
    bicycle_along_path = assembly.reference_systems(plant, trained.law)["nominal"]
    in_world = assembly.build_controller(
        in_body_frame.settings["controller"], bicycle.model, plant
    )
    ours = along_path(trained.model, env_low=box["low"], env_high=box["high"])
    adaptive = sfkd_jax.load(directory, controller=settings | {"adaptive": True})
    return {
        "nominal": (in_world, bicycle.params),
        "nominal, along the path": (
            along_path(bicycle_along_path.model),
            bicycle_along_path.params,
        ),
        "SFKD": (ours, trained.params),
        "SFKD, adaptive": (adaptive.controller, adaptive.params),
    }


def of_seven(controller):
    """A controller of our dynamic car for cars whose first 7 states are those of ours."""

    def act(params, memory, state, *rest):
        return controller.act(params, memory, state[..., :7], *rest)

    return controller._replace(act=act)


def roads(car, paths, seconds, seed):
    """S1's paths at every friction, and the same keys for each: (friction x path, …)."""
    road_key, drive_key = jax.random.split(jax.random.key(seed))
    sample = jax.jit(jax.vmap(family(car, "s1", seconds)))
    scenes = sample(jax.random.split(road_key, paths))
    tiled = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(FRICTIONS)), scenes)
    levels = jnp.repeat(jnp.asarray(FRICTIONS), paths)[:, None]
    envs = tiled.envs.at[..., 0].set(levels)
    keys = jnp.tile(jax.random.split(drive_key, paths), len(FRICTIONS))
    return tiled._replace(envs=envs, observed_envs=envs), keys


def drive(car, controller, params, scenes, keys):
    """RMSE of the first and of the second half of every run [mm], (friction, path)."""
    episode = driving(car.step, of_seven(controller), params)
    lateral = jax.jit(jax.vmap(episode))(scenes, keys).lateral
    # The second half shows what is left after the causes have been estimated.
    half = lateral.shape[1] // 2
    return [
        np.round(rmse_mm(part), 3).reshape(len(FRICTIONS), -1)
        for part in (lateral[:, SETTLED:half], lateral[:, half:])
    ]


def main():
    """Parse, drive, write."""
    protocol = {"paths": 3, "seconds": 60.0, "seed": 2027}
    options = arguments(__doc__, __file__, cars=("std", "mb"), **protocol)
    made_by = stamp(POLICY)
    rows = []
    for name in options.cars:
        car = adapters.commonroad_vehicle(model=name)
        scenes, keys = roads(car, options.paths, options.seconds, options.seed)
        for label, (controller, params) in drivers().items():
            began = time.perf_counter()
            halves = drive(car, controller, params, scenes, keys)
            spent = time.perf_counter() - began
            print(f"{name}: {label}: {spent:.0f} s", file=sys.stderr)
            for friction, first, second in zip(FRICTIONS, *halves, strict=True):
                row = {
                    "car": name,
                    "row": label,
                    "friction": friction,
                    "first_half_mm": first.tolist(),
                    "second_half_mm": second.tolist(),
                }
                rows.append(row | made_by)
    write(options.out, {name: getattr(options, name) for name in protocol}, rows)


if __name__ == "__main__":
    main()
