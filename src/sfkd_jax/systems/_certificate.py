"""The certificate of a system, with the tubes of its closed loop."""

from __future__ import annotations

from dataclasses import dataclass

from sfkd_jax.certificate import Box, Certificate, Coverage
from sfkd_jax.ranges import AtLeastOne, Fraction, NonNegative, Positive, Span


@dataclass(frozen=True, kw_only=True)
class LoopConditions:
    """What the runs had in common on which tubes were measured.

    Attributes:
        input_box: of ρ.
        reference_dwell_s: range of times between two changes of the reference [s].
        env_box: of e.
        env_dwell_s: range of times between two switches of e [s].
        duration_s: length of a run [s].
        sensor_noise: standard deviations of the sensors, one for each state.
        perturbation: largest |ν|.
    """

    input_box: Box
    reference_dwell_s: Span
    env_box: Box
    env_dwell_s: Span
    duration_s: Positive
    sensor_noise: tuple[NonNegative, ...]
    perturbation: tuple[NonNegative, ...]


@dataclass(frozen=True, kw_only=True)
class OutputBounds:
    """Bounds of one output, in its unit.

    Attributes:
        tube: of |y − ŷ|, between system and nominal model.
        nominal: of |ŷ|, which a shield keeps.
        total: of |y|, the sum of both.
        system: quantile of the largest |y| of a run at the level, with the law and ν.
    """

    tube: NonNegative
    nominal: NonNegative
    total: NonNegative
    system: NonNegative


@dataclass(frozen=True, kw_only=True)
class LoopTubes:
    """Bounds of all outputs that hold together on a whole new run.

    Attributes:
        conditions: of the runs.
        level: probability with which the bounds hold.
        runs: number of runs that calibrated them.
        outputs: bounds by output.
        coverage: on as many fresh runs.
        seconds: that the measurement took [s].
    """

    conditions: LoopConditions
    level: Fraction
    runs: AtLeastOne
    outputs: dict[str, OutputBounds]
    coverage: Coverage
    seconds: NonNegative


@dataclass(frozen=True, kw_only=True)
class SystemCertificate(Certificate):
    """A certificate of a system that follows references.

    Attributes:
        tubes: what is measured in the closed loop.
    """

    tubes: LoopTubes
