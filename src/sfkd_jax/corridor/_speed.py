"""How the corridor of a policy depends on speed and friction, and how fast it may go where there is little room."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import policy
from sfkd_jax.certification import calibrate, claims_of, covered, interval
from sfkd_jax.corridor._drives import closed, driving, measuring
from sfkd_jax.datasets import drive_switching
from sfkd_jax.types import Key, Scalar, Trajectory

FRICTION = 0
"""Of the entries of e, the one that is held in a cell; the others switch within their
range.
"""
PARTS = 3
"""Drives fix units, calibrate and test."""


def corridor_by_speed(
    trained: policy.TrainedModel,
    certificate: Mapping[str, Any],
    *,
    frictions: Sequence[float],
    speeds: Sequence[float],
    drives: int = 60,
    seed: int = 0,
) -> dict[str, Any]:
    """A corridor for every friction and speed, each calibrated by itself, on the drives of the class that have both.

    Roads, perturbations ν, sensors, duration and level are those of the certified
    class; wind switches as in it. The road of a cell bends by at most `curvature`,
    which the class lets fall with speed once v² κ reaches its limit.

    Args:
        trained: with a law.
        certificate: verified, with a corridor.
        frictions: [-].
        speeds: asked for [m/s]. Both inside the certified box; nothing is extrapolated.
        drives: of each of three parts in every cell: one fixes the units, one
            calibrates, one tests.

    Returns:
        `cells`, in the order of frictions and then speeds: `corridor_m` = `nominal_m` +
        `tube_m`, each with its coverage, and the largest |e_y| of its test drives,
        `lateral_m`; beside them the coverage of all cells together.

    Raises:
        ValueError: a friction or a speed outside the box, too few drives for the level,
            or a policy without a law.
        KeyError: a certificate without a corridor.
    """
    began = time.perf_counter()
    known = certificate["corridor"]
    about, level = known["class"], known["level"]
    low, high = (np.asarray(side) for side in about["env_box"])
    _require_inside("friction", frictions, (low[FRICTION], high[FRICTION]))
    _require_inside("speed", speeds, about["speed"])
    loop = closed(trained.vehicle, trained, about["sensor_noise"])
    measure = measuring(loop, claims_of(certificate["outputs"]))
    options = driving(loop, about, about["duration_s"]) | {
        "drives": drives,
        "dwell": about["dwell_s"],
    }

    @jax.jit
    def drive(key: Key, friction: Scalar, speed: Scalar) -> Trajectory:
        held: dict[str, Any] = {
            side: jnp.asarray(corner).at[FRICTION].set(friction)
            for side, corner in (("env_low", low), ("env_high", high))
        }
        asked: dict[str, Any] = options | held | {"speed": (speed, speed)}
        return drive_switching(loop.plant, key, **asked)

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
            units, scores, fresh = (part.scores for part in parts)
            bounds = calibrate(units, scores, level=level)
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
            cells.append(cell | covered(bounds, fresh))
    share = float(np.mean([cell["coverage"] for cell in cells]))
    return {
        "level": level,
        "drives": drives,
        "duration_s": about["duration_s"],
        "cells": cells,
        "coverage": share,
        "coverage_ci95": interval(share, drives * len(cells)),
        "seconds": time.perf_counter() - began,
    }


def fastest(
    cells: Sequence[Mapping[str, Any]], room: float
) -> dict[float, float | None]:
    """The largest speed by friction at which the corridor, and that of every lower speed, fits into a lane.

    Args:
        cells: of `corridor_by_speed`.
        room: what the lane leaves on either side of the car [m].

    Returns:
        Speeds [m/s] out of the cells; None where not even the lowest fits. Nothing is
        interpolated.
    """
    found: dict[float, float | None] = {}
    closed_off = set()
    for cell in sorted(cells, key=lambda cell: (cell["friction"], cell["speed"])):
        friction = cell["friction"]
        found.setdefault(friction, None)
        if not cell["corridor_m"] <= room:
            closed_off.add(friction)
        elif friction not in closed_off:
            found[friction] = cell["speed"]
    return found


def _require_inside(name: str, values: Sequence[float], box: Sequence[float]) -> None:
    """Refuse what lies outside the box that was certified."""
    if outside := [value for value in values if not box[0] <= value <= box[1]]:
        raise ValueError(
            f"{name} {outside[0]:g} lies outside what is certified, {box[0]:g} to {box[1]:g}"
        )
