"""A policy's loop on the true plant, and how far the car strays on every drive of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax import build, policy
from sfkd_jax.certification import (
    OUTPUTS,
    DriveScores,
    OutputMetric,
    drive_scores,
    residuals,
)
from sfkd_jax.control import PathLaw
from sfkd_jax.core.path_frame import LATERAL, PERTURBATION
from sfkd_jax.core.rollouts import in_batches, rollout
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Model,
    Params,
    State,
    Trajectory,
)
from sfkd_jax.vehicle import Vehicle

ROADS = ("speed", "peak_curvature", "wavelengths", "lateral_acceleration")
EXCITATION = ("steering_excitation", "speed_excitation")
BATCH = 20


class Loop(NamedTuple):
    """The true plant with the law of a policy around it, and that policy's model beside it, folded."""

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]


class Measured(NamedTuple):
    """Of a batch of drives.

    Attributes:
        lateral: e_y of the car [m].
        copied: ê_y of its copy [m].
        scores: what a corridor would have had to be.
        roads: κ [1/m] and v_ref [m/s] at every step.
    """

    lateral: Float[np.ndarray, "drive time"]
    copied: Float[np.ndarray, "drive time"]
    scores: DriveScores
    roads: Float[np.ndarray, "drive time 2"]


def closed(plant: Vehicle, trained: policy.TrainedModel, noise: Sequence[float]) -> Loop:
    """The loop of a policy, with the weights as they drive.

    Args:
        plant: what is driven.
        trained: with a law.
        noise: standard deviations of the sensors.

    Raises:
        ValueError: the policy has no law.
    """
    if trained.law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: model.frame=path"
        )
    params = jax.jit(trained.model.fold)(trained.params)
    return Loop(
        build.build_loop(plant, trained.law),
        trained.law,
        trained.model,
        params,
        tuple(noise),
    )


def driving(loop: Loop, asked: Mapping[str, Any], duration: float) -> dict[str, Any]:
    """Options of `drive_along_path` for the drives of a class.

    Args:
        loop: whose law sees the car through its sensors.
        asked: entries of `ROADS` and `EXCITATION`.
        duration: of a drive [s].
    """
    options = {name: asked[name] for name in (*ROADS, *EXCITATION)}
    steps = round(duration / loop.plant.dt)
    return options | {
        "steps": steps,
        "sensors": partial(_seen, loop),
        "offset": (0.0, 0.0, 0.0),
        "burn_in": 0,
    }


def measuring(
    loop: Loop, outputs: Mapping[str, OutputMetric]
) -> Callable[[Trajectory, Key], Measured]:
    """A function of drives and a key for the sensors; compiled once for all batches of one size.

    Args:
        loop: that drove.
        outputs: proved metrics.
    """
    beside = jax.jit(partial(_beside, loop))

    def measure(drives: Trajectory, key: Key) -> Measured:
        copied, gaps = (
            np.asarray(part, dtype=np.float64) for part in beside(drives, key)
        )
        initial = {
            name: np.linalg.norm(
                gaps @ np.linalg.cholesky(outputs[name].metric), axis=1
            )
            for name in OUTPUTS
        }
        found = residuals(loop.model, loop.params, drives)
        scores = drive_scores(found, outputs, np.max(np.abs(copied), axis=1), initial)
        lateral = np.asarray(drives.states, dtype=np.float64)[:, 1:, BODY][..., LATERAL]
        return Measured(
            lateral,
            copied,
            scores,
            np.asarray(drives.controls)[..., PERTURBATION.stop :],
        )

    return measure


def _beside(
    loop: Loop, drives: Trajectory, key: Key
) -> tuple[Float[Array, "drive time"], Float[Array, "drive rank"]]:
    """ê_y of a copy that starts where the car does, and z_0 − ẑ_0 of a real copy: that one starts from the sensors."""
    model, spread = loop.model, _spread(loop.noise, drives.states.shape[-1])

    def copied(drive: Trajectory) -> jax.Array:
        return rollout(model, loop.params, drive)[0][:, BODY][:, LATERAL]

    def apart(state: State, env: Environment, key: Key) -> jax.Array:
        fiber = model.fiber(loop.params, env)
        seen = state + spread * jax.random.normal(key, state.shape)
        return model.vector(model.encode(fiber, seen)) - model.vector(
            model.encode(fiber, state)
        )

    keys = jax.random.split(key, len(drives.states))
    gaps = jax.vmap(apart)(drives.states[:, 0], drives.envs[:, 0], keys)
    return in_batches(copied, drives, size=BATCH), gaps


def _seen(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> jax.Array:
    """What the law adds to ν because it sees ξ through the sensors."""
    coordinates, road = state[BODY], inputs[PERTURBATION.stop :]
    spread = _spread(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    return loop.law(measured, road[0], road[1], env) - loop.law(
        coordinates, road[0], road[1], env
    )


def _spread(noise: tuple[float, ...], size: int) -> jax.Array:
    """Standard deviations along a path state: e_y has that of a position, e_ψ that of yaw, the rest its own."""
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))
