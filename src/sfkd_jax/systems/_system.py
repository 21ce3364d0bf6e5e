"""A system of the user: its step, and what its states, controls and e are."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.ranges import AtLeastOne, Positive, check_intervals
from sfkd_jax.rollout import runge_kutta
from sfkd_jax.types import Control, Environment, State, Step
from sfkd_jax.variables import ControlVariable, EnvironmentVariable, StateVariable

Ends = tuple[float, float]
"""Lower and upper end of a range."""
_LABEL = re.compile(r"\s*(?P<name>[^\[\]\s][^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?\s*")


@dataclass(frozen=True, eq=False)
class System:
    """A system in discrete time, x⁺ = f(x, u, e), with the ranges of u and e.

    Names may have a unit in brackets, as in "roll [rad]". A state in rad is an angle.

    Attributes:
        step: f, pure and traceable by jax; see `integrated` for a differential
            equation.
        dt: sampling period [s].
        states: name -> standard deviation of its sensor; 0 for an exact sensor.
        controls: name -> lower and upper limit.
        environment: name -> lower and upper end, entry by entry the box E. An entry may
            be anywhere in its range, and switches.
        name: of the system.

    Raises:
        ValueError: a name or a number does not fit, or the step returns something else
            than a state; gives the reason.
    """

    step: Step
    _: KW_ONLY
    dt: Positive
    states: Mapping[str, float]
    controls: Mapping[str, Ends]
    environment: Mapping[str, Ends]
    name: str = "system"

    def __post_init__(self) -> None:
        check_intervals(self)
        for what in ("states", "controls", "environment"):
            _check_names(what, getattr(self, what))
        for name, deviation in self.states.items():
            if not (_is_number(deviation) and deviation >= 0.0):
                raise ValueError(
                    f"states: the deviation of {name} must be 0 or above, "
                    f"got {deviation!r}"
                )
        for what in ("controls", "environment"):
            for name, ends in getattr(self, what).items():
                check_ends(f"{what}: {name}", ends)

    @cached_property
    def state_variables(self) -> tuple[StateVariable, ...]:
        """The states with their units and sensors."""
        return tuple(
            StateVariable(*split_label(label), deviation=float(deviation))
            for label, deviation in self.states.items()
        )

    @cached_property
    def control_variables(self) -> tuple[ControlVariable, ...]:
        """The controls with their units and limits."""
        return tuple(
            ControlVariable(*split_label(label), low=float(low), high=float(high))
            for label, (low, high) in self.controls.items()
        )

    @cached_property
    def environment_variables(self) -> tuple[EnvironmentVariable, ...]:
        """The entries of e with their units."""
        return tuple(
            EnvironmentVariable(*split_label(label)) for label in self.environment
        )

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, without units."""
        return tuple(state.name for state in self.state_variables)

    @property
    def control_box(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper limits of the controls."""
        return _corners_of(self.controls)

    @property
    def env_box(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of E."""
        return _corners_of(self.environment)

    @property
    def sensor_noise(self) -> tuple[float, ...]:
        """Standard deviations of the sensors, one for each state."""
        return tuple(state.deviation for state in self.state_variables)

    def check_step(self, state: State) -> None:
        """Raise a ValueError unless the step returns a finite state in the middle of E.

        The controls are 0, as far as their limits allow.

        Args:
            state: at which the step is tried.
        """
        size = len(self.states)
        low, high = self.control_box
        control = jnp.clip(jnp.zeros(len(low)), jnp.asarray(low), jnp.asarray(high))
        env = jnp.mean(jnp.asarray(self.env_box), axis=0)
        after = jnp.asarray(self.step(state, control, env))
        if after.shape != (size,):
            raise ValueError(
                f"the step must return a state of shape ({size},): "
                f"{', '.join(self.state_names)}; got {after.shape}"
            )
        if not np.all(np.isfinite(after)):
            raise ValueError(f"the step from the state {state} is not finite: {after}")


def integrated(
    derivative: Callable[[State, Control, Environment], Any],
    *,
    dt: Positive,
    substeps: AtLeastOne = 1,
) -> Step:
    """Return the step of a differential equation, by Runge-Kutta of order 4.

    Args:
        derivative: (x, u, e) -> dx/dt, an array or a sequence of numbers.
        dt: sampling period [s]; u and e are constant over it.
        substeps: integration steps per sampling period.
    """

    def step(state: State, control: Control, env: Environment) -> State:
        def rates(x: State) -> Float[Array, " state"]:
            return jnp.stack([*derivative(x, control, env)])

        def substep(x: State, _: None) -> tuple[State, None]:
            return runge_kutta(rates, x, dt / substeps), None

        start = jnp.asarray(state)
        return jax.lax.scan(substep, start, None, length=substeps, unroll=True)[0]

    return step


def split_label(label: str) -> tuple[str, str]:
    """Return name and unit of a label such as "roll [rad]"; the unit may be ""."""
    match = _LABEL.fullmatch(str(label))
    if match is None:
        raise ValueError(f'a name looks like "roll" or "roll [rad]", got {label!r}')
    return match["name"], match["unit"] or ""


def check_ends(what: str, ends: Any) -> None:
    """Raise a ValueError unless a range is two finite, rising numbers."""
    is_pair = isinstance(ends, tuple | list) and len(ends) == 2
    if not (is_pair and all(map(_is_number, ends)) and ends[0] < ends[1]):
        raise ValueError(f"{what}: a range is two rising numbers, got {ends!r}")


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def _check_names(what: str, entries: Mapping[str, Any]) -> None:
    """Raise a ValueError unless there are names, each of them once."""
    if not isinstance(entries, Mapping):
        raise ValueError(f"{what}: names with a value each, got {entries!r}")
    names = [split_label(label)[0] for label in entries]
    if not names:
        raise ValueError(f"{what}: a system needs one at least")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"{what}: {', '.join(sorted(twice))} is there twice")


def _corners_of(
    ranges: Mapping[str, Ends],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lower and the upper ends of ranges."""
    low = tuple(float(ends[0]) for ends in ranges.values())
    high = tuple(float(ends[1]) for ends in ranges.values())
    return low, high
