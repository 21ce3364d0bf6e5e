"""Settings for vehicles of any size: the defaults are those of a car, scaled.

The defaults of roads, law, noise, loss and planner were chosen for a car with a
wheelbase of 2.7 m that drives up to 12 m/s. A vehicle of the user's own with another
size or another speed gets the same problem in its own units of length and time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from sfkd_jax.driving.plants import KNOWN_STATES, described
from sfkd_jax.driving.scenarios import DriveClass
from sfkd_jax.driving.sizes import length_scale
from sfkd_jax.experiment.options import Settings
from sfkd_jax.settings import replace
from sfkd_jax.store import plain

CAR_CLASS = DriveClass()
"""Class of drives of the car that the defaults are for."""
GENTLE = 0.25
"""Curvature of the class, at most, relative to that of the steering at its limit."""
IN_RESERVE = 1.5
"""Acceleration that the controls reach, at least, relative to that of the class."""
FASTEST_LOOP = 0.6
"""Time constants of a law in seconds, at least, relative to those of a car. Delays do
not shrink with a vehicle.
"""
DIGITS = 3
"""Significant digits of what is derived, so that a line shows what is used."""


class Scale(NamedTuple):
    """A vehicle relative to the car that the defaults are for.

    Attributes:
        length: of its wheelbase.
        speed: of its fastest reference.
        acceleration: of its references; at most 1, since grip does not grow with size.
        curvature: of its references.
        softness: of the time constants of its law, in its own unit of time, length /
            speed; 1 without a law.
    """

    length: float = 1.0
    speed: float = 1.0
    acceleration: float = 1.0
    curvature: float = 1.0
    softness: float = 1.0

    @property
    def curvature_slope(self) -> float:
        """Of dκ/ds."""
        return self.curvature / self.length

    @property
    def scenario_curvature(self) -> float:
        """Of the roads of S3, which a car drives at its largest lateral acceleration.

        No road asks for more than the class has.
        """
        return min(self.curvature, self.acceleration / self.speed**2)

    @property
    def lateral_jerk(self) -> float:
        """Of v³ dκ/ds, the rate of the lateral acceleration."""
        return self.acceleration * self.speed / self.length


class Scaled(NamedTuple):
    """How a setting follows the scale of a vehicle.

    Attributes:
        unit: of the setting.
        factor: by which the default of a car is multiplied; a pair of them for steering
            and drive.
    """

    unit: str
    factor: Callable[[Scale], float | tuple[float, float]]


_LENGTH = Scaled("m", lambda scale: scale.length)
_SPEED = Scaled("m/s", lambda scale: scale.speed)
_ACCELERATION = Scaled("m/s²", lambda scale: scale.acceleration)
_DRIVE_ENTRY = Scaled("m/s²", lambda scale: (1.0, scale.acceleration))
_CURVATURE = Scaled("1/m", lambda scale: scale.curvature)
# Weights are those of squared errors.
_OF_DISTANCE = Scaled("1/m²", lambda scale: scale.length**-2)
_OF_SPEED = Scaled("s²/m²", lambda scale: scale.speed**-2)
_OF_DRIVE = Scaled("s⁴/m²", lambda scale: scale.acceleration**-2)
# At v the loop of a weight r on the curvature and q on the distance has the time
# constant (r / q)^¼ / v, and a steady ν moves the vehicle by a way like (r / q)^½.
_OF_CURVATURE = Scaled("m²", lambda scale: scale.length**2 * scale.softness**4)
_PERTURBATION = Scaled(
    "rad, m/s²", lambda scale: (scale.softness**-2, scale.acceleration)
)

SCALED = {
    "dataset.speed": _SPEED,
    "dataset.peak_curvature": _CURVATURE,
    "dataset.wavelengths": _LENGTH,
    "dataset.lateral_acceleration": _ACCELERATION,
    "dataset.acceleration": _ACCELERATION,
    "dataset.lateral_jerk": Scaled("m/s³", lambda scale: scale.lateral_jerk),
    "dataset.curvature_slope": Scaled("1/m²", lambda scale: scale.curvature_slope),
    "dataset.steering_excitation": Scaled("rad", lambda scale: scale.softness**-2),
    "dataset.speed_excitation": _ACCELERATION,
    "dataset.law.speed": _SPEED,
    "dataset.law.lateral_acceleration": _ACCELERATION,
    "dataset.law.perturbation": _PERTURBATION,
    "dataset.law.lateral": _OF_DISTANCE,
    "dataset.law.velocity": _OF_SPEED,
    "dataset.law.curvature": _OF_CURVATURE,
    "dataset.law.drive": _OF_DRIVE,
    "training.loss.size": Scaled("-", lambda scale: scale.length),
    "scenario.speed": _SPEED,
    "scenario.peak_curvature": Scaled("1/m", lambda scale: scale.scenario_curvature),
    "scenario.wavelengths": _LENGTH,
    "controller.cost.lateral": _OF_DISTANCE,
    "controller.cost.speed": _OF_SPEED,
    "controller.cost.effort": _OF_DRIVE,
    "controller.feedback.lateral_gain": Scaled("rad/m", lambda scale: 1 / scale.length),
    "controller.mppi.noise_std": _DRIVE_ENTRY,
    "controller.cem.noise_std": _DRIVE_ENTRY,
    "controller.gradient.noise_std": _DRIVE_ENTRY,
}
"""The settings with a default that follows the vehicle, by name."""
SENSORS = {
    "p_x": "length",
    "p_y": "length",
    "v": "speed",
    "v_y": "speed",
}
"""States whose sensors follow the vehicle, and what of `Scale` they follow. Those of
angles and their rates do not.
"""
NOISE = "evaluation.observation_noise"
"""The setting of the sensors, by state."""
SAME_SPEED = ("dataset.speed", "dataset.law.speed")
"""Settings that are the range of speeds which the vehicle states."""


def scaled(settings: Settings, words: Collection[str] = ()) -> Settings:
    """Return settings whose defaults follow a vehicle of the user's own.

    Those of other vehicles, and with `scaled=false`, are returned as they are.

    Args:
        settings: of a command.
        words: its overrides, as they were typed. What they set is not changed.
    """
    if not _follows_vehicle(settings):
        return settings
    typed = _typed_settings(words)
    speed = _stated_speed(settings, typed)
    scale = scale_of(settings.vehicle, speed)
    if _get(settings, "dataset.law") is None:
        # What excites the steering is the steering itself there, and not ν.
        scale = scale._replace(softness=1.0)
    for name, how in SCALED.items():
        value = _get(settings, name)
        if value is None or _is_typed(name, typed):
            continue
        if name in SAME_SPEED and speed is not None:
            value = speed
        else:
            value = _times(value, how.factor(scale))
        settings = _put(settings, name, value)
    return _put(settings, NOISE, _sensors(settings, scale, typed))


def summary(settings: Settings) -> str | None:
    """Return the settings that follow the vehicle, with their units, in one line.

    None if none of them does.
    """
    if not _follows_vehicle(settings):
        return None
    stated = []
    for name, how in SCALED.items():
        value = _get(settings, name)
        if value is not None:
            number = str(plain(value)).replace(" ", "")
            stated.append(f"{name}={number} [{how.unit}]")
    for state, deviation in _get(settings, NOISE).items():
        if deviation is not None:
            stated.append(f"{NOISE}.{state}={deviation}")
    vehicle: Any = settings.vehicle
    return (
        f"defaults for a wheelbase of {vehicle.wheelbase:.3g} m (those of a car: "
        f"scaled=false): {', '.join(stated)}"
    )


def _sensors(
    settings: Settings, scale: Scale, typed: Collection[str]
) -> dict[str, float | None]:
    """Return the deviations of the sensors by state; None for that of the state.

    They are those of a small vehicle's own sensors, such as a camera above it. Those of
    a large vehicle are no worse than those of a car.
    """
    noise = dict(_get(settings, NOISE))
    for state in _get(settings, "vehicle.state_names"):
        is_stated = noise.get(state) is not None or _is_typed(f"{NOISE}.{state}", typed)
        if state not in SENSORS or is_stated:
            continue
        factor: float = getattr(scale, SENSORS[state])
        if factor < 1.0:
            noise[state] = _times(KNOWN_STATES[state].deviation, factor)
    return noise


def _follows_vehicle(settings: Settings) -> bool:
    """Return whether the defaults of settings follow their vehicle."""
    vehicle = settings.vehicle
    is_own = getattr(vehicle, "step", None) or getattr(vehicle, "env", None)
    return settings.scaled and bool(is_own)


def scale_of(vehicle: Any, speed: tuple[float, float] | None = None) -> Scale:
    """Return the scale of a vehicle.

    Its references accelerate no more than a car's, leave a third of what the controls
    reach, and use their curvature at the highest speed.

    Args:
        vehicle: settings with wheelbase, and with limits of the controls.
        speed: range of its speeds [m/s]. Without one they grow with the root of the
            length, as those of bodies under the same gravity do.
    """
    length = length_scale(vehicle.wheelbase)
    ratio = math.sqrt(length)
    if speed is not None:
        ratio = speed[1] / CAR_CLASS.speed[1]
    curvature = 1.0 / length
    acceleration = 1.0
    if vehicle.control_low:
        steering, drive = (
            min(abs(low), abs(high))
            for low, high in zip(vehicle.control_low, vehicle.control_high, strict=True)
        )
        tightest = math.tan(min(steering, 1.5)) / vehicle.wheelbase
        curvature = min(curvature, GENTLE * tightest / CAR_CLASS.peak_curvature)
        # The limits of a speed command say nothing about the acceleration.
        if not vehicle.speed_loop:
            reached = drive / IN_RESERVE
            acceleration = min(acceleration, reached / CAR_CLASS.acceleration)
    fastest = ratio * CAR_CLASS.speed[1]
    needed = fastest**2 * curvature * CAR_CLASS.peak_curvature
    acceleration = min(acceleration, needed / CAR_CLASS.lateral_acceleration)
    softness = max(1.0, FASTEST_LOOP * ratio / length)
    return Scale(length, ratio, acceleration, curvature, softness)


def _stated_speed(
    settings: Settings, typed: Collection[str]
) -> tuple[float, float] | None:
    """Return the range of speeds that was typed, or that the simulator states."""
    if _is_typed("dataset.speed", typed):
        return _get(settings, "dataset.speed")
    simulator = getattr(settings.vehicle, "env", None)
    return described(simulator).speed if simulator else None


def _typed_settings(words: Collection[str]) -> set[str]:
    """Return the names of single settings among overrides, without chosen options."""
    names = (word.lstrip("+~").partition("=")[0] for word in words)
    return {name for name in names if "." in name}


def _is_typed(name: str, typed: Collection[str]) -> bool:
    """Return whether a setting, or a group that it is in, was typed."""
    return any(name == other or name.startswith(f"{other}.") for other in typed)


def _get(settings: Any, name: str) -> Any:
    """Return a setting by its full name; None if there is none or it is None."""
    for part in name.split("."):
        settings = getattr(settings, part, None)
    return settings


def _put(settings: Any, name: str, value: Any) -> Any:
    """Return settings with another value of one of them, by its full name."""
    first, _, rest = name.partition(".")
    if rest:
        value = _put(getattr(settings, first), rest, value)
    return replace(settings, **{first: value})


def _times(value: Any, factor: float | tuple[float, ...]) -> Any:
    """Return a number or a pair times a factor, rounded to `DIGITS` digits.

    Args:
        value: number, or pair.
        factor: of the number or of both; a pair has one for each.
    """
    if isinstance(value, tuple):
        factors = factor if isinstance(factor, tuple) else (factor,) * len(value)
        return tuple(_times(*both) for both in zip(value, factors, strict=True))
    if factor == 1.0:
        return value
    return float(f"{value * factor:.{DIGITS}g}")
