"""A test drive: one system on paired episodes, its scores, and how often it left what is claimed about it."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, evaluation
from sfkd_jax.certification import conformal_tube, latent_tube
from sfkd_jax.datasets import Dataset, to_path
from sfkd_jax.pipeline import store
from sfkd_jax.scenarios import Scenario
from sfkd_jax.types import Trajectory
from sfkd_jax.vehicle import Vehicle, check_step

OPEN_LOOP_STEPS = (1, 5, 10, 20)


class Track(NamedTuple):
    """Paired episodes before anybody drives them.

    Attributes:
        scenario: its name.
        variation: what is unusual about it, or None.
        roads: with the environment that is met.
        told: the environment that a driver is told.
        keys: one per episode, for sensors and samplers.
    """

    scenario: str
    variation: str | None
    roads: Scenario
    told: jax.Array
    keys: jax.Array


class Drive(NamedTuple):
    """A row of results.json before comparisons, and the arrays behind it."""

    row: dict[str, Any]
    arrays: dict[str, np.ndarray]


TestDriver: TypeAlias = Callable[[Track], Drive]


def lay(settings: dict[str, Any], plant: Vehicle) -> Track:
    """The episodes of a scenario; on several devices they are spread over all of them.

    Raises:
        ValueError: a vehicle that nothing can drive.
    """
    check_step(plant)
    protocol = settings["evaluation"]
    family = build.build_scenario(
        settings["scenario"], plant, duration=protocol["episode_s"]
    )
    road_key, drive_key = jax.random.split(jax.random.key(protocol["seed"]))
    roads = jax.jit(jax.vmap(family))(jax.random.split(road_key, protocol["episodes"]))
    keys = jax.random.split(drive_key, protocol["episodes"])
    hear = partial(evaluation.told, dt=plant.dt, **build.without(protocol["told"]))
    told = jax.jit(jax.vmap(hear))(roads.envs, keys)
    return Track(
        settings["scenario"]["name"],
        protocol["variation"],
        *_spread((roads, told, keys)),
    )


def prepare(
    settings: dict[str, Any],
    plant: Vehicle,
    name: str,
    system: build.System,
    dataset: Dataset | None,
) -> TestDriver:
    """Compile a system for driving; the same driver serves every track of one length, with one compilation.

    Args:
        settings: of the run.
        plant: the truth.
        name: of the system.
        system: who drives.
        dataset: whose calibration drives give the conformal tube, and whose test drives
            the open-loop error; without it there is neither.
    """
    protocol, box = settings["evaluation"], settings["dataset"]
    limits = {
        "env_low": box["env_low"],
        "env_high": box["env_high"],
        "certificate": system.certificate,
    }
    limits |= {"env_source": system.env_source, "law": system.law}
    if dataset is not None:
        limits |= {
            "env_low": dataset.env_low.tolist(),
            "env_high": dataset.env_high.tolist(),
        }
    controller = build.build_controller(
        settings["controller"], system.model, plant, **limits
    )
    options = {
        "horizon": build.controller_horizon(settings["controller"]),
        "dt": plant.dt,
    }
    options["observation_noise"] = tuple(protocol["observation_noise"])
    about = _about(settings, name, system)
    system = system._replace(
        params=jax.jit(system.model.fold)(system.params)
    )  # or every step evaluates it anew

    def one(road: Scenario, key: Any, met: Any) -> evaluation.Episode:
        return evaluation.simulate(
            plant.step, controller, system.params, road, key, met=met, **options
        )

    compiled = jax.jit(jax.vmap(one))
    assess = _assessor(settings, system, dataset, plant.dt)
    about |= {"open_loop_rmse_m": _open_loop(settings, system, dataset)}
    timing: list[Any] = []

    def drive(track: Track) -> Drive:
        episodes, scores, violation = pushed(track, 0.0)
        if not timing:
            timing.append(
                _act_ms(
                    controller, system.params, track, options, protocol["timed_steps"]
                )
            )
        where = about | {"scenario": track.scenario, "variation": track.variation}
        row = evaluation.row(
            scores, where, timing[0], violation, watched=system.certificate is not None
        )
        if protocol["side_forces"]:
            row["disturbed"] = [
                evaluation.disturbed(
                    force, *(pushed(track, force)[1:] if force else (scores, violation))
                )
                for force in protocol["side_forces"]
            ]
        arrays = {
            part: np.asarray(getattr(episodes, part))
            for part in ("lateral", "states", "controls")
        }
        return Drive(row, arrays)

    def pushed(
        track: Track, force: float
    ) -> tuple[evaluation.Episode, evaluation.Scores, dict[str, Any]]:
        push = jax.jit(jax.vmap(partial(evaluation.pushed, plant, largest=force)))
        met = push(track.roads.envs, track.keys) if force else track.roads.envs
        episodes = compiled(track.roads._replace(envs=track.told), track.keys, met)
        return episodes, *assess(episodes, track)

    return drive


def _assessor(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None, dt: float
) -> Callable[..., Any]:
    """episodes, track -> how they were driven, and how often predictions along them left what is claimed."""
    length, horizon = settings["dataset"]["steps"], settings["certification"]["horizon"]
    predict = jax.jit(
        partial(evaluation.predictions, system.model, length=length, horizon=horizon)
    )
    claims = _claims(settings, system, dataset)

    def seen(driven: Trajectory, road: Scenario) -> Trajectory:
        """A drive as the model sees it."""
        law = system.law
        if law is None:
            return driven
        return to_path(
            driven, road.path, law, jnp.full(driven.controls.shape[0], road.speed)
        )

    def assess(
        episodes: evaluation.Episode, track: Track
    ) -> tuple[evaluation.Scores, dict[str, Any]]:
        driven = Trajectory(episodes.states, episodes.controls, episodes.believed)
        driven = jax.jit(jax.vmap(seen))(driven, track.roads)
        long_enough = driven.controls.shape[1] >= length
        found = jax.device_get(predict(system.params, driven)) if long_enough else None
        scores = evaluation.score(episodes, np.asarray(track.roads.envs), dt=dt)
        return scores, evaluation.violations(found, claims)

    return assess


def _claims(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None
) -> evaluation.Claims:
    """What is claimed about a system's predictions: by its certificate if it has one, and by calibration drives."""
    level, horizon = (settings["certification"][name] for name in ("level", "horizon"))
    claims = evaluation.Claims(
        level=level, threshold=settings["evaluation"]["threshold_m"]
    )
    if dataset is not None:
        try:
            parts = {
                "validation": dataset.validation,
                "calibration": dataset.calibration,
            }
            options = {"level": level, "horizon": horizon, "stride": evaluation.STRIDE}
            claims = claims._replace(
                conformal=conformal_tube(
                    system.model, system.params, **parts, **options
                )
            )
        except ValueError as reason:
            store.say(f"  no conformal tube: {reason}")
    proof = system.certificate
    if proof is None:
        return claims
    if (len(proof["tube"]["latent"]), proof["d_bar"]["level"]) != (horizon, level):
        store.say(
            "  the certificate is of another horizon or level and is not compared"
        )
        return claims
    d_bar = proof["d_bar"]["value"]
    latent = latent_tube(proof["alpha"], d_bar, horizon)
    return claims._replace(
        certified=proof["tube"]["physical"], latent=latent, d_bar=d_bar
    )


def _open_loop(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None
) -> dict[str, float] | None:
    """Position RMSE of free-running predictions on the test split, by steps ahead [m]."""
    if dataset is None:
        return None
    horizon = settings["certification"]["horizon"]
    errors = jax.jit(partial(evaluation.open_loop, system.model, horizon=horizon))(
        system.params, dataset.test
    )
    distance = np.hypot(*np.asarray(errors, dtype=np.float64).T[:2])
    return {
        str(step): float(distance[step - 1])
        for step in OPEN_LOOP_STEPS
        if step <= horizon
    }


def _about(settings: dict[str, Any], name: str, system: build.System) -> dict[str, Any]:
    """The columns of a row that are known before anything is driven."""
    protocol, certificate = settings["evaluation"], system.certificate
    return {
        "system": name,
        "model": settings["model"]["name"] if system.params else name,
        "controller": settings["controller"]["name"],
        "planner": settings["controller"]["planner"],
        "sampling": settings["controller"]["sampling"],
        "env": system.env_source,
        "vehicle": settings["vehicle"]["name"],
        "inner_loop": settings["vehicle"]["inner_loop"],
        "seeds": [settings["seed"]],
        "episodes": protocol["episodes"],
        "episode_s": protocol["episode_s"],
        "params": sum(leaf.size for leaf in jax.tree.leaves(system.params)) or None,
        "alpha": certificate and certificate["alpha"],
    }


def _act_ms(
    controller: Any, params: Any, track: Track, options: dict[str, Any], steps: int
) -> tuple[float, float] | None:
    """Median and 99 % quantile of `steps` compiled control steps after ten to warm up [ms]; None for no steps."""
    if not steps:
        return None
    road = jax.tree.map(lambda leaf: leaf[0], track.roads)
    reference = evaluation.first_reference(
        road, horizon=options["horizon"], dt=options["dt"]
    )
    act, state = jax.jit(controller.act), controller.init(track.keys[0])
    times = []
    for _ in range(10 + steps):
        start = time.perf_counter()
        _, state, _ = jax.block_until_ready(
            act(params, state, road.initial_state, road.envs[0], reference)
        )
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[10:])), float(np.quantile(times[10:], 0.99))


def _spread(batch: Any) -> Any:
    """Episodes dealt evenly to all devices, where they can be."""
    devices = jax.devices()
    if len(devices) == 1 or len(jax.tree.leaves(batch)[0]) % len(devices):
        return batch
    mesh = jax.sharding.Mesh(devices, ("episode",))
    return jax.device_put(
        batch, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("episode"))
    )
