"""What a certificate measures: bounds of one-step errors, and the tubes from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from sfkd_jax.certificate._proof import Box, Row
from sfkd_jax.ranges import AtLeastOne, Fraction, NonNegative, UnitInterval


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """The share of held-out trajectories on which all bounds held.

    Attributes:
        share: of the trajectories.
        ci95: its exact 95 % interval, which counts runs.
        trajectories: number of trajectories.
        runs: number of independent runs that they were cut from.
    """

    share: UnitInterval
    ci95: tuple[UnitInterval, UnitInterval]
    trajectories: AtLeastOne
    runs: AtLeastOne


@dataclass(frozen=True, kw_only=True)
class AxisNames:
    """Names of the axes of the boxes, from the columns of logs."""

    state: tuple[str, ...]
    control: tuple[str, ...]
    env: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Domain of the measurements; nothing measured is claimed outside.

    Attributes:
        state: of the body state.
        control: of the control, with the inputs from the reference.
        env: E.
        names: of the axes of logged data; None where the plant names them.
    """

    state: Box
    control: Box
    env: Box
    names: AxisNames | None = None


StepErrors: TypeAlias = dict[str, NonNegative]
"""Bounds on the errors of single steps: "latent" for d̄, in the latent space, and one
for each output of the frame of the model, by its name and in its unit.
"""


@dataclass(frozen=True, kw_only=True)
class StepBounds:
    """Split-conformal bounds on single steps, which hold on a whole new trajectory.

    Attributes:
        one_step: the bounds.
        level: probability with which they hold together.
        trajectories: number of trajectories that calibrated them.
        runs: number of independent runs that these were cut from.
        holds_for: what the bounds are about.
        coverage: on the test part.
        by_scenario: coverage on other parts, by name.
        validation: quantile of the latent error on the validation part.
    """

    one_step: StepErrors
    level: Fraction
    trajectories: AtLeastOne
    runs: AtLeastOne
    holds_for: str
    coverage: Coverage
    by_scenario: dict[str, Coverage]
    validation: NonNegative


@dataclass(frozen=True, kw_only=True)
class Tube:
    """Radii around predictions from the true state; they follow from α, L and d̄.

    Attributes:
        latent: R_1 … R_T.
        physical: radii of the outputs, by their names with their units, such as
            "position_m".
        ultimate: d̄ / (1 − α), the limit of R_k.
        asymptotic: limits of the physical radii; None for increments, which add up.
        largest_increment_m: longest step [m]; None without a pose.
    """

    latent: Row
    physical: dict[str, Row]
    ultimate: NonNegative
    asymptotic: dict[str, NonNegative] | None
    largest_increment_m: NonNegative | None


@dataclass(frozen=True, kw_only=True)
class OutputBound:
    """A bound of |y_k − ŷ_k| over a whole new run.

    Attributes:
        radius: the bound, in the unit of the output.
        coverage: on the test part.
    """

    radius: NonNegative
    coverage: Coverage


@dataclass(frozen=True, kw_only=True)
class OutputTube:
    """Two bounds of one output, by what they are computed from.

    Attributes:
        asymptotic: from the largest disturbance of a run alone.
        vehicle_to_nominal: from the sequence of all disturbances of a run.
    """

    asymptotic: OutputBound
    vehicle_to_nominal: OutputBound


@dataclass(frozen=True, kw_only=True)
class Measured:
    """All that is measured on data, under the conditions of the data alone.

    Attributes:
        boxes: of the data.
        d_bar: bounds on single steps.
        tube: around predictions.
        outputs: tubes of the outputs that have a metric in the proof, by name.
    """

    boxes: Boxes
    d_bar: StepBounds
    tube: Tube
    outputs: dict[str, OutputTube]
