"""Controllers in lanes from a certified policy."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from sfkd_jax.assembly._controller_settings import PLANNERS
from sfkd_jax.assembly._corridor import conditions_of, corridor_of
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    HEADING,
    PATH_SPEED,
    REFERENCE_SPEED,
)
from sfkd_jax.driving.sizes import scale_of
from sfkd_jax.types import Controller

REFERENCE_SEARCH = {"horizon": 1, "noise": "white"}
"""Settings of every planner that searches for a reference in a lane."""
REFERENCE_NOISE = (1.5, 10.0, 1.5, 10.0, 1.0)
"""Deviations of its samples, see `Manoeuvres`; of a car [m, m, m, m, m/s]."""
REFERENCE_PLANNERS: dict[str, Any] = {
    "mppi": {"num_samples": 300, "effective_samples": 5.0},
    "cem": {"num_samples": 100, "iterations": 3, "elites": 10},
}
"""Further settings of such a planner, by its name."""


def build_in_lane(
    inner: Controller,
    plant: plants.Vehicle,
    law: path_following.PathLaw,
    certificate: DrivingCertificate,
    *,
    horizon: int,
    car: tuple[float, float],
    planner: str,
    friction: int | None,
    reverse: bool = False,
    candidates: int = 0,
) -> Controller:
    """Return a controller that drives in a lane, see `path_following.InLane`.

    Args:
        inner: the shielded controller of references.
        plant: vehicle.
        law: around which the model was learned.
        certificate: with a corridor, whose class the references keep.
        horizon: how many steps of the reference `inner` reads.
        car: length and width [m].
        planner: that searches for a reference, in `PLANNERS`.
        friction: entry of e that is the friction; None if none is.
        reverse: whether the vehicle reverses where u_2 is below 0 at rest.
        candidates: see `path_following.InLane`.
    """
    admissible = _admissible_references(plant, law, certificate, car)
    manoeuvres = path_following.Manoeuvres.scaled(admissible, plant.dt)
    length, speed = admissible.scale
    units = (length, length, length, length, speed)
    options = {
        "noise_std": tuple(map(operator.mul, REFERENCE_NOISE, units)),
        **REFERENCE_SEARCH,
        **REFERENCE_PLANNERS.get(planner, {}),
    }
    # Twice the way of a gentle stop, at least.
    stop = 0.5 * admissible.speed[1] ** 2 / admissible.deceleration
    grip: dict[str, Any] = {}
    if friction is not None:
        grip["lowest"] = certificate.measured.boxes.env[0][friction]
    speed_gain = float(np.mean(law.gain[..., 1, PATH_SPEED]))
    lane = path_following.InLane(
        inner=inner,
        planner=PLANNERS[planner](manoeuvres.task(), **options),
        manoeuvres=manoeuvres,
        horizon=horizon,
        view=max(length * path_following.InLane.view, 2.0 * stop),
        spacing=length * path_following.InLane.spacing,
        lead=0.0 if plant.speed_loop else 1.0 / speed_gain,
        friction=friction,
        candidates=candidates,
        **grip,
    )
    if not reverse:
        return lane.controller()
    reversing = path_following.Reversing(
        lane=lane,
        wheelbase=plant.wheelbase,
        low=plant.control_low,
        high=plant.control_high,
        speed_loop=plant.speed_loop,
    )
    return reversing.controller()


def _admissible_references(
    plant: plants.Vehicle,
    law: path_following.PathLaw,
    certificate: DrivingCertificate,
    car: tuple[float, float],
) -> path_following.Class:
    """Return the class of references of which a corridor was certified."""
    corridor = corridor_of(certificate)
    conditions = corridor.conditions
    road_low, road_high = certificate.measured.boxes.control
    state_box = conditions_of(certificate).state
    heading = 0.0
    if state_box is not None:
        heading = max(abs(end[HEADING]) for end in state_box)
    return path_following.Class(
        curvature=min(conditions.peak_curvature, road_high[CURVATURE]),
        turning=conditions.curvature_slope,
        lateral=min(conditions.lateral_acceleration, float(law.high[0])),
        jerk=conditions.lateral_jerk,
        speed=(road_low[REFERENCE_SPEED], road_high[REFERENCE_SPEED]),
        half=(0.5 * car[0], 0.5 * car[1]),
        corridor=corridor.corridor_m,
        heading=heading,
        change=conditions.acceleration,
        acceleration=0.5 * conditions.acceleration,
        # The rest is left for what the speed lags behind.
        deceleration=0.75 * conditions.acceleration,
        braking=6.0 if plant.speed_loop else -plant.control_low[1],
        scale=scale_of(plant.wheelbase, float(law.high[1])),
    )
