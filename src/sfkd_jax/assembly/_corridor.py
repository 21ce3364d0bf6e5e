"""What a certificate says about a controller: its corridor, and where it applies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.certificate import (
    Corridor,
    DrivingCertificate,
    LateCorridor,
)
from sfkd_jax.driving.path_coordinates import HEADING, LATERAL
from sfkd_jax.latency import NO_LATENCY, Latency
from sfkd_jax.types import Controller, Model

ROAD_MARGIN = 0.05
"""Relative enlargement of the box of κ and v_ref, since the curvature of a reference is
computed from its points.
"""
STATE_MARGIN = 0.25
"""Relative enlargement of the box of ξ: the runs on which a corridor is calibrated
leave the box of the data as well.
"""
ALLOWANCE = 3.0
"""Standard deviations of a measured position by which the tube is enlarged."""
Corner = Sequence[float] | None
"""Lower or upper ends of the environment box E, if they are known."""


def corridor_of(certificate: DrivingCertificate) -> Corridor:
    """Return the corridor of a certificate, with the bounds that are in force.

    Raises:
        ValueError: it has none.
    """
    if certificate.corridor is None:
        raise ValueError("the certificate has no corridor")
    return certificate.corridor.in_force()


def in_corridor(
    planner: Controller,
    model: Model,
    plant: plants.Vehicle,
    law: path_following.PathLaw,
    certificate: DrivingCertificate,
    *,
    latency: Latency = NO_LATENCY,
) -> Controller:
    """Return the planner with a shield that keeps the corridor of a certificate.

    Args:
        planner: any controller along a path, see `path_following.along_reference`.
        model: in path coordinates.
        plant: vehicle, whose limits the controls keep.
        law: around which the model was learned.
        certificate: with a corridor.
        latency: of the vehicle. Nothing is claimed if the certificate has no corridor
            for it.
    """
    corridor = corridor_of(certificate)
    bounds = corridor.bounds
    lateral_noise, heading_noise = _sensor_noise(corridor)
    # Until the command acts, an error of the heading moves the car sideways.
    way = corridor.conditions.speed[1] * plant.dt * latency.loop(plant.dt).first
    lateral_noise = math.hypot(lateral_noise, way * heading_noise)
    tubes = _tubes(corridor, plant, latency)
    # What the heading's noise moves the car sideways until the law has turned it back.
    steering = np.asarray(law.gain)[..., 0, :]
    ratio = float(np.max(steering[..., HEADING] / steering[..., LATERAL]))
    return path_following.Shield(
        inner=planner,
        model=model,
        law=law,
        width=bounds.nominal,
        tube=_tube_as_stated(tubes) or bounds.vehicle_to_nominal_position,
        late=tubes,
        horizon=corridor.shield_horizon,
        noise_allowance=ALLOWANCE * lateral_noise,
        start_error=ALLOWANCE * (lateral_noise + ratio * heading_noise),
        decay=certificate.proof.alpha,
        control=(plant.control_low, plant.control_high),
        conditions=conditions_of(certificate),
        dt=plant.dt,
        rear=_slip_of_gentle_turns(law),
        claimed=corridor.is_claimed and bool(tubes),
    ).controller()


def _tubes(
    corridor: Corridor, plant: plants.Vehicle, latency: Latency
) -> tuple[tuple[float, float], ...]:
    """Return the tubes of a corridor by how much later a vehicle is than stated.

    Args:
        corridor: in force.
        plant: vehicle.
        latency: that is stated.

    Returns:
        Pairs of periods and tube [m], rising. A tube holds for vehicles that are later
        by up to so many periods, of whatever, and no less late than the first pair. It
        is empty if the corridor is of another latency.
    """
    sizes = (len(plant.states), len(plant.controls))
    stated = latency.sized(*sizes)
    calibrated = corridor.conditions.latency.sized(*sizes)
    gaps = [
        mine - theirs
        for mine, theirs in zip(
            stated.loop(plant.dt).periods,
            calibrated.loop(plant.dt).periods,
            strict=True,
        )
    ]
    # A corridor says nothing about vehicles that are less late.
    if min(gaps) < 0.0:
        return ()
    longest = max(gaps)
    known = _late_tubes(corridor, corridor.late_controls, plant.dt)
    if stated.controls == calibrated.controls:
        # Nothing but the sensors is later, so e is known in time.
        tubes = _late_tubes(corridor, corridor.late_sensors, plant.dt)
        enough = [tube for periods, tube in tubes.items() if periods >= longest]
        if enough:
            known[longest] = enough[0]
    if max(known) < longest:
        return ()
    pairs = sorted(known.items())
    return tuple((periods - longest, tube) for periods, tube in pairs)


def _tube_as_stated(tubes: tuple[tuple[float, float], ...]) -> float | None:
    """Return the tube of a vehicle that is as late as stated [m], if it is known."""
    return next((tube for periods, tube in tubes if periods >= 0.0), None)


def _late_tubes(
    corridor: Corridor, rows: Sequence[LateCorridor], dt: float
) -> dict[float, float]:
    """Return the tubes of vehicles [m] by how many periods they are later, rising.

    The shield keeps the nominal corridor of the conditions, whatever is late.

    Args:
        corridor: of vehicles on time.
        rows: of vehicles that are later.
        dt: sampling period [s].
    """
    tube = corridor.bounds.vehicle_to_nominal_position
    tubes = {0.0: tube}
    for row in rows:
        # By chance the runs of a later vehicle may have stayed nearer.
        tube = max(tube, row.corridor_m - corridor.bounds.nominal)
        tubes[round(row.later_s / dt, 9)] = tube
    return tubes


def measurement_tests(
    corridor: Corridor,
    plant: plants.Vehicle,
    *,
    estimates_env: bool,
    later: tuple[float, ...] = (0.0,),
) -> path_following.MeasurementTests:
    """Return the tests of a vehicle and its sensors, as a corridor calibrated them.

    Args:
        corridor: of the policy.
        plant: vehicle.
        estimates_env: whether e is estimated while driving. The innovations are then
            not those of the calibration, and are not tested.
        later: delays of which one is estimated, see `CommandDelay.hypotheses`.
    """
    names = plant.state_names
    noise = (*corridor.conditions.sensor_noise, *(0.0 for _ in names))[: len(names)]
    odometry = None
    # Positions whose noise nobody has stated cannot be tested.
    if any(noise[:2]):
        odometry = path_following.OdometryTest(
            deviations=noise,
            dt=plant.dt,
            sideways=names.index("v_y") if "v_y" in names else None,
        )
    if estimates_env:
        return path_following.MeasurementTests(odometry=odometry)
    calibrated = corridor.innovations
    innovation = path_following.innovation_test(
        calibrated.levels, calibrated.deviation, calibrated.threshold
    )
    delay = None
    if len(later) > 1:
        delay = path_following.delay_estimator(
            calibrated.levels, calibrated.deviation, later
        )
    return path_following.MeasurementTests(innovation, odometry, delay)


def _slip_of_gentle_turns(law: path_following.PathLaw) -> float:
    """Return the slip of a turn that the tyres hardly feel, per curvature [m].

    At one lateral acceleration ψ* differs between two speeds by this times κ alone.
    """
    last = law.state.shape[0] - 1
    # The gentlest turn of the table that is one.
    row = min(last // 2 + 1, last)
    heading = np.asarray(law.state)[row, ..., HEADING]
    slow = np.asarray(law.low, float)[1]
    side, fast, *_ = np.asarray(law.high, float)
    sideways = side * (2.0 * row / last - 1.0)
    curvatures = sideways / slow**2 - sideways / fast**2
    return max(float(np.median(heading[-1] - heading[0]) / curvatures), 0.0)


def _sensor_noise(corridor: Corridor) -> tuple[float, float]:
    """Return the standard deviations of the measured e_y [m] and e_ψ [rad]."""
    noise = (*corridor.conditions.sensor_noise, 0.0, 0.0, 0.0)
    # The larger entry of a position: which one is lateral depends on the road.
    return max(noise[:2]), noise[2]


def conditions_of(
    certificate: DrivingCertificate | None,
    *,
    env_low: Corner = None,
    env_high: Corner = None,
) -> path_following.Conditions:
    """Return where the model predicts, as its certificate says.

    Without a certificate nothing is known of this but the box of e.
    """
    if certificate:
        return _certified_conditions(certificate)
    if env_low is None or env_high is None:
        return path_following.Conditions()
    return path_following.Conditions(env=_box(env_low, env_high))


def _certified_conditions(certificate: DrivingCertificate) -> path_following.Conditions:
    """Return the boxes of a certificate, somewhat enlarged.

    The box of e_y contains the corridor, since the claim holds there, whether or not
    the data reach that far. The other boxes are those of the data, somewhat enlarged:
    the runs on which a corridor is calibrated leave them as well.
    """
    boxes = certificate.measured.boxes
    low, high = (np.asarray(side, float) for side in boxes.state)
    margin = STATE_MARGIN * (high - low)
    margin[LATERAL] = 0.0
    low = low - margin
    high = high + margin
    edge = 0.0
    if certificate.corridor is not None:
        corridor = corridor_of(certificate)
        lateral_noise, _ = _sensor_noise(corridor)
        edge = corridor.corridor_m + ALLOWANCE * lateral_noise
    low[LATERAL] = min(low[LATERAL], -edge)
    high[LATERAL] = max(high[LATERAL], edge)
    # [2:] are κ and v_ref; ν has its limits in the law.
    road_low, road_high = np.asarray(boxes.control, float)[:, 2:]
    env_low, env_high = boxes.env
    return path_following.Conditions(
        env=_box(env_low, env_high),
        state=_box(low, high),
        road=_box(
            road_low - ROAD_MARGIN * np.abs(road_low),
            road_high + ROAD_MARGIN * np.abs(road_high),
        ),
    )


def _box(low: Any, high: Any) -> path_following.Box:
    """Return limits as plain numbers."""
    return tuple(map(float, low)), tuple(map(float, high))
