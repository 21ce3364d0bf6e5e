"""Settings of `certify_system`."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from sfkd_jax.ranges import AtLeastOne, AtLeastTwo, Fraction, Positive, Span

LOGGED = 50
"""Steps of the training between two lines of its log."""


@dataclass(frozen=True, kw_only=True)
class TubeSettings:
    """How a system is certified.

    Attributes:
        rate: contraction rate of the law; None for that of the law
            whose simulated runs have the smallest errors.
        points: of the table of the law, on every axis.
        perturbation: largest |ν|, relative to half of the range of each control.
        dwell: range of times between two switches of e [s].
        segments: number of segments of the data, relative to the full size.
        steps: optimiser steps of the training, a multiple of `LOGGED`.
        runs: number of runs of each part that calibrates or tests the tubes.
        duration: of these runs [s].
        level: 1 − δ.
        samples: of the planner.
        horizon: of the planner [steps].
    """

    rate: Fraction | None = None
    points: AtLeastTwo = 5
    perturbation: Fraction = 0.05
    dwell: Span = (1.0, 4.0)
    segments: Positive = 1.0
    steps: AtLeastOne = 6000
    runs: AtLeastOne = 300
    duration: Positive = 30.0
    level: Fraction = 0.95
    samples: AtLeastOne = 300
    horizon: AtLeastOne = 20


def check_settings(settings: TubeSettings, dt: float) -> None:
    """Raise a ValueError for settings with which nothing could be certified."""
    if settings.steps % LOGGED:
        raise ValueError(f"steps must be a multiple of {LOGGED}, got {settings.steps}")
    if settings.duration < dt:
        raise ValueError(
            f"duration must be a sampling period of {dt:g} s at least, "
            f"got {settings.duration:g}"
        )
    needed = ceil(settings.level / (1.0 - settings.level))
    if settings.runs < needed:
        raise ValueError(
            f"runs must be {needed} at least for a level of {settings.level:g}, "
            f"got {settings.runs}"
        )
