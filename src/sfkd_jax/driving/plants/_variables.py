"""The variables of a vehicle: its states, its controls and its environment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sfkd_jax.driving.sizes import CAR_LENGTH, CAR_WIDTH, length_scale
from sfkd_jax.variables import ControlVariable, EnvironmentVariable, StateVariable


class Size(NamedTuple):
    """The rectangle that a vehicle covers; its middle is the observed position.

    Attributes:
        length: [m].
        width: mirrors included [m].
    """

    length: float
    width: float

    @property
    def half(self) -> tuple[float, float]:
        """Half of length and width [m], as obstacles state theirs."""
        return 0.5 * self.length, 0.5 * self.width


KNOWN_STATES = {
    known.name: known
    for known in (
        StateVariable("p_x", "m", 0.015),
        StateVariable("p_y", "m", 0.015),
        StateVariable("yaw", "rad", 0.002),
        StateVariable("v", "m/s", 0.03),
        StateVariable("v_y", "m/s", 0.02),
        StateVariable("yaw_rate", "rad/s", 0.002),
        StateVariable("steering", "rad", 0.001),
    )
}
"""States by name, with the sensors of a satellite and inertial unit of survey grade."""
STEERING = ControlVariable("steering", "rad")
"""The first control of every vehicle, without its limits."""
ACCELERATION = ControlVariable("acceleration", "m/s^2")
"""The second control, without its limits."""
SPEED_COMMAND = ControlVariable("speed command", "m/s")
"""The second control in place of the acceleration, with a loop around the speed."""
FRICTION_AND_WIND = (
    EnvironmentVariable("friction", "-"),
    EnvironmentVariable("lateral wind", "m/s"),
)
"""e, unless `environment.names` or the columns of logs say otherwise."""
CAR_SIZE = Size(CAR_LENGTH, CAR_WIDTH)
"""Size of a car."""


def body_size(wheelbase: float) -> Size:
    """Return the size of a body that is not stated.

    It is that of a car in the scale of its wheelbase [m]. Long vehicles are no wider.
    """
    scale = length_scale(wheelbase)
    return Size(scale * CAR_SIZE.length, min(scale, 1.0) * CAR_SIZE.width)


FRICTION = "friction"
"""Role of the entry of e that is the friction: lanes read the grip from it [-]."""
MASS = "mass"
"""Role of an entry that is a mass [kg]."""
SIDE_FORCE = "side_force"
"""Role of an entry that pushes to a side, such as a wind."""
OTHER = "other"
"""Role of an entry of which nothing is known but its box."""
ROLES = (FRICTION, MASS, SIDE_FORCE, OTHER)
_ROLE_OF_NAMES = (
    ("friction", FRICTION),
    ("mass", MASS),
    ("side force", SIDE_FORCE),
    ("wind", SIDE_FORCE),
    ("lateral wind", SIDE_FORCE),
)
"""What a name begins with, and the role of such an entry if none is stated."""


def roles_of(names: Sequence[str], stated: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the role of each entry of e, one of `ROLES`.

    Args:
        names: of the entries, with or without their units.
        stated: roles that the user states, one for each entry; () for those of the
            names.

    Raises:
        ValueError: not every entry has one of the roles, or two are the friction.
    """

    def by_name(name: str) -> str:
        roles = (role for known, role in _ROLE_OF_NAMES if name.startswith(known))
        return next(roles, OTHER)

    if not stated:
        return tuple(map(by_name, names))
    unknown = set(stated) - set(ROLES)
    if unknown or len(stated) != len(names) or stated.count(FRICTION) > 1:
        raise ValueError(
            f"environment.roles needs one of {', '.join(ROLES)} for each of "
            f"{', '.join(names)}, and friction once at most; got {', '.join(stated)}"
        )
    return tuple(stated)


def states_of(names: Iterable[str]) -> tuple[StateVariable, ...]:
    """Return the states of these names; an unknown state has nothing but its name."""
    return tuple(KNOWN_STATES.get(name, StateVariable(name)) for name in names)
