"""The corridor of a policy along a path: drives of its class on the true plant, what they bound, and an attack."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import assembly, policy
from sfkd_jax.certification import (
    OUTPUTS,
    CertificateContradicted,
    DriveScores,
    OutputMetric,
    calibrate,
    covered,
    drive_scores,
    residuals,
)
from sfkd_jax.control import PathLaw, admit
from sfkd_jax.datasets import drive_switching, generate_s3_along_path
from sfkd_jax.evaluation import Outcome, Tube, attack_corridor, outcome_of
from sfkd_jax.path_frame import LATERAL, PERTURBATION
from sfkd_jax.rollouts import in_batches, rollout
from sfkd_jax.types import BODY, Control, Environment, Key, Model, Params, State, Trajectory
from sfkd_jax.vehicle import Vehicle

ROADS = ("speed", "peak_curvature", "wavelengths", "lateral_acceleration")
EXCITATION = ("steering_excitation", "speed_excitation")
STREAM = 4
"""Folded into the data set's seed; its drives take the streams 0 to 2."""
BATCH = 20


class _Loop(NamedTuple):
    """The true plant with the law of a policy around it, and that policy's model beside it, folded."""

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]


def certify_corridor(
    settings: Mapping[str, Any],
    trained: policy.Trained,
    outputs: Mapping[str, OutputMetric],
    *,
    drives: int = 150,
    duration: float = 60.0,
    dwell: tuple[float, float] = (3.0, 6.0),
    horizon: int = 20,
    attack_steps: int = 200_000,
) -> dict[str, Any]:
    """The document's part about a corridor.

    Its class: any switching in E that holds for at least the dwell time, roads and perturbations ν like those of the
    data set, the law seeing the car through the sensors, drives of `duration`. Three times `drives` are made: one part
    fixes the units, one calibrates, one tests. S3's own schedule is none of them and is tested on as well.

    Args:
        settings: of the run. trained: its policy, with a law. outputs: proved metrics.
        drives: of each part. duration: of a drive [s]. dwell: range of times between switches [s].
        horizon: preview of the shield [steps]. attack_steps: of the search for drives that leave the corridor.

    Raises:
        ValueError: too few drives for the level, or a policy without a law.
    """
    began = time.perf_counter()
    loop = _closed(settings, trained)
    level, data = settings["certification"]["level"], assembly.without(settings["dataset"])
    roads = {name: data[name] for name in ROADS}
    box = {name: data[name] for name in ("env_low", "env_high")}
    asked = roads | {name: data[name] for name in EXCITATION}
    *drive_keys, sensor_key, attack_key = jax.random.split(jax.random.fold_in(jax.random.key(data["seed"]), STREAM), 6)
    options = asked | {"sensors": partial(_seen, loop), "offset": (0.0, 0.0, 0.0), "burn_in": 0}
    options["steps"] = round(duration / loop.plant.dt)
    switching = partial(drive_switching, loop.plant, drives=drives, dwell=dwell, **box, **options)
    held_out = partial(generate_s3_along_path, loop.plant, segments=drives, **options)
    kinds = (switching, switching, switching, held_out)
    driven = [jax.jit(kind)(key) for kind, key in zip(kinds, drive_keys, strict=True)]
    copies = [_copied(loop, part) for part in driven]
    scores = [
        _scores(loop, outputs, part, copied, key)
        for part, copied, key in zip(driven, copies, jax.random.split(sensor_key, len(driven)), strict=True)
    ]
    bounds = calibrate(scores[0], scores[1], level=level)
    searching = box | roads | {"dwell": dwell[0], "steps": attack_steps}
    lateral = np.asarray(driven[2].states, dtype=np.float64)[:, 1:, BODY][..., LATERAL]
    about = {"env_box": [*box.values()], "dwell_s": dwell, "duration_s": duration, "sensor_noise": loop.noise}
    return {
        "class": asked | about | {"perturbation": loop.law.perturbation.tolist()},
        "level": level,
        "drives": drives,
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["followed_position"],
        **covered(bounds, scores[2]),
        "by_scenario": {"s3": covered(bounds, scores[3])},
        "seen": {
            "distance_m": float(np.max(np.abs(lateral - copies[2]))),
            "lateral_m": float(np.max(np.abs(lateral))),
        },
        "attack": _attack(loop, attack_key, outputs["position"], bounds, searching, horizon),
        "shield_horizon": horizon,
        "seconds": time.perf_counter() - began,
    }


def _closed(settings: Mapping[str, Any], trained: policy.Trained) -> _Loop:
    """The loop of a policy, with the weights as they drive.

    Raises:
        ValueError: the policy has no law.
    """
    if trained.law is None:
        raise ValueError("a corridor needs a policy in path coordinates, with its law: model.frame=path")
    plant = assembly.build_loop(assembly.build_vehicle(settings["vehicle"]), trained.law)
    params = jax.jit(trained.model.fold)(trained.params)
    return _Loop(plant, trained.law, trained.model, params, tuple(settings["evaluation"]["observation_noise"]))


def _copied(loop: _Loop, drives: Trajectory) -> np.ndarray:
    """ê_y of a copy that starts where the car does, (drive, time)."""

    def one(drive: Trajectory) -> jax.Array:
        return rollout(loop.model, loop.params, drive)[0][:, BODY][:, LATERAL]

    return np.asarray(jax.jit(partial(in_batches, one, size=BATCH))(drives), dtype=np.float64)


def _scores(
    loop: _Loop, outputs: Mapping[str, OutputMetric], drives: Trajectory, copied: np.ndarray, key: Key
) -> DriveScores:
    """What the corridor would have had to be; a real copy starts from what the sensors say."""
    model, spread = loop.model, _spread(loop.noise, drives.states.shape[-1])

    def apart(state: State, env: Environment, key: Key) -> jax.Array:
        fiber = model.fiber(loop.params, env)
        seen = state + spread * jax.random.normal(key, state.shape)
        return model.vector(model.encode(fiber, seen)) - model.vector(model.encode(fiber, state))

    keys = jax.random.split(key, len(drives.states))
    gaps = np.asarray(jax.jit(jax.vmap(apart))(drives.states[:, 0], drives.envs[:, 0], keys), dtype=np.float64)
    initial = {name: np.linalg.norm(gaps @ np.linalg.cholesky(outputs[name].metric), axis=1) for name in OUTPUTS}
    found = residuals(model, loop.params, drives)
    return drive_scores(found, outputs, np.max(np.abs(copied), axis=1), initial)


def _attack(
    loop: _Loop,
    key: Key,
    claim: OutputMetric,
    bounds: Mapping[str, float],
    options: dict[str, Any],
    horizon: int,
) -> dict[str, Any]:
    """The worst drives that a search finds, without the shield and with it, against what is claimed.

    Raises:
        CertificateContradicted: a car left its tube while the disturbances kept their bound, which is impossible.
    """
    model, params, limit = loop.model, loop.params, loop.law.perturbation
    width, bound = bounds["nominal"], bounds["followed_position"]
    factor = jnp.asarray(np.linalg.cholesky(claim.metric), dtype=float)
    tube = Tube(claim.alpha, claim.lipschitz, factor, bound)
    search = partial(attack_corridor, loop.plant, model, tube=tube, perturbation=limit, **options)
    found = jax.jit(search)(params, key)

    def shielded(drives: Any) -> Outcome:
        length = len(drives.inputs)
        ahead = jnp.minimum(jnp.arange(length)[:, None] + jnp.arange(horizon), length - 1)
        roads = drives.inputs[ahead, 2:]

        def let_through(fiber: Any, latent: Any, wanted: Control, index: Any) -> Control:
            return admit(model, fiber, latent, wanted, roads[index], limit, width=width).nu

        return outcome_of(loop.plant, model, params, tube, drives, let_through)

    held = jax.jit(jax.vmap(jax.vmap(shielded)))(found.drives)
    kept = np.asarray(held.radius) <= bound
    worst = {
        "lateral_m": np.max(found.outcome.lateral),
        "distance_m": np.max(found.outcome.distance),
        "shielded_lateral_m": np.max(held.lateral),
        "kept_lateral_m": np.max(np.asarray(held.lateral), where=kept, initial=0.0),
        "kept_distance_m": np.max(np.asarray(held.distance), where=kept, initial=0.0),
    }
    worst = {name: float(value) for name, value in worst.items()}
    shares = {
        "over_corridor": worst["kept_lateral_m"] / (width + bound),
        "over_tube": worst["kept_distance_m"] / bound,
    }
    if not shares["over_tube"] <= 1.0:
        raise CertificateContradicted(
            f"INTERNAL ERROR: {worst['kept_distance_m']:.4f} m from the copy, and the tube is {bound:.4f} m"
        )
    return {"steps": options["steps"]} | worst | shares


def _seen(loop: _Loop, key: Key, state: State, inputs: Control, env: Environment) -> jax.Array:
    """What the law adds to ν because it sees ξ through the sensors."""
    coordinates, road = state[BODY], inputs[PERTURBATION.stop :]
    spread = _spread(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    return loop.law(measured, road[0], road[1], env) - loop.law(coordinates, road[0], road[1], env)


def _spread(noise: tuple[float, ...], size: int) -> jax.Array:
    """Standard deviations along a path state: e_y has that of a position, e_ψ that of yaw, the rest its own."""
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))
