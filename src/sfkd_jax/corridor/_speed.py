"""The corridor of a policy by speed and friction."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import policy
from sfkd_jax.certification import (
    calibrate_corridor,
    corridor_coverage,
    coverage_interval,
    output_metrics_from,
)
from sfkd_jax.corridor._drives import drive_measurement, drive_options, policy_loop
from sfkd_jax.data import drive_switching
from sfkd_jax.types import Key, Scalar, Trajectory

FRICTION = 0
"""Entry of e that is constant in a cell; the other entries switch in their range."""
PARTS = 3
"""Drives that fix the units, that calibrate and that test."""


def corridor_by_speed(
    trained: policy.TrainedModel,
    certificate: Mapping[str, Any],
    *,
    frictions: Sequence[float],
    speeds: Sequence[float],
    drives: int = 60,
    seed: int = 0,
) -> dict[str, Any]:
    """Calibrate a corridor for every friction and speed.

    Roads, perturbations ν, sensors, duration, level and switching of the wind are those
    of the certified class. The curvature of a cell's roads is at most `curvature`,
    which decreases with speed where the class limits v² κ.

    Args:
        trained: with a law.
        certificate: verified, with a corridor.
        frictions: inside the certified box [-].
        speeds: v_ref, inside the certified box [m/s].
        drives: number of drives of each of three parts in every cell: one fixes the
            units, one calibrates, one tests.
        seed: of the drives.

    Returns:
        `cells`, in the order of frictions and then speeds, each with `corridor_m` =
        `nominal_m` + `tube_m`, its coverage and `lateral_m`, the largest |e_y| of its
        test drives; and the `coverage` of all cells.

    Raises:
        ValueError: a friction or a speed outside the box, too few drives for the level,
            or a policy without a law.
        KeyError: a certificate without a corridor.
    """
    began = time.perf_counter()
    corridor = certificate["corridor"]
    about, level = corridor["class"], corridor["level"]
    low, high = (np.asarray(side) for side in about["env_box"])
    _require_inside("friction", frictions, (low[FRICTION], high[FRICTION]))
    _require_inside("speed", speeds, about["speed"])
    loop = policy_loop(trained.vehicle, trained, about["sensor_noise"])
    measure = drive_measurement(loop, output_metrics_from(certificate["outputs"]))
    options = drive_options(loop, about, about["duration_s"]) | {
        "drives": drives,
        "dwell": about["dwell_s"],
    }

    @jax.jit
    def drive(key: Key, friction: Scalar, speed: Scalar) -> Trajectory:
        constant: dict[str, Any] = {
            side: jnp.asarray(corner).at[FRICTION].set(friction)
            for side, corner in (("env_low", low), ("env_high", high))
        }
        kwargs: dict[str, Any] = options | constant | {"speed": (speed, speed)}
        return drive_switching(loop.plant, key, **kwargs)

    cells = []
    for friction in frictions:
        for speed in speeds:
            keys = jax.random.split(
                jax.random.fold_in(jax.random.key(seed), len(cells)), (PARTS, 2)
            )
            parts = [
                measure(drive(drive_key, friction, speed), key)
                for drive_key, key in keys
            ]
            units, scores, test = (part.scores for part in parts)
            bounds = calibrate_corridor(units, scores, level=level)
            cell = {
                "friction": friction,
                "speed": speed,
                "curvature": min(
                    about["peak_curvature"], about["lateral_acceleration"] / speed**2
                ),
                "corridor_m": bounds["nominal"] + bounds["followed_position"],
                "nominal_m": bounds["nominal"],
                "tube_m": bounds["followed_position"],
                "lateral_m": float(np.max(np.abs(parts[-1].lateral))),
            }
            cells.append(cell | corridor_coverage(bounds, test))
    share = float(np.mean([cell["coverage"] for cell in cells]))
    return {
        "level": level,
        "drives": drives,
        "duration_s": about["duration_s"],
        "cells": cells,
        "coverage": share,
        "coverage_ci95": coverage_interval(share, drives * len(cells)),
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
