"""python -m sfkd_jax.evaluate: drive paired episodes with every system and score them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import artefacts, assembly, evaluation, shelf, walk
from sfkd_jax.certification import conformal_tube, latent_tube
from sfkd_jax.config import door
from sfkd_jax.datasets import Dataset
from sfkd_jax.scenarios import Scenario
from sfkd_jax.types import Controller, Trajectory
from sfkd_jax.vehicle import Vehicle

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
    dataset, _ = walk.ensure_dataset(settings)
    horizon = settings["certification"]["horizon"]
    for name, system in systems.items():
        box = settings["dataset"]
        limits = {"env_low": box["env_low"], "env_high": box["env_high"], "certificate": system.certificate}
        controller = assembly.build_controller(settings["controller"], system.model, plant, **limits)
        shelf.say(f"driving {protocol['episodes']} episodes of {protocol['episode_s']:.0f} s: {name} on {scenario}")
        options = {"horizon": settings["controller"]["mppi"]["horizon"], "dt": plant.dt}
        options["observation_noise"] = tuple(protocol["observation_noise"])
        drive = _driver(plant, controller, system.params, roads, keys, options)
        assess = _assessor(system, dataset, _claims(settings, system, dataset), roads, plant.dt, horizon)
        episodes = drive(0.0)
        scores[name], violation = assess(episodes)
        about = _about(settings, name, system)
        timing = _act_ms(controller, system.params, roads, keys[0], options, protocol["timed_steps"])
        rows[name] = evaluation.row(scores[name], about, timing, violation, watched=system.certificate is not None)
        for part in ("lateral", "states", "controls"):
            arrays[f"{name}/{scenario}/{part}"] = getattr(episodes, part)
        shelf.say(f"  rmse {rows[name]['rmse_m']['mean']:.4f} m, worst {rows[name]['max_deviation_m']:.3f} m")
        if protocol["side_forces"]:
            shelf.say(f"  again under side forces of {', '.join(f'{force:g}' for force in protocol['side_forces'])} N")
            rows[name]["disturbed"] = [
                evaluation.disturbed(force, *assess(drive(force) if force else episodes))
                for force in protocol["side_forces"]
            ]
    _write(place, settings, evaluation.compare(rows, scores), arrays, time.perf_counter() - began)
    return {"results": str(place / "results.json"), "rows": len(rows)}


def _driver(
    plant: Vehicle, controller: Controller, params: Any, roads: Scenario, keys: Any, options: dict[str, Any]
) -> Callable[[float], evaluation.Episode]:
    """largest side force [N] -> all episodes of one system; without a force the plant meets what is measured."""

    def one(road: Scenario, key: Any, met: Any) -> evaluation.Episode:
        return evaluation.simulate(plant.step, controller, params, road, key, met=met, **options)

    compiled = jax.jit(jax.vmap(one))

    def drive(force: float) -> evaluation.Episode:
        push = jax.jit(jax.vmap(partial(evaluation.pushed, plant, largest=force)))
        return compiled(roads, keys, push(roads.envs, keys) if force else None)

    return drive


def _assessor(
    system: assembly.System, dataset: Dataset, claims: evaluation.Claims, roads: Scenario, dt: float, horizon: int
) -> Callable[[evaluation.Episode], tuple[evaluation.Scores, dict[str, Any]]]:
    """episodes -> how they were driven, and how often predictions along them left what is claimed."""
    length = dataset.calibration.controls.shape[1]
    predict = jax.jit(partial(evaluation.predictions, system.model, length=length, horizon=horizon))

    def assess(episodes: evaluation.Episode) -> tuple[evaluation.Scores, dict[str, Any]]:
        driven = Trajectory(episodes.states, episodes.controls, roads.envs)
        long_enough = driven.controls.shape[1] >= length
        found = jax.device_get(predict(system.params, driven)) if long_enough else None
        scores = evaluation.score(episodes, np.asarray(roads.envs), dt=dt)
        return scores, evaluation.violations(found, claims)

    return assess


def _claims(settings: dict[str, Any], system: assembly.System, dataset: Dataset) -> evaluation.Claims:
    """What is claimed about a system's predictions: by its certificate if it has one, and by calibration drives."""
    level, horizon = (settings["certification"][name] for name in ("level", "horizon"))
    claims = evaluation.Claims(level=level, threshold=settings["evaluation"]["threshold_m"])
    try:
        parts = {"validation": dataset.validation, "calibration": dataset.calibration}
        options = {"level": level, "horizon": horizon, "stride": evaluation.STRIDE}
        claims = claims._replace(conformal=conformal_tube(system.model, system.params, **parts, **options))
    except ValueError as reason:
        shelf.say(f"  no conformal tube: {reason}")
    proof = system.certificate
    if proof is None:
        return claims
    if (len(proof["tube"]["latent"]), proof["d_bar"]["level"]) != (horizon, level):
        shelf.say("  the certificate is of another horizon or level and is not compared")
        return claims
    d_bar = proof["d_bar"]["value"]
    latent = latent_tube(proof["alpha"], d_bar, horizon)
    return claims._replace(certified=proof["tube"]["physical"], latent=latent, d_bar=d_bar)


def _systems(settings: dict[str, Any], plant: Any) -> dict[str, assembly.System]:
    """The systems asked for; "self" is the policy of this run."""
    references, found = assembly.reference_systems(plant), {}
    for name in settings["evaluation"]["systems"]:
        if name == "self":
            trained = walk.ensure_policy(settings)
            told = "measured" if trained.settings["model"].get("environment", True) else "none"
            own = assembly.System(trained.model, trained.params, told, trained.certificate)
            found[trained.settings["model"]["system"]] = own
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
