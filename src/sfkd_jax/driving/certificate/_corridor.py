"""The corridor of a certificate: measured on whole runs of the closed loop."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sfkd_jax.certificate import ADDED, Box, Coverage, Matrix
from sfkd_jax.latency import NO_LATENCY, Latency
from sfkd_jax.ranges import (
    AtLeastOne,
    Fraction,
    NonNegative,
    NonNegativeInt,
    Positive,
    Span,
)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What the runs had in common on which a corridor was measured.

    The class of the roads is that of `scenarios.DriveClass`.

    Attributes:
        speed: range of speeds [m/s].
        peak_curvature: largest curvature [1/m].
        wavelengths: range of the wavelengths of a road [m].
        lateral_acceleration: largest v² κ [m/s²].
        acceleration: largest change of speed [m/s²].
        lateral_jerk: largest v³ dκ/ds [m/s³].
        curvature_slope: largest dκ/ds [1/m²].
        steering_excitation: range of the spread of ν's steering [rad].
        speed_excitation: range of the spread of ν's acceleration [m/s²].
        env_box: of the environment, which switches in it.
        dwell_s: range of times between two switches [s].
        duration_s: length of a run [s].
        sensor_noise: standard deviations of the sensors, one per state.
        perturbation: largest |ν|.
        law_model: the model that the law was derived from.
        identified_from: hash of the logs if the runs are of a model of logs; None if
            they are of the vehicle.
        latency: of the sensors and the controls, which the law compensated.
    """

    speed: Span
    peak_curvature: NonNegative
    wavelengths: Span
    lateral_acceleration: NonNegative
    acceleration: NonNegative
    lateral_jerk: NonNegative
    curvature_slope: NonNegative
    steering_excitation: tuple[NonNegative, NonNegative]
    speed_excitation: tuple[NonNegative, NonNegative]
    env_box: Box
    dwell_s: Span
    duration_s: Positive
    sensor_noise: tuple[NonNegative, ...]
    perturbation: tuple[NonNegative, ...]
    law_model: str
    identified_from: str | None = None
    latency: Latency = field(default=NO_LATENCY, metadata=ADDED)


@dataclass(frozen=True, kw_only=True)
class JointBounds:
    """Bounds that hold together on a whole new run.

    Attributes:
        vehicle_to_nominal_position: tube, between vehicle and nominal model in e_y [m].
        vehicle_to_nominal_yaw: the same in e_ψ [rad].
        nominal: of |ê_y| of the nominal model [m].
    """

    vehicle_to_nominal_position: NonNegative
    vehicle_to_nominal_yaw: NonNegative
    nominal: NonNegative


@dataclass(frozen=True, kw_only=True)
class Bounds(JointBounds):
    """Joint bounds, and two from the largest disturbance of a run alone.

    Attributes:
        asymptotic_position: of the distance in e_y [m]; it holds by itself.
        asymptotic_yaw: of the distance in e_ψ [rad]; it holds by itself.
    """

    asymptotic_position: NonNegative
    asymptotic_yaw: NonNegative


@dataclass(frozen=True, kw_only=True)
class GroupBounds:
    """Bounds of one group of drives, and the coverage of the corridor's bounds."""

    bounds: Bounds
    coverage: Coverage


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The largest values on the test runs.

    Attributes:
        distance_m: of the vehicle from its nominal model in e_y [m].
        lateral_m: of the vehicle from the path [m].
    """

    distance_m: NonNegative
    lateral_m: NonNegative


@dataclass(frozen=True, kw_only=True)
class CorridorAttack:
    """What a search for the worst run reached.

    Attributes:
        steps: number of simulated steps.
        lateral_m: largest distance from the path [m].
        distance_m: largest distance from the nominal model [m].
        shielded_lateral_m: distance from the path on the same runs with the shield [m].
        kept_lateral_m: the same while the disturbances are within their bound [m].
        kept_distance_m: distance from the nominal model then [m].
        over_corridor: `kept_lateral_m` over the width of the corridor.
        over_tube: `kept_distance_m` over the tube.
    """

    steps: AtLeastOne
    lateral_m: NonNegative
    distance_m: NonNegative
    shielded_lateral_m: NonNegative
    kept_lateral_m: NonNegative
    kept_distance_m: NonNegative
    over_corridor: NonNegative
    over_tube: NonNegative


@dataclass(frozen=True, kw_only=True)
class Innovations:
    """Calibration of the test of innovations, see `path_following.InnovationTest`.

    Attributes:
        levels: of the law, ascending, (group,).
        deviation: standard deviations of every chart, (group, chart).
        threshold: of the moving means, (window, chart).
        calibration_runs: number of runs that it was calibrated on.
        runs: number of test runs.
        alarms: number of test runs with an alarm.
        alarms_s3: number of runs of S3 with one.
    """

    levels: tuple[NonNegative, ...]
    deviation: tuple[tuple[Positive, ...], ...]
    threshold: Matrix
    calibration_runs: AtLeastOne
    runs: AtLeastOne
    alarms: NonNegativeInt
    alarms_s3: NonNegativeInt


@dataclass(frozen=True, kw_only=True)
class RecordedConditions:
    """The runs of the car that a corridor was calibrated again on.

    Attributes:
        runs: their number.
        contents: hash of their files.
        duration_s: of each [s].
        lateral_m: largest distance from the path [m].
    """

    runs: AtLeastOne
    contents: str
    duration_s: Positive
    lateral_m: NonNegative


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The corridor of recorded runs of the car.

    Attributes:
        bounds: on these runs.
        corridor_m: half width [m].
        level: probability with which the bounds hold together.
        conditions: of the runs.
    """

    bounds: JointBounds
    corridor_m: NonNegative
    level: Fraction
    conditions: RecordedConditions


@dataclass(frozen=True, kw_only=True)
class LawMargins:
    """What the law tolerates at some speeds; the least over turns and environments.

    Measured on linearisations of the plant at a grid of steady turns.

    Attributes:
        speed: v_ref [m/s], ascending.
        delay_s: by which commands may act later than assumed [s].
        gain_low: smallest factor of the gains.
        gain_high: largest factor of the gains.
        noise_lateral_m: standard deviation of e_y that the sensors cause [m].
        noise_steering: that of the steering [rad].
    """

    speed: tuple[NonNegative, ...]
    delay_s: tuple[NonNegative, ...]
    gain_low: tuple[NonNegative, ...]
    gain_high: tuple[NonNegative, ...]
    noise_lateral_m: tuple[NonNegative, ...]
    noise_steering: tuple[NonNegative, ...]


@dataclass(frozen=True, kw_only=True)
class LateCorridor:
    """The corridor of a vehicle that is later than the conditions say.

    The controller compensates its latency. No attack is made on this corridor.

    Attributes:
        later_s: delay in addition to the latency of the conditions [s].
        bounds: of the worst group.
        coverage: of the worst group.
    """

    later_s: Positive
    bounds: JointBounds
    coverage: Coverage

    @property
    def corridor_m(self) -> float:
        """Half width [m], the nominal bound and the tube."""
        return self.bounds.nominal + self.bounds.vehicle_to_nominal_position


@dataclass(frozen=True, kw_only=True)
class Corridor:
    """How far the vehicle stays from its path, whatever a planner behind a shield does.

    Attributes:
        conditions: of the runs.
        level: probability with which the joint bounds hold on a whole new run.
        runs: number of runs of every group that calibrate, and as many that test.
        bounds: of the worst group.
        corridor_m: half width [m], the nominal bound and the tube.
        coverage: of the worst group.
        by_group: bounds and coverage of every group of drives.
        by_scenario: coverage on runs that do not meet the conditions, by name.
        seen: on the test runs.
        attack: on the corridor.
        innovations: of the test of innovations.
        failed_runs: number of runs in which a simulator failed.
        shield_horizon: preview of the shield [steps].
        seconds: that the measurements took [s].
        recorded: corridor of recorded runs of the car, or None.
        margins: of the law; None where it does not stabilise a turn of its class, and
            in certificates from before they were measured.
        late_sensors: of vehicles whose sensors are all later, by rising delays.
        late_controls: of vehicles whose controls are all later. They know e before
            their commands act as well.
    """

    conditions: Conditions
    level: Fraction
    runs: AtLeastOne
    bounds: Bounds
    corridor_m: NonNegative
    coverage: Coverage
    by_group: dict[str, GroupBounds]
    by_scenario: dict[str, Coverage]
    seen: Seen
    attack: CorridorAttack
    innovations: Innovations
    failed_runs: NonNegativeInt = 0
    shield_horizon: AtLeastOne
    seconds: NonNegative
    recorded: Recorded | None = None
    margins: LawMargins | None = field(default=None, metadata=ADDED)
    late_sensors: tuple[LateCorridor, ...] = field(default=(), metadata=ADDED)
    late_controls: tuple[LateCorridor, ...] = field(default=(), metadata=ADDED)

    @property
    def is_claimed(self) -> bool:
        """Whether it was measured on the vehicle, and not only on a model of logs."""
        return self.conditions.identified_from is None or self.recorded is not None

    def in_force(self) -> Corridor:
        """Return the corridor with the bounds that hold for the vehicle.

        These are the bounds of recorded runs, if there are any. No run of that vehicle
        was later.
        """
        if self.recorded is None:
            return self
        recorded = self.recorded
        return replace(
            self,
            bounds=replace(self.bounds, **vars(recorded.bounds)),
            corridor_m=recorded.corridor_m,
            level=recorded.level,
            late_sensors=(),
            late_controls=(),
        )
