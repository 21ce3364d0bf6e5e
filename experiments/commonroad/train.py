"""Drive CommonRoad's cars on three frictions: shipped policies, the nominal bicycle, policies trained on such a car.

python -m experiments.commonroad.train [--paths 3 --seconds 15 --segments 200 --steps 400 --out
experiments/commonroad] Needs the extra `plants`. The tuned policies, their
certificates, an export and finished rows go to --root; after an interruption the same
command continues there.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks.timing.own_model import settings as composed
from experiments.commonroad import tune
from sfkd_jax import adapters, build, evaluation, scenarios, store
from sfkd_jax import export as exporting
from sfkd_jax.types import Controller

FRICTIONS = (0.9, 0.6, 0.3)
CARS = ("std", "mb")
SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
POLICIES = {"sfkd": "dynamic", "sfkd_kinematic": "kinematic"}
"""Row -> the plant of ours that its policy was trained on."""


class Driver(NamedTuple):
    """Who drives: `states` is what it knows of a car, None for everything; `about` goes
    into its row.
    """

    controller: Controller
    params: Any
    states: int | None
    about: dict[str, Any]


def policy_driver(trained, system):
    """A policy, from where `sfkd_jax.load` found it."""
    names = build.build_vehicle(trained.settings["vehicle"]).state_names
    about = {
        "system": system,
        "env": "measured",
        "alpha": trained.certificate and trained.certificate["alpha"],
    }
    return Driver(trained.controller, trained.params, len(names), about)


def nominal_driver(args, plant, system, states):
    """MPPI on the textbook bicycle with the wheelbase of `plant`."""
    result = build.reference_systems(plant)["nominal"]
    controller = build.build_controller(args["controller"], result.model, plant)
    return Driver(
        controller,
        result.params,
        states,
        {"system": system, "env": result.env_source, "alpha": None},
    )


def make_road(plant, paths, seconds, seed):
    """S1's paths at every friction, and the same keys for each: (friction x path, …)."""
    family = build.build_scenario({"name": "s1"}, plant, duration=seconds)
    road_key, drive_key = jax.random.split(jax.random.key(seed))
    roads = jax.jit(jax.vmap(family))(jax.random.split(road_key, paths))
    tiled = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(FRICTIONS)), roads)
    levels = jnp.repeat(jnp.asarray(FRICTIONS), paths)[:, None]
    keys = jnp.tile(jax.random.split(drive_key, paths), len(FRICTIONS))
    envs = tiled.envs.at[..., 0].set(levels)
    return tiled._replace(envs=envs, observed_envs=envs), keys


def rows_of(plant, driver, track, args, paths):
    """Drive every road of a track; one row a friction."""
    roads, keys = track
    controller = driver.controller
    if driver.states:
        controller = adapters.commonroad_controller(controller, states=driver.states)
    options = {"dt": plant.dt, "horizon": build.controller_horizon(args["controller"])}
    options["observation_noise"] = tuple(args["evaluation"]["observation_noise"])

    def one(road, key):
        return evaluation.simulate(
            plant.step, controller, driver.params, road, key, **options
        )

    began = time.perf_counter()
    episodes = jax.block_until_ready(jax.jit(jax.vmap(one))(roads, keys))
    print(
        f"{plant.name} {driver.about['system']}: {time.perf_counter() - began:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    nothing, rows = evaluation.violations(None, evaluation.Claims()), []
    for directory, friction in enumerate(FRICTIONS):
        chosen = slice(directory * paths, (directory + 1) * paths)
        part, envs = jax.tree.map(
            lambda leaf, chosen=chosen: leaf[chosen], (episodes, roads.envs)
        )
        scores = evaluation.score(part, np.asarray(envs), dt=plant.dt)
        about = driver.about | {
            "scenario": f"s1, friction {friction}",
            "friction": friction,
            "vehicle": plant.name,
        }
        about |= {"sampling": args["controller"]["sampling"], "variation": None}
        rows.append(evaluation.row(scores, about, None, nothing))
    return rows


def compared(rows):
    """RMSE over that of the nominal bicycle by path, and of a tuned policy over the
    policy before; None if it spun.
    """
    result = {
        (row["vehicle"], row["friction"], row["system"]): _by_path(row) for row in rows
    }
    for row in rows:
        where, mine = (row["vehicle"], row["friction"]), _by_path(row)
        for name in ("nominal", "nominal_this_car"):
            other = result[*where, name]
            row[f"ratio_to_{name}"] = float(mine.mean() / other.mean())
            row[f"worst_ratio_to_{name}"] = float(np.max(mine / other))
        before = (
            result.get((*where, row["system"].removesuffix("_tuned")))
            if row["system"].endswith("_tuned")
            else None
        )
        row["ratio_to_untuned"] = (
            None if before is None else float(mine.mean() / before.mean())
        )
    return rows


def _by_path(row):
    """RMSE of every path [m], NaN where the car stopped or spun."""
    return np.asarray(row["rmse_episodes_m"], dtype=float)


def handling(plants, steering=0.04, seconds=3.0):
    """Curvature ω / v of a steady turn at about 10 m/s over that of the bicycle with
    our car's wheelbase.
    """
    nominal = np.tan(steering) / plants["dynamic"].wheelbase
    return {
        name: [_steady(plant, steering, each, seconds) / nominal for each in FRICTIONS]
        for name, plant in plants.items()
    }


def _steady(plant, steering, friction, seconds):
    """Turn of the yaw over the last step's way [1/m]."""
    step, before = jax.jit(plant.step), None
    state = jnp.zeros(len(plant.state_names)).at[3].set(10.0)
    for _ in range(round(seconds / plant.dt)):
        before, state = (
            state,
            step(state, jnp.asarray([steering, 0.0]), jnp.asarray([friction, 0.0])),
        )
    return float((state[2] - before[2]) / jnp.linalg.norm(state[:2] - before[:2]))


def exported_alike(trained, plant, track, root):
    """Drive one road with the controller as it is and as exported: RMSE, and the
    largest difference of a control.
    """
    exporting.write_controller(
        trained, root / "export", made_from={}, platforms=("cpu",)
    )
    sys.path.insert(0, str(root / "export"))
    from run_controller import ExportedController

    shipped, act, step = (
        ExportedController(root / "export"),
        jax.jit(trained.controller.act),
        jax.jit(plant.step),
    )
    road = jax.tree.map(lambda leaf: leaf[0], track[0])
    drivers = {
        "as it is": (
            trained.controller.init(jax.random.key(0)),
            lambda *seen: act(trained.params, *seen),
        ),
        "exported": (shipped.init(seed=0), shipped.act),
    }
    horizon = build.controller_horizon(trained.settings["controller"])
    drives = {
        name: _host_drive(*driver, step, road, plant.dt, horizon)
        for name, driver in drivers.items()
    }
    (controls, lateral), (others, _) = drives["exported"], drives["as it is"]
    difference = float(np.abs(controls - others).max())
    return {
        "steps": len(controls),
        "rmse_m": float(np.sqrt(np.mean(lateral**2))),
        "largest_difference": difference,
    }


def _host_drive(memory, act, step, road, dt, horizon):
    """The closed loop without noise, one step after the other: controls, lateral
    deviations.
    """
    window = jax.jit(
        lambda s: scenarios.reference_window(
            road.path, s, road.speed, dt=dt, horizon=horizon
        )
    )
    locate = jax.jit(
        lambda state, s: scenarios.project(road.path, state[:2], s + road.speed * dt)
    )
    state, progress, controls, lateral = road.initial_state, jnp.zeros(()), [], []
    for env in road.envs:
        seen = adapters.commonroad_observation(state)
        control, memory, _ = act(memory, seen, env, window(progress))
        state = step(state, control, env)
        progress, offset = locate(state, progress)
        controls.append(np.asarray(control))
        lateral.append(float(offset))
    return np.asarray(controls), np.asarray(lateral)


def main():
    """Parse, tune, drive, compare, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("paths", 3), ("segments", 200), ("steps", 400)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--root", type=Path, default=Path("runs/commonroad"))
    parser.add_argument("--out", type=Path, default=Path("experiments/commonroad"))
    given, args = parser.parse_args(), composed()
    plants = {name: adapters.commonroad_vehicle(model=name) for name in CARS}
    before = {row: sfkd_jax.load(SHIPPED / ours) for row, ours in POLICIES.items()}
    sizes = {"segments": given.segments, "steps": given.steps}
    after, tuning = tune.tune_all(before, plants["std"], args, given.root, **sizes)
    rows, trained = (
        [],
        before | {f"{row}_tuned": policy for row, policy in after.items()},
    )
    for car, plant in plants.items():
        track = make_road(plant, given.paths, given.seconds, args["evaluation"]["seed"])
        directory = (
            given.root
            / "rows"
            / "-".join(map(str, (car, given.paths, given.seconds, *sizes.values())))
        )
        ours = build.build_vehicle(args["vehicle"])
        drivers = [nominal_driver(args, ours, "nominal", len(ours.state_names))]
        drivers += [nominal_driver(args, plant, "nominal_this_car", None)]
        drivers += [policy_driver(policy, row) for row, policy in trained.items()]
        for driver in drivers:
            path = directory / f"{driver.about['system']}.json"
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                store.write_json(
                    path, {"rows": rows_of(plant, driver, track, args, given.paths)}
                )
            rows += store.read_json(path)["rows"]
    track = make_road(
        plants["std"], given.paths, given.seconds, args["evaluation"]["seed"]
    )
    alike = exported_alike(before["sfkd"], plants["std"], track, given.root)
    saved = {"paths": given.paths, "seconds": given.seconds, **sizes}
    turns = handling(
        {name: build.PLANTS[name]() for name in POLICIES.values()} | plants
    )
    document = {
        "rows": compared(rows),
        "tuning": tuning,
        "handling": turns,
        "export": alike,
        "config": saved | args,
    }
    document["versions"] = store.versions()
    store.write_json(given.out / "results.json", document)
    document = store.read_json(given.out / "results.json")
    for row in document["rows"]:
        mean = (
            "spun"
            if row["rmse_m"]["mean"] is None
            else f"{1e3 * row['rmse_m']['mean']:.1f} mm"
        )
        print(
            row["vehicle"],
            row["friction"],
            row["system"],
            mean,
            f"{row['departures']} departures",
            sep="  ",
        )
    print(json.dumps({"results": str(given.out / "results.json"), "rows": len(rows)}))


if __name__ == "__main__":
    main()
