"""Settings of `certify_system`."""

from __future__ import annotations

from dataclasses import dataclass

from sfkd_jax.ranges import AtLeastOne, AtLeastTwo, Fraction, Positive, Span


@dataclass(frozen=True, kw_only=True)
class TubeSettings:
    """How a system is certified.

    Attributes:
        rate: contraction rate of the law; None for the fastest that hardly saturates.
        points: of the table of the law, on every axis.
        perturbation: largest |ν|, relative to half of the range of each control.
        dwell: range of times between two switches of e [s].
        segments: number of segments of the data, relative to the full size.
        steps: optimiser steps of the training, a multiple of 50.
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
