"""Tracking: coordinates relative to a reference that moves, for any system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from sfkd_jax.systems._system import Ends, check_ends


@dataclass(frozen=True, eq=False)
class Tracking:
    """Coordinates relative to a reference, ξ = x − x_ref, for any system.

    The reference consists of chains: ("x", "vx") says that vx is the rate of x, and its
    range is that of the rate of vx, which is constant over a sampling period. States in
    no chain, such as the roll of a quadrotor, stay as they are in ξ. A chain of one
    state is a set point that moves at a limited rate.

    A body that moves where it points, such as a robot on wheels, has a course: the two
    entries of its position, its direction, and its velocity along it. Then the position
    of the reference moves with its velocity in its direction, and the entries of
    the position in ξ are along the reference and to its left:

        ṗ_ref = v_ref (cos ψ_ref, sin ψ_ref),   ξ_p = R(ψ_ref)' (p - p_ref)

    Attributes:
        outputs: name -> states; of each output a tube is certified.
        reference: chain of one or two states -> range of the rate of the last of them.
        ranges: state in a chain -> range of the reference. A state needs one if the
            system behaves differently elsewhere: the velocity of a body with drag, or
            the angle of a pendulum. The law and the model then depend on it.
        dwell: shortest and longest time between two changes of the reference [s].
        held: states whose ξ is 0 where the system follows its reference, as many as
            there are controls; () for the first state of every chain, and for the
            position in place of direction and velocity where there is a course.
        course: two states of a position, direction and velocity; the last two are in
            chains. () if no body moves where it points.

    Raises:
        ValueError: a chain, a range or an output does not fit; gives the reason.
    """

    outputs: Mapping[str, tuple[str, ...]]
    _: KW_ONLY
    reference: Mapping[tuple[str, ...], Ends]
    ranges: Mapping[str, Ends]
    dwell: tuple[float, float]
    held: tuple[str, ...] = ()
    course: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.outputs or not self.reference:
            raise ValueError("a frame needs an output and a reference")
        for name, states in self.outputs.items():
            _check_states(f"outputs: {name}", states)
        for chain in self.reference:
            _check_states("reference: a chain", chain)
        listed = [state for chain in self.reference for state in chain]
        if len(set(listed)) < len(listed):
            raise ValueError(f"reference: a state is in two chains: {listed}")
        for chain, ends in self.reference.items():
            if not 1 <= len(chain) <= 2:
                raise ValueError(f"reference: a chain has 1 or 2 states, got {chain}")
            check_ends(f"reference: the rate of {chain[-1]}", ends)
            if not ends[0] < 0.0 < ends[1]:
                raise ValueError(f"reference: the rate of {chain[-1]} has no 0 inside")
        _check_course(self.course, listed)
        for state, ends in self.ranges.items():
            if state not in listed:
                raise ValueError(f"ranges: {state} is in no chain of the reference")
            check_ends(f"ranges: {state}", ends)
        for chain in self.reference:
            ends = self.ranges.get(chain[-1], (-1.0, 1.0))
            if chain[0] in self.ranges and len(chain) == 2 and ends[0] * ends[1] >= 0.0:
                raise ValueError(
                    f"ranges: {chain[0]} cannot stay in its range, since that of "
                    f"{chain[1]} has no 0 inside"
                )
        _check_dwell(self.dwell)

    @property
    def followed(self) -> tuple[str, ...]:
        """The states of the reference: those of the chains, and a course's position."""
        chained = tuple(state for chain in self.reference for state in chain)
        return (*chained, *self.course[:2])

    @property
    def held_by_default(self) -> tuple[str, ...]:
        """The position of a course, and the first state of every other chain."""
        first = [chain[0] for chain in self.reference if not {*chain} & {*self.course}]
        return (*self.course[:2], *first)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the entries of ρ."""
        rates = (f"rate of {chain[-1]}" for chain in self.reference)
        return (*rates, *self.ranges)

    @property
    def input_box(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper ends of ρ."""
        ends = [*self.reference.values(), *self.ranges.values()]
        low = tuple(float(pair[0]) for pair in ends)
        return low, tuple(float(pair[1]) for pair in ends)


def tracking(
    outputs: Mapping[str, tuple[str, ...]],
    *,
    reference: Mapping[tuple[str, ...], Ends],
    ranges: Mapping[str, Ends] | None = None,
    dwell: tuple[float, float] = (0.5, 2.0),
    held: tuple[str, ...] = (),
    course: tuple[str, ...] = (),
) -> Tracking:
    """Return coordinates relative to a reference that moves; see `Tracking`."""
    return Tracking(
        outputs,
        reference=reference,
        ranges=ranges or {},
        dwell=dwell,
        held=held,
        course=course,
    )


def regulation(
    outputs: Mapping[str, tuple[str, ...]],
    *,
    set_points: Mapping[str, Ends],
    rates: Mapping[str, float],
    dwell: tuple[float, float] = (1.0, 4.0),
    held: tuple[str, ...] = (),
) -> Tracking:
    """Return coordinates relative to set points; see `Tracking`.

    Args:
        outputs: name -> states.
        set_points: state -> range of its set point.
        rates: state -> largest rate at which its set point moves, to both sides.
        dwell: shortest and longest time between two changes of the set points [s].
        held: states that reach their set points, as many as there are controls; () for
            all states of `set_points`.
    """
    if set(rates) != set(set_points):
        raise ValueError(f"rates: one for each of {', '.join(set_points)}")
    return Tracking(
        outputs,
        reference={(state,): (-rates[state], rates[state]) for state in set_points},
        ranges=set_points,
        dwell=dwell,
        held=held,
    )


def _check_states(what: str, states: Any) -> None:
    """Raise a ValueError unless these are names of states, in a tuple."""
    is_sequence = isinstance(states, tuple | list) and len(states) > 0
    if not (is_sequence and all(isinstance(state, str) for state in states)):
        raise ValueError(f'{what} is states as in ("x", "y"), got {states!r}')


def _check_course(course: Any, chained: list[str]) -> None:
    """Raise a ValueError unless direction and velocity of a course are in chains."""
    if course == ():
        return
    _check_states("course", course)
    if len(course) != 4 or len(set(course)) < 4:
        raise ValueError(
            f"course: two states of a position, direction and velocity, got {course}"
        )
    for state in course[:2]:
        if state in chained:
            raise ValueError(f"course: {state} is in a chain, and in the position too")
    for state in course[2:]:
        if state not in chained:
            raise ValueError(f"course: {state} is in no chain of the reference")


def _check_dwell(dwell: Any) -> None:
    """Raise a ValueError unless these are two times, the shorter first."""
    is_pair = isinstance(dwell, tuple | list) and len(dwell) == 2
    if not (is_pair and 0.0 < dwell[0] <= dwell[1] < np.inf):
        raise ValueError(f"dwell: two rising times above 0, got {dwell!r}")
