"""Certify the corridor of a policy: calibrate it, test it and attack it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sfkd_jax import build, policy
from sfkd_jax.certification import (
    CertificateContradicted,
    OutputMetric,
    calibrate_corridor,
    corridor_coverage,
    fixed_point_corridor,
    fixed_points,
)
from sfkd_jax.control import safety_filter
from sfkd_jax.corridor._drives import (
    EXCITATION,
    ROADS,
    Loop,
    drive_measurement,
    drive_options,
    policy_loop,
)
from sfkd_jax.data import drive_switching, generate_s3_along_path
from sfkd_jax.evaluation import Outcome, Tube, attack_corridor, outcome_of
from sfkd_jax.geometry import PATH_SPEED, path_state
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.types import Control, Key

STREAM = 4
"""Stream folded into the data set's seed; the data set uses streams 0 to 2."""


def certify_corridor(
    settings: Mapping[str, Any],
    trained: policy.TrainedModel,
    outputs: Mapping[str, OutputMetric],
    *,
    drives: int = 150,
    duration: Annotated[float, Interval("(2, inf)")] = 60.0,
    dwell: Span = (3.0, 6.0),
    horizon: int = 20,
    attack_steps: int = 200_000,
) -> dict[str, Any]:
    """Return the entry of the certificate about the corridor.

    The class of drives: e switches in E with at least the dwell time, roads and
    perturbations ν are those of the data set, the law reads the state through the
    sensors, and a drive lasts `duration`. One part of `drives` fixes the units, one
    calibrates and one tests. The drives of S3, which is not in the class, are tested
    too.

    Args:
        settings: of the run.
        trained: its policy, with a law.
        outputs: proved metrics.
        drives: number of drives of each part.
        duration: of a drive [s].
        dwell: range of times between switches [s].
        horizon: preview of the shield [steps].
        attack_steps: of the search for drives that leave the corridor.

    Raises:
        ValueError: too few drives for the level, or a policy without a law.
    """
    began = time.perf_counter()
    loop = policy_loop(
        build.build_vehicle(settings["vehicle"]),
        trained,
        settings["evaluation"]["observation_noise"],
    )
    level = settings["certification"]["level"]
    data = settings["dataset"]
    roads = {name: data[name] for name in ROADS}
    box = {name: data[name] for name in ("env_low", "env_high")}
    excited = roads | {name: data[name] for name in EXCITATION}
    *drive_keys, sensor_key, attack_key = jax.random.split(
        jax.random.fold_in(jax.random.key(data["seed"]), STREAM), 6
    )
    options = drive_options(loop, excited, duration)
    switching = partial(
        drive_switching, loop.plant, drives=drives, dwell=dwell, **box, **options
    )
    held_out = partial(generate_s3_along_path, loop.plant, segments=drives, **options)
    kinds = (switching, switching, switching, held_out)
    measure = drive_measurement(loop, outputs)
    measured = [
        measure(jax.jit(kind)(drive_key), key)
        for kind, drive_key, key in zip(
            kinds, drive_keys, jax.random.split(sensor_key, len(kinds)), strict=True
        )
    ]
    units, calibration, test, s3 = (part.scores for part in measured)
    bounds = calibrate_corridor(units, calibration, level=level)
    searching = box | roads | {"dwell": dwell[0], "steps": attack_steps}
    lateral, copied = measured[2].lateral, measured[2].copied
    protocol = {
        "env_box": [*box.values()],
        "dwell_s": dwell,
        "duration_s": duration,
        "sensor_noise": loop.noise,
    }
    return {
        "class": excited | protocol | {"perturbation": loop.law.perturbation.tolist()},
        "level": level,
        "drives": drives,
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["followed_position"],
        **corridor_coverage(bounds, test),
        "by_scenario": {"s3": corridor_coverage(bounds, s3)},
        "seen": {
            "distance_m": float(np.max(np.abs(lateral - copied))),
            "lateral_m": float(np.max(np.abs(lateral))),
        },
        "fixed_points": _fixed_point_corridor(
            loop,
            outputs["position"],
            [part.roads for part in measured[:3]],
            bounds,
            protocol,
        ),
        "attack": _attack(
            loop, attack_key, outputs["position"], bounds, searching, horizon
        ),
        "shield_horizon": horizon,
        "seconds": time.perf_counter() - began,
    }


def _fixed_point_corridor(
    loop: Loop,
    claim: OutputMetric,
    roads: Sequence[Float[np.ndarray, "drive time 2"]],
    bounds: Mapping[str, float],
    protocol: Mapping[str, Any],
) -> dict[str, Any]:
    """The corridor around the fixed points, which needs no nominal copy.

    It is computed from the steps of every road with the largest change of curvature,
    the largest change of speed, and the largest v² κ.
    """
    driven = np.concatenate(roads)
    steps = np.stack([driven[:, :-1], driven[:, 1:]], axis=2)
    changes = np.abs(steps[:, :, 1] - steps[:, :, 0])
    sharpness = np.abs(steps[:, :, 0, 0]) * steps[:, :, 0, 1] ** 2
    chosen = [
        np.argmax(size, axis=1)
        for size in (changes[..., 0], changes[..., 1], sharpness)
    ]
    extreme = np.concatenate([steps[np.arange(len(steps)), index] for index in chosen])
    start = path_state(
        jnp.zeros(len(loop.plant.state_names) - 3).at[PATH_SPEED].set(extreme[0, 0, 1])
    )
    options = {
        "env_box": protocol["env_box"],
        "perturbation": loop.law.perturbation,
        "start": start,
    }
    points = fixed_points(
        loop.model, loop.params, claim, jnp.asarray(extreme), **options
    )
    return fixed_point_corridor(
        points,
        alpha=claim.alpha,
        lipschitz=claim.lipschitz,
        for_ever=bounds["for_ever_position"],
        steps_between_switches=math.floor(
            protocol["dwell_s"][0] / loop.plant.dt + 1e-9
        ),
    )


def _attack(
    loop: Loop,
    key: Key,
    claim: OutputMetric,
    bounds: Mapping[str, float],
    options: dict[str, Any],
    horizon: int,
) -> dict[str, Any]:
    """Search for the worst drives, without and with the shield.

    Raises:
        CertificateContradicted: a car left its tube while the disturbances stayed
            within their bound, which is impossible.
    """
    model, params, limit = loop.model, loop.params, loop.law.perturbation
    width, bound = bounds["nominal"], bounds["followed_position"]
    factor = jnp.asarray(np.linalg.cholesky(claim.metric), dtype=float)
    tube = Tube(claim.alpha, claim.lipschitz, factor, bound)
    search = partial(
        attack_corridor, loop.plant, model, tube=tube, perturbation=limit, **options
    )
    worst_drives = jax.jit(search)(params, key)

    def shielded(drives: Any) -> Outcome:
        length = len(drives.inputs)
        ahead = jnp.minimum(
            jnp.arange(length)[:, None] + jnp.arange(horizon), length - 1
        )
        roads = drives.inputs[ahead, 2:]

        def apply_filter(
            fiber: Any, latent: Any, wanted: Control, index: Any
        ) -> Control:
            return safety_filter(
                model, fiber, latent, wanted, roads[index], limit, width=width
            ).nu

        return outcome_of(loop.plant, model, params, tube, drives, apply_filter)

    held = jax.jit(jax.vmap(jax.vmap(shielded)))(worst_drives.drives)
    within = np.asarray(held.radius) <= bound
    worst = {
        "lateral_m": np.max(worst_drives.outcome.lateral),
        "distance_m": np.max(worst_drives.outcome.distance),
        "shielded_lateral_m": np.max(held.lateral),
        "kept_lateral_m": np.max(np.asarray(held.lateral), where=within, initial=0.0),
        "kept_distance_m": np.max(np.asarray(held.distance), where=within, initial=0.0),
    }
    worst = {name: float(value) for name, value in worst.items()}
    shares = {
        "over_corridor": worst["kept_lateral_m"] / (width + bound),
        "over_tube": worst["kept_distance_m"] / bound,
    }
    if not shares["over_tube"] <= 1.0:
        raise CertificateContradicted(
            f"INTERNAL ERROR: {worst['kept_distance_m']:.4f} m from the copy, "
            f"and the tube is {bound:.4f} m"
        )
    return {"steps": options["steps"]} | worst | shares
