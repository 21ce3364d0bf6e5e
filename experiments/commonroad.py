"""Drive CommonRoad's cars with the shipped policy in path coordinates, as it is and adapting.

python -m experiments.commonroad [--cars std mb --paths 3 --seconds 60 --seed 2027] needs the
extra `plants`. Nothing is trained: no model has seen these cars. Beside the policy MPPI
plans with the textbook bicycle of our car's wheelbase, once in the world frame and once
along the path. Writes experiments/commonroad.json.
"""

import argparse
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import hydra
import jax
import jax.numpy as jnp
import numpy as np
from omegaconf import OmegaConf

import sfkd_jax
from experiments import results
from sfkd_jax import adapters, build, evaluation, policy
from sfkd_jax.experiment import command
from sfkd_jax.types import Controller

FRICTIONS = (0.9, 0.6, 0.3)
SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained") / "dynamic_path"
SETTLED = 20
"""Steps at the start of an episode that do not count: 2 s."""


class Driver(NamedTuple):
    """A controller of our dynamic car and its parameters."""

    controller: Controller
    params: Any


def composed():
    """The settings of the commands for the dynamic car."""
    command.register()
    with hydra.initialize_config_dir(command.conf_path(), version_base="1.3"):
        chosen = hydra.compose("config", ["vehicle=dynamic"])
    return OmegaConf.to_container(chosen, resolve=True)


def drivers(settings):
    """Row -> who drives; all observe the seven states of our dynamic car."""
    trained = policy.restore(SHIPPED)
    ours, along = trained.vehicle, dict(trained.settings["controller"], shield=False)
    box = {
        f"env_{side}": trained.settings["environment"][side] for side in ("low", "high")
    }
    planner = partial(build.build_controller, plant=ours, law=trained.law)
    world = build.reference_systems(ours)["nominal"]
    path = build.reference_systems(ours, trained.law)["nominal"]
    adaptive = sfkd_jax.load(SHIPPED, controller=along | {"adaptive": True})
    return {
        "nominal": Driver(
            build.build_controller(settings["controller"], world.model, ours),
            world.params,
        ),
        "nominal, along the path": Driver(planner(along, path.model), path.params),
        "SFKD": Driver(planner(along, trained.model, **box), trained.params),
        "SFKD, adaptive": Driver(adaptive.controller, adaptive.params),
    }


def roads(car, paths, seconds, seed):
    """S1's paths at every friction, and the same keys for each: (friction x path, …)."""
    family = build.build_scenario({"name": "s1"}, car, duration=seconds)
    road_key, drive_key = jax.random.split(jax.random.key(seed))
    made = jax.jit(jax.vmap(family))(jax.random.split(road_key, paths))
    tiled = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(FRICTIONS)), made)
    levels = jnp.repeat(jnp.asarray(FRICTIONS), paths)[:, None]
    envs = tiled.envs.at[..., 0].set(levels)
    keys = jnp.tile(jax.random.split(drive_key, paths), len(FRICTIONS))
    return tiled._replace(envs=envs, observed_envs=envs), keys


def drive(car, driver, track, noise):
    """RMSE of the first and of the second half of every run [mm], (friction, path)."""
    controller = adapters.commonroad_controller(driver.controller)

    def one(road, key):
        return evaluation.simulate(
            car.step,
            controller,
            driver.params,
            road,
            key,
            dt=car.dt,
            horizon=20,
            observation_noise=noise,
        )

    lateral = np.asarray(jax.jit(jax.vmap(one))(*track).lateral, dtype=np.float64)
    # The second half shows what is left after the causes have been estimated.
    half = lateral.shape[1] // 2
    return [
        np.round(1e3 * np.sqrt(np.mean(part**2, axis=1)), 3).reshape(len(FRICTIONS), -1)
        for part in (lateral[:, SETTLED:half], lateral[:, half:])
    ]


def main():
    """Parse, drive, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cars", nargs="*", default=["std", "mb"])
    parser.add_argument("--paths", type=int, default=3)
    parser.add_argument("--seed", type=int, default=2027)
    parser.add_argument("--seconds", type=float, default=60.0)
    given, settings = parser.parse_args(), composed()
    rows, noise = [], tuple(settings["evaluation"]["observation_noise"])
    for name in given.cars:
        car = adapters.commonroad_vehicle(model=name)
        track = roads(car, given.paths, given.seconds, given.seed)
        for label, driver in drivers(settings).items():
            began = time.perf_counter()
            halves = drive(car, driver, track, noise)
            print(
                f"{name}: {label}: {time.perf_counter() - began:.0f} s", file=sys.stderr
            )
            for friction, first, second in zip(FRICTIONS, *halves, strict=True):
                row = {"car": name, "row": label, "friction": friction}
                row |= {"first_half_mm": first.tolist()}
                rows.append(row | {"second_half_mm": second.tolist()})
    protocol = {key: getattr(given, key) for key in ("paths", "seconds", "seed")}
    results.write("commonroad", protocol | {"rows": rows})


if __name__ == "__main__":
    main()
