"""Vehicles from their settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

from sfkd_jax import models, store
from sfkd_jax.driving import path_coordinates, path_following, plants
from sfkd_jax.driving.drives import Driver
from sfkd_jax.driving.logs import Columns, from_logs
from sfkd_jax.ranges import NonNegative, Positive, imported
from sfkd_jax.settings import OneOf, Values, arguments, choose, parse, schema, takes
from sfkd_jax.types import Control, Reference, Space, State, Step

LOGGED = "logged"
"""The vehicle that a model of its logs is driven in place of."""
PLANTS = plants.FACTORIES | {"own": plants.own, LOGGED: plants.own}
"""Factories of vehicles by name; the last two are of vehicles from outside."""
IDENTIFIED = "vehicle"
"""The kind of the file that holds the model of a vehicle that is known from logs."""


@takes()
class VehicleSettings:
    """A vehicle with its actuators; the other fields are arguments of its factory.

    Attributes:
        name: of the vehicle.
        dt: sampling period [s].
        inner_loop: "speed" for a loop around the speed; "none".
        speed_gain: of that loop [1/s].
        servo_lag: of a steering servo [s]; 0 for none.
        servo_rate: its largest steering rate [rad/s]; None for no limit.
    """

    name: str
    dt: Positive = 0.1
    inner_loop: Annotated[str, OneOf(("none", "speed"))] = "none"
    speed_gain: Positive = 1.0
    servo_lag: NonNegative = 0.0
    servo_rate: Positive | None = None

    @classmethod
    def subclass_for(cls, values: Values) -> type[VehicleSettings]:
        """Return the dataclass of the vehicle of this name."""
        return choose(VEHICLES, values.get("name"), "vehicle")


@takes()
class OwnVehicleSettings(VehicleSettings):
    """A vehicle of the user's own.

    Attributes:
        step: its step function, as package.module:function, or None.
        env: its simulator, as package.module:function, or None.
    """

    step: str | None = None
    env: str | None = None


_KNOWN_FROM_VEHICLE = ("dt", "wheelbase", "limits", "needs_environment", "report")
takes_logs = takes(
    from_logs,
    skip=(*_KNOWN_FROM_VEHICLE, "env_low", "env_high", "env_roles"),
    columns=schema("Columns", object, Columns),
)
"""Makes a class a dataclass with the arguments of `logs.from_logs`."""


@takes_logs
class LoggedVehicleSettings(VehicleSettings):
    """A vehicle known from its logs, in whose place a model of them is simulated.

    Attributes:
        columns: names of the columns of the logs.
        path: of the logs: a file, a folder or a glob.
        contents: hash of the logs, which is computed from the files at `path`.
        identified: file of the model, which is fitted to the logs.
    """

    columns: Any
    path: str | None = None
    contents: str | None = None
    identified: str | None = None


_BASES = {"own": OwnVehicleSettings, LOGGED: LoggedVehicleSettings}
"""Base of the settings of a vehicle, where it is not `VehicleSettings`."""
FROM_OUTSIDE = tuple(_BASES)
"""Vehicles that are not defined in this package."""
VEHICLES = {
    name: schema(
        "Vehicle",
        _BASES.get(name, VehicleSettings),
        factory,
        skip=("stiffness_by_friction", "step"),
    )
    for name, factory in PLANTS.items()
}


def build_vehicle(settings: VehicleSettings | Values) -> plants.Vehicle:
    """Return the vehicle of the settings, with its inner loop."""
    settings = parse(VehicleSettings, settings, "vehicle.")
    factory: Callable[..., plants.Vehicle] = PLANTS[settings.name]
    options = arguments(settings, factory)
    step_name = options.get("step")
    if step_name is not None:
        options["step"] = partial(_imported_step, step_name)
    simulator = getattr(settings, "env", None)
    if simulator is not None:
        options["step"] = plants.on_host(simulator)
    file = getattr(settings, "identified", None)
    if file is not None:
        options["step"] = partial(_identified_step, file)
    plant = factory(**options)._replace(name=settings.name)
    if settings.servo_lag:
        limit = settings.servo_rate or math.inf
        plant = plants.with_servo(plant, lag=settings.servo_lag, rate=limit)
    if settings.inner_loop == "none":
        return plant
    # Only the speed loop changes what the second control means.
    return plants.with_speed_loop(plant, gain=settings.speed_gain)


def _imported_step(name: str, *inputs: Any) -> Any:
    """Call the step function with this name, package.module:function.

    It is imported at the call: a vehicle may be described where its code is not
    installed.
    """
    return imported(name, "vehicle.step")(*inputs)


def _identified_step(file: str, *inputs: Any) -> Any:
    """Call the step of the model in a file, which is read at the first call."""
    return _read_identified(file)(*inputs)


@cache
def _read_identified(file: str) -> Step:
    """Return the step of the model in a file."""
    # Arrays of numpy: those of jax would belong to the program that is traced now.
    arrays, _ = store.read_arrays(Path(file), kind=IDENTIFIED)
    tree = models.nested(arrays)
    model = models.one_step(Space(**tree["space"]))
    return models.step_of(model, tree["params"])


def build_driver(plant: plants.Vehicle) -> Driver:
    """Return the path-following law that drives while data are collected."""
    # Linear: it is part of every data set of a seed.
    law = path_following.LinearFeedback(
        wheelbase=plant.wheelbase, speed_loop=plant.speed_loop
    )

    def driver(state: State, reference: Reference) -> Control:
        curvature = path_coordinates.reference_curvature(reference)[0]
        errors = path_following.path_errors(state, reference[0], curvature)
        return law(errors, curvature, reference[0, 3])

    return driver
