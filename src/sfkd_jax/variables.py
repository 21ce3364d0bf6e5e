"""Names, units and ranges of states, controls and the entries of e."""

from __future__ import annotations

from typing import NamedTuple


class StateVariable(NamedTuple):
    """A state of a system.

    Attributes:
        name: of the state.
        unit: of the state; "" if it is not known.
        deviation: standard deviation of its sensor, in that unit. 0 stands for an exact
            observation, and is the value of a state without a stated deviation.
    """

    name: str
    unit: str = ""
    deviation: float = 0.0

    @property
    def label(self) -> str:
        """Name and unit, as in "v [m/s]"."""
        return _labelled(self.name, self.unit)

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle [rad]."""
        return self.unit == "rad"


class ControlVariable(NamedTuple):
    """A control of a system.

    Attributes:
        name: of the control.
        unit: of the control.
        low: lower limit of the actuator; None if it is unknown.
        high: upper limit of the actuator; None if it is unknown.
    """

    name: str
    unit: str
    low: float | None = None
    high: float | None = None

    @property
    def label(self) -> str:
        """Name and unit, as in "torque [Nm]"."""
        return _labelled(self.name, self.unit)


class EnvironmentVariable(NamedTuple):
    """An entry of e.

    Attributes:
        name: of the entry.
        unit: of the entry; "-" if it has none.
    """

    name: str
    unit: str

    @property
    def label(self) -> str:
        """Name and unit, as in "friction [-]"."""
        return _labelled(self.name, self.unit)


def _labelled(name: str, unit: str) -> str:
    """Return a name with its unit, if it has one."""
    return f"{name} [{unit}]" if unit else name
