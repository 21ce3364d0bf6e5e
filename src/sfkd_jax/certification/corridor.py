"""The corridor of a closed loop: calibrated on whole runs, tested and attacked.

The runs are those of the conditions that a certificate states: e switches in its box
with at least the dwell time, roads and perturbations ν are those of the data set, and
the law reads the state through the sensors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._attack import CertificateContradicted
from sfkd_jax.certification._calibration import coverage_interval
from sfkd_jax.certification._claims import OUTPUTS, OutputMetric
from sfkd_jax.certification._corridor import (
    RunScores,
    calibrate_corridor,
    corridor_coverage,
    run_scores,
)
from sfkd_jax.certification._document import output_metrics_from
from sfkd_jax.certification._tubes import residuals
from sfkd_jax.control import PathLaw, safety_filter
from sfkd_jax.data import drive_switching, generate_s3_along_path
from sfkd_jax.evaluation import CorridorAttack, Outcome, Tube, outcome_of
from sfkd_jax.geometry import LATERAL, PERTURBATION
from sfkd_jax.plants import Vehicle, along_path
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.rollout import fold, in_batches, rollout
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Model,
    Params,
    Scalar,
    State,
    Trajectory,
)

ROADS = ("speed", "peak_curvature", "wavelengths", "lateral_acceleration")
EXCITATION = ("steering_excitation", "speed_excitation")
BATCH = 20
STREAM = 4
"""Stream folded into the data set's seed; the data set uses streams 0 to 2."""
FRICTION = 0
"""Entry of e that is constant in a cell; the other entries switch in their range."""
PARTS = 3
"""Batches of runs: one fixes the units, one calibrates and one tests."""


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


class MeasuredRuns(NamedTuple):
    """Measurements of a batch of runs.

    Attributes:
        lateral: e_y of the car [m].
        nominal: ê_y of the nominal model [m].
        scores: corridor bounds that each run needs.
    """

    lateral: Float[np.ndarray, "run time"]
    nominal: Float[np.ndarray, "run time"]
    scores: RunScores


def closed_loop(
    plant: Vehicle,
    model: Model,
    params: Params,
    law: PathLaw | None,
    noise: Sequence[float],
) -> Loop:
    """Return the closed loop of a policy, with folded weights.

    Args:
        plant: to be driven.
        model: of the policy.
        params: its weights.
        law: of the policy.
        noise: standard deviations of the sensors.

    Raises:
        ValueError: the policy has no law.
    """
    # Without a law there is no closed loop whose corridor could be stated.
    if law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: "
            "model.frame=path"
        )
    folded = jax.jit(partial(fold, model))(params)
    steering, drive = (float(largest) for largest in law.perturbation)
    closed = along_path(plant, law, perturbation=(steering, drive))
    return Loop(closed, law, model, folded, tuple(noise))


def certify_corridor(
    loop: Loop,
    outputs: Mapping[str, OutputMetric],
    data: Mapping[str, Any],
    level: float,
    *,
    runs: int = 150,
    duration: Annotated[float, Interval("(2, inf)")] = 60.0,
    dwell: Span = (3.0, 6.0),
    horizon: int = 20,
    attack_steps: int = 200_000,
) -> dict[str, Any]:
    """Return the entry of the certificate about the corridor.

    One part of `runs` fixes the units, one calibrates and one tests. The runs of S3,
    which does not meet the conditions, are tested too.

    Args:
        loop: of the policy.
        outputs: proved metrics.
        data: of the data set: `ROADS`, `EXCITATION`, env_low, env_high and seed.
        level: 1 − δ.
        runs: number of runs of each part.
        duration: of a run [s].
        dwell: range of times between switches [s].
        horizon: preview of the shield [steps].
        attack_steps: of the search for runs that leave the corridor.

    Raises:
        ValueError: too few runs for the level.
        CertificateContradicted: the attack contradicts a bound.
    """
    began = time.perf_counter()
    roads = {name: data[name] for name in ROADS}
    box = {name: data[name] for name in ("env_low", "env_high")}
    excited = roads | {name: data[name] for name in EXCITATION}
    # A stream of its own: the data set's runs must not reappear in its certificate.
    *run_keys, sensor_key, attack_key = jax.random.split(
        jax.random.fold_in(jax.random.key(data["seed"]), STREAM), 6
    )
    options = run_options(loop, excited, duration)
    switching = partial(
        drive_switching, loop.plant, drives=runs, dwell=dwell, **box, **options
    )
    held_out = partial(generate_s3_along_path, loop.plant, segments=runs, **options)
    kinds = (switching, switching, switching, held_out)
    measure = run_measurement(loop, outputs)
    measured = [
        measure(jax.jit(kind)(run_key), key)
        for kind, run_key, key in zip(
            kinds, run_keys, jax.random.split(sensor_key, len(kinds)), strict=True
        )
    ]
    units, calibration, test, s3 = (part.scores for part in measured)
    bounds = calibrate_corridor(units, calibration, level=level)
    # The shortest dwell: an attack switches as often as the conditions allow.
    searching = box | roads | {"dwell": dwell[0], "steps": attack_steps}
    lateral, nominal = measured[2].lateral, measured[2].nominal
    conditions = {
        "env_box": [*box.values()],
        "dwell_s": dwell,
        "duration_s": duration,
        "sensor_noise": loop.noise,
        "perturbation": loop.law.perturbation.tolist(),
    }
    return {
        "conditions": excited | conditions,
        "level": level,
        "runs": runs,
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["vehicle_to_nominal_position"],
        **corridor_coverage(bounds, test),
        # S3 does not meet the conditions: reported beside the claim, never in it.
        "by_scenario": {"s3": corridor_coverage(bounds, s3)},
        "seen": {
            "distance_m": float(np.max(np.abs(lateral - nominal))),
            "lateral_m": float(np.max(np.abs(lateral))),
        },
        "attack": _attack(
            loop, attack_key, outputs["position"], bounds, searching, horizon
        ),
        "shield_horizon": horizon,
        "seconds": time.perf_counter() - began,
    }


def _attack(
    loop: Loop,
    key: Key,
    claim: OutputMetric,
    bounds: Mapping[str, float],
    options: dict[str, Any],
    horizon: int,
) -> dict[str, Any]:
    """Search for the worst runs, without and with the shield.

    Raises:
        CertificateContradicted: a car left its tube while the disturbances stayed
            within their bound, which is impossible.
    """
    model, params, limit = loop.model, loop.params, loop.law.perturbation
    width, bound = bounds["nominal"], bounds["vehicle_to_nominal_position"]
    factor = jnp.asarray(np.linalg.cholesky(claim.metric), dtype=float)
    tube = Tube(claim.alpha, claim.lipschitz, factor, bound)
    search = CorridorAttack(loop.plant, model, tube, perturbation=limit, **options)
    found = jax.jit(search)(params, key)

    def shielded(run: Any) -> Outcome:
        length = len(run.inputs)
        # The last inputs repeated: a preview at the end of a run has nothing further.
        ahead = jnp.minimum(
            jnp.arange(length)[:, None] + jnp.arange(horizon), length - 1
        )
        roads = run.inputs[ahead, 2:]

        def apply_filter(
            fiber: Any, latent: Any, wanted: Control, index: Any
        ) -> Control:
            return safety_filter(
                model, fiber, latent, wanted, roads[index], limit, width=width
            ).nu

        return outcome_of(loop.plant, model, params, tube, run, apply_filter)

    held = jax.jit(jax.vmap(jax.vmap(shielded)))(found.runs)
    # The corridor is claimed only while the disturbances keep their bound
    within = np.asarray(held.radius) <= bound
    worst = {
        "lateral_m": np.max(found.outcome.lateral),
        "distance_m": np.max(found.outcome.distance),
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
            f"INTERNAL ERROR: {worst['kept_distance_m']:.4f} m from the nominal model, "
            f"and the tube is {bound:.4f} m"
        )
    return {"steps": options["steps"]} | worst | shares


def run_options(
    loop: Loop, conditions: Mapping[str, Any], duration: float
) -> dict[str, Any]:
    """Return the options of `drive_along_path` for the runs of some conditions.

    Args:
        loop: its law reads the state through the sensors.
        conditions: entries of `ROADS` and `EXCITATION`.
        duration: of a run [s].
    """
    options = {name: conditions[name] for name in (*ROADS, *EXCITATION)}
    return options | {
        "steps": round(duration / loop.plant.dt),
        "sensors": partial(_sensor_effect, loop),
        "offset": (0.0, 0.0, 0.0),
        "burn_in": 0,
    }


def run_measurement(
    loop: Loop, outputs: Mapping[str, OutputMetric]
) -> Callable[[Trajectory, Key], MeasuredRuns]:
    """Return (runs, key for the sensors) -> measurements.

    It is compiled once for all batches of one size.

    Args:
        loop: that was driven.
        outputs: proved metrics.
    """
    simulate = jax.jit(partial(_simulate_nominal, loop))

    def measure(runs: Trajectory, key: Key) -> MeasuredRuns:
        nominal, gaps = (
            np.asarray(part, dtype=np.float64) for part in simulate(runs, key)
        )
        initial = {
            name: np.linalg.norm(
                gaps @ np.linalg.cholesky(outputs[name].metric), axis=1
            )
            for name in OUTPUTS
        }
        errors = residuals(loop.model, loop.params, runs)
        scores = run_scores(errors, outputs, np.max(np.abs(nominal), axis=1), initial)
        lateral = np.asarray(runs.states, dtype=np.float64)[:, 1:, BODY][..., LATERAL]
        return MeasuredRuns(lateral, nominal, scores)

    return measure


def _simulate_nominal(
    loop: Loop, runs: Trajectory, key: Key
) -> tuple[Float[Array, "run time"], Float[Array, "run rank"]]:
    """Return ê_y of a nominal model that starts at the true state, and z_0 − ẑ_0.

    ẑ_0 is the latent state of a nominal model that starts at the measured state.
    """
    model, spread = loop.model, _spread(loop.noise, runs.states.shape[-1])

    def lateral(run: Trajectory) -> jax.Array:
        return rollout(model, loop.params, run)[0][:, BODY][:, LATERAL]

    def gap(state: State, env: Environment, key: Key) -> jax.Array:
        fiber = model.fiber(loop.params, env)
        measured = state + spread * jax.random.normal(key, state.shape)
        # The nominal model starts at what sensors show, the car at the truth.
        return model.vector(model.encode(fiber, measured)) - model.vector(
            model.encode(fiber, state)
        )

    keys = jax.random.split(key, len(runs.states))
    gaps = jax.vmap(gap)(runs.states[:, 0], runs.envs[:, 0], keys)
    return in_batches(lateral, runs, size=BATCH), gaps


def _sensor_effect(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> jax.Array:
    """Return the change of ν because the law reads ξ through the sensors."""
    coordinates, road = state[BODY], inputs[PERTURBATION.stop :]
    spread = _spread(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    # A law is a known function: reading ξ + n acts like a perturbation of ν.
    return loop.law(measured, road[0], road[1], env) - loop.law(
        coordinates, road[0], road[1], env
    )


def _spread(noise: tuple[float, ...], size: int) -> jax.Array:
    """Standard deviations of a path state from those of the sensors.

    e_y takes that of a position, e_ψ that of yaw, the other coordinates their own.
    """
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))


def corridor_by_speed(
    loop: Loop,
    certificate: Mapping[str, Any],
    *,
    frictions: Sequence[float],
    speeds: Sequence[float],
    runs: int = 60,
    seed: int = 0,
) -> dict[str, Any]:
    """Calibrate a corridor for every friction and speed.

    Roads, perturbations ν, sensors, duration, level and switching of the wind are those
    of the certified conditions. The curvature of a cell's roads is at most `curvature`,
    which decreases with speed where the conditions limit v² κ.

    Args:
        loop: of the policy, with the sensors of the conditions.
        certificate: verified, with a corridor.
        frictions: inside the certified box [-].
        speeds: v_ref, inside the certified box [m/s].
        runs: number of runs of each of three parts in every cell: one fixes the units,
            one calibrates, one tests.
        seed: of the runs.

    Returns:
        `cells`, in the order of frictions and then speeds, each with `corridor_m` =
        `nominal_m` + `tube_m`, its coverage and `lateral_m`, the largest |e_y| of its
        test runs; and the `coverage` of all cells.

    Raises:
        ValueError: a friction or a speed outside the box, or too few runs for the
            level.
        KeyError: a certificate without a corridor.
    """
    began = time.perf_counter()
    corridor = certificate["corridor"]
    about, level = corridor["conditions"], corridor["level"]
    low, high = (np.asarray(side) for side in about["env_box"])
    _require_inside("friction", frictions, (low[FRICTION], high[FRICTION]))
    _require_inside("speed", speeds, about["speed"])
    measure = run_measurement(loop, output_metrics_from(certificate["outputs"]))
    options = run_options(loop, about, about["duration_s"]) | {
        "drives": runs,
        "dwell": about["dwell_s"],
    }

    @jax.jit
    def simulate(key: Key, friction: Scalar, speed: Scalar) -> Trajectory:
        constant: dict[str, Any] = {
            # Equal corners in this entry alone: a cell
            # has one friction, and wind switches.
            side: jnp.asarray(corner).at[FRICTION].set(friction)
            for side, corner in (("env_low", low), ("env_high", high))
        }
        kwargs: dict[str, Any] = options | constant | {"speed": (speed, speed)}
        return drive_switching(loop.plant, key, **kwargs)

    cells = []
    for friction in frictions:
        for speed in speeds:
            keys = jax.random.split(
                # By number of the cell: its runs stay when further cells are asked for.
                jax.random.fold_in(jax.random.key(seed), len(cells)),
                (PARTS, 2),
            )
            parts = [
                measure(simulate(run_key, friction, speed), key)
                for run_key, key in keys
            ]
            units, scores, test = (part.scores for part in parts)
            bounds = calibrate_corridor(units, scores, level=level)
            tube = bounds["vehicle_to_nominal_position"]
            cell = {
                "friction": friction,
                "speed": speed,
                "curvature": min(
                    about["peak_curvature"], about["lateral_acceleration"] / speed**2
                ),
                "corridor_m": bounds["nominal"] + tube,
                "nominal_m": bounds["nominal"],
                "tube_m": tube,
                "lateral_m": float(np.max(np.abs(parts[-1].lateral))),
            }
            cells.append(cell | corridor_coverage(bounds, test))
    share = float(np.mean([cell["coverage"] for cell in cells]))
    return {
        "level": level,
        "runs": runs,
        "duration_s": about["duration_s"],
        "cells": cells,
        "coverage": share,
        "coverage_ci95": coverage_interval(share, runs * len(cells)),
        "seconds": time.perf_counter() - began,
    }


def fastest_speeds(
    cells: Sequence[Mapping[str, Any]], clearance: float
) -> dict[float, float | None]:
    """Return the largest speed by friction up to which all corridors fit into a lane.

    Args:
        cells: of `corridor_by_speed`.
        clearance: between the car and either edge of the lane [m].

    Returns:
        Speeds of the cells, not interpolated [m/s]; None if not even the lowest fits.
    """
    speeds: dict[float, float | None] = {}
    exceeded = set()
    for cell in sorted(cells, key=lambda cell: (cell["friction"], cell["speed"])):
        friction = cell["friction"]
        speeds.setdefault(friction, None)
        # A wider corridor at a lower speed counts, even if a faster one fits by chance
        if not cell["corridor_m"] <= clearance:
            exceeded.add(friction)
        elif friction not in exceeded:
            speeds[friction] = cell["speed"]
    return speeds


def _require_inside(name: str, values: Sequence[float], box: Sequence[float]) -> None:
    """Refuse values outside the certified box."""
    if outside := [value for value in values if not box[0] <= value <= box[1]]:
        raise ValueError(
            f"{name} {outside[0]:g} is outside the certified range, "
            f"{box[0]:g} to {box[1]:g}"
        )
