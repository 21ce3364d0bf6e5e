"""The closed loop of a policy on the true plant, and measurements of its drives."""

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
from sfkd_jax.geometry import LATERAL, PERTURBATION
from sfkd_jax.plants import Vehicle
from sfkd_jax.rollout import fold, in_batches, rollout
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

ROADS = ("speed", "peak_curvature", "wavelengths", "lateral_acceleration")
EXCITATION = ("steering_excitation", "speed_excitation")
BATCH = 20


class Loop(NamedTuple):
    """The closed loop of plant and law, and the model of the policy.

    Attributes:
        plant: the true plant with the law around it.
        law: of the policy.
        model: of the policy.
        params: of the model, folded.
        noise: standard deviations of the sensors.
    """

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]


class MeasuredDrives(NamedTuple):
    """Measurements of a batch of drives.

    Attributes:
        lateral: e_y of the car [m].
        copied: ê_y of the nominal copy [m].
        scores: corridor bounds that each drive needs.
        roads: κ [1/m] and v_ref [m/s] at every step.
    """

    lateral: Float[np.ndarray, "drive time"]
    copied: Float[np.ndarray, "drive time"]
    scores: DriveScores
    roads: Float[np.ndarray, "drive time 2"]


def policy_loop(
    plant: Vehicle, trained: policy.TrainedModel, noise: Sequence[float]
) -> Loop:
    """Return the closed loop of a policy, with folded weights.

    Args:
        plant: to be driven.
        trained: a policy with a law.
        noise: standard deviations of the sensors.

    Raises:
        ValueError: the policy has no law.
    """
    if trained.law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: "
            "model.frame=path"
        )
    params = jax.jit(partial(fold, trained.model))(trained.params)
    return Loop(
        build.build_loop(plant, trained.law),
        trained.law,
        trained.model,
        params,
        tuple(noise),
    )


def drive_options(
    loop: Loop, settings: Mapping[str, Any], duration: float
) -> dict[str, Any]:
    """Return the options of `drive_along_path` for the drives of a class.

    Args:
        loop: its law reads the state through the sensors.
        settings: entries of `ROADS` and `EXCITATION`.
        duration: of a drive [s].
    """
    options = {name: settings[name] for name in (*ROADS, *EXCITATION)}
    steps = round(duration / loop.plant.dt)
    return options | {
        "steps": steps,
        "sensors": partial(_sensor_effect, loop),
        "offset": (0.0, 0.0, 0.0),
        "burn_in": 0,
    }


def drive_measurement(
    loop: Loop, outputs: Mapping[str, OutputMetric]
) -> Callable[[Trajectory, Key], MeasuredDrives]:
    """Return (drives, key for the sensors) -> measurements.

    It is compiled once for all batches of one size.

    Args:
        loop: that was driven.
        outputs: proved metrics.
    """
    simulate_copy = jax.jit(partial(_simulate_copy, loop))

    def measure(drives: Trajectory, key: Key) -> MeasuredDrives:
        copied, gaps = (
            np.asarray(part, dtype=np.float64) for part in simulate_copy(drives, key)
        )
        initial = {
            name: np.linalg.norm(
                gaps @ np.linalg.cholesky(outputs[name].metric), axis=1
            )
            for name in OUTPUTS
        }
        errors = residuals(loop.model, loop.params, drives)
        scores = drive_scores(errors, outputs, np.max(np.abs(copied), axis=1), initial)
        lateral = np.asarray(drives.states, dtype=np.float64)[:, 1:, BODY][..., LATERAL]
        return MeasuredDrives(
            lateral,
            copied,
            scores,
            np.asarray(drives.controls)[..., PERTURBATION.stop :],
        )

    return measure


def _simulate_copy(
    loop: Loop, drives: Trajectory, key: Key
) -> tuple[Float[Array, "drive time"], Float[Array, "drive rank"]]:
    """Return ê_y of a copy that starts at the true state, and z_0 − ẑ_0.

    ẑ_0 is the latent state of a copy that starts at the measured state.
    """
    model, spread = loop.model, _spread(loop.noise, drives.states.shape[-1])

    def copied(drive: Trajectory) -> jax.Array:
        return rollout(model, loop.params, drive)[0][:, BODY][:, LATERAL]

    def gap(state: State, env: Environment, key: Key) -> jax.Array:
        fiber = model.fiber(loop.params, env)
        measured = state + spread * jax.random.normal(key, state.shape)
        return model.vector(model.encode(fiber, measured)) - model.vector(
            model.encode(fiber, state)
        )

    keys = jax.random.split(key, len(drives.states))
    gaps = jax.vmap(gap)(drives.states[:, 0], drives.envs[:, 0], keys)
    return in_batches(copied, drives, size=BATCH), gaps


def _sensor_effect(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> jax.Array:
    """Return the change of ν because the law reads ξ through the sensors."""
    coordinates, road = state[BODY], inputs[PERTURBATION.stop :]
    spread = _spread(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    return loop.law(measured, road[0], road[1], env) - loop.law(
        coordinates, road[0], road[1], env
    )


def _spread(noise: tuple[float, ...], size: int) -> jax.Array:
    """Standard deviations of a path state from those of the sensors.

    e_y takes that of a position, e_ψ that of yaw, the other coordinates their own.
    """
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))
