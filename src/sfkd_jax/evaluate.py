"""python -m sfkd_jax.evaluate: drive paired episodes with every system and score them."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import artefacts, assembly, evaluation, shelf, walk
from sfkd_jax.config import door
from sfkd_jax.types import Controller

KIND = "episodes"


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Rows of results.json and the episodes behind them; rows of other scenarios in the same run stay."""
    began = time.perf_counter()
    place, protocol = shelf.run_directory(settings), settings["evaluation"]
    plant = assembly.build_vehicle(settings["vehicle"])
    systems = _systems(settings, plant)
    family = assembly.build_scenario(settings["scenario"], plant, duration=protocol["episode_s"])
    road_key, drive_key = jax.random.split(jax.random.key(protocol["seed"]))
    roads = jax.jit(jax.vmap(family))(jax.random.split(road_key, protocol["episodes"]))
    keys = jax.random.split(drive_key, protocol["episodes"])
    scenario, rows, scores = settings["scenario"]["name"], {}, {}
    arrays = {f"{scenario}/envs": roads.envs, f"{scenario}/path": roads.path.points, "dt": np.asarray(plant.dt)}
    for name, system in systems.items():
        box = settings["dataset"]
        controller = assembly.build_controller(
            settings["controller"], system.model, plant, env_low=box["env_low"], env_high=box["env_high"]
        )
        shelf.say(f"driving {protocol['episodes']} episodes of {protocol['episode_s']:.0f} s: {name} on {scenario}")
        options = {"horizon": settings["controller"]["mppi"]["horizon"], "dt": plant.dt}
        options["observation_noise"] = tuple(protocol["observation_noise"])
        drive = partial(evaluation.simulate, plant.step, controller, system.params, **options)
        episodes = jax.jit(jax.vmap(drive))(roads, keys)
        scores[name] = evaluation.score(episodes, np.asarray(roads.envs), dt=plant.dt)
        about = _about(settings, name, system)
        timing = _act_ms(controller, system.params, roads, keys[0], options, protocol["timed_steps"])
        rows[name] = evaluation.row(scores[name], about, timing)
        for part in ("lateral", "states", "controls"):
            arrays[f"{name}/{scenario}/{part}"] = getattr(episodes, part)
        shelf.say(f"  rmse {rows[name]['rmse_m']['mean']:.4f} m, worst {rows[name]['max_deviation_m']:.3f} m")
    _write(place, settings, evaluation.compare(rows, scores), arrays, time.perf_counter() - began)
    return {"results": str(place / "results.json"), "rows": len(rows)}


def _systems(settings: dict[str, Any], plant: Any) -> dict[str, assembly.System]:
    """The systems asked for; "self" is the policy of this run."""
    references, found = assembly.reference_systems(plant), {}
    for name in settings["evaluation"]["systems"]:
        if name == "self":
            trained = walk.ensure_policy(settings)
            told = "measured" if trained.settings["model"].get("environment", True) else "none"
            found[trained.settings["model"]["system"]] = assembly.System(trained.model, trained.params, told)
        else:
            found[name] = assembly.choose(references | {"self": None}, name, "evaluation.systems entry")
    return found


def _about(settings: dict[str, Any], name: str, system: assembly.System) -> dict[str, Any]:
    """The columns of a row that are known before anything is driven."""
    protocol = settings["evaluation"]
    return {
        "system": name,
        "model": settings["model"]["name"] if system.params else name,
        "controller": settings["controller"]["name"],
        "sampling": settings["controller"]["sampling"],
        "env": system.env,
        "scenario": settings["scenario"]["name"],
        "vehicle": settings["vehicle"]["name"],
        "inner_loop": settings["vehicle"]["inner_loop"],
        "seeds": [settings["seed"]],
        "episodes": protocol["episodes"],
        "episode_s": protocol["episode_s"],
        "params": sum(leaf.size for leaf in jax.tree.leaves(system.params)) or None,
    }


def _act_ms(
    controller: Controller, params: Any, roads: Any, key: Any, options: dict[str, Any], steps: int
) -> tuple[float, float] | None:
    """Median and 99 % quantile of `steps` compiled control steps after ten to warm up [ms]; None for no steps."""
    if not steps:
        return None
    road = jax.tree.map(lambda leaf: leaf[0], roads)
    reference = evaluation.first_reference(road, horizon=options["horizon"], dt=options["dt"])
    act, state = jax.jit(controller.act), controller.init(key)
    times = []
    for _ in range(10 + steps):
        start = time.perf_counter()
        _, state, _ = jax.block_until_ready(act(params, state, road.initial_state, road.envs[0], reference))
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[10:])), float(np.quantile(times[10:], 0.99))


def _write(place: Path, settings: dict[str, Any], rows: list, arrays: dict[str, Any], seconds: float) -> None:
    """Store rows and episodes; what other scenarios left in this run stays."""
    place.mkdir(parents=True, exist_ok=True)
    results, episodes = place / "results.json", place / "episodes.npz"
    kept = artefacts.read_json(results, keys=("rows",))["rows"] if results.exists() else []
    old = artefacts.read_arrays(episodes, kind=KIND)[0] if artefacts.exists(episodes) else {}
    config = {name: settings[name] for name in ("vehicle", "controller", "evaluation")}
    arrays = old | {name: np.asarray(array) for name, array in arrays.items()}
    artefacts.write_arrays(episodes, arrays, kind=KIND, config=config)
    document = {
        "rows": evaluation.merge(kept, rows),
        "config": settings,
        "versions": artefacts.versions(),
        "seconds": seconds,
    }
    artefacts.write_json(results, document)


if __name__ == "__main__":
    door(run)()
