"""Vehicles of any size: their units of length and speed, relative to a car.

Distances and speeds that are constants of this package, such as the distance at which a
car that stops can still turn, are those of a car. A vehicle multiplies them by its
scale, so that a small one drives the same manoeuvre in its own units.
"""

from __future__ import annotations

from typing import NamedTuple

CAR_WHEELBASE = 2.7
"""Wheelbase of the car that the constants and defaults are for [m]."""
CAR_SPEED = 12.0
"""Its highest speed [m/s]."""


CAR_LENGTH = 4.5
"""Length of its body [m]."""
CAR_WIDTH = 2.0
"""Width of its body, mirrors included [m]."""


class Scale(NamedTuple):
    """Units of a vehicle, relative to those of the car.

    Reaction times and sampling periods do not shrink with a vehicle, so there is no
    unit of time.

    Attributes:
        length: of distances.
        speed: of speeds.
    """

    length: float = 1.0
    speed: float = 1.0


CAR = Scale()
"""The scale of the car."""


def scale_of(wheelbase: float, fastest: float) -> Scale:
    """Return the scale of a vehicle.

    Args:
        wheelbase: [m].
        fastest: highest speed of its references [m/s].
    """
    return Scale(length_scale(wheelbase), fastest / CAR_SPEED)


def length_scale(wheelbase: float) -> float:
    """Return the unit of length of a vehicle with this wheelbase [m]."""
    return wheelbase / CAR_WHEELBASE
