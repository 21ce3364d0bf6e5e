"""Build vehicles, models, scenarios, laws and controllers from their settings.

Every function takes an object of settings, or plain values that are parsed into one.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

from sfkd_jax import control, models, plants, scenarios, store
from sfkd_jax.build._controllers import CONTROLLER_SETTINGS as CONTROLLER_SETTINGS
from sfkd_jax.build._controllers import ENV_SOURCES as ENV_SOURCES
from sfkd_jax.build._controllers import PLANNERS as PLANNERS
from sfkd_jax.build._controllers import ControllerSettings as ControllerSettings
from sfkd_jax.build._controllers import build_controller as build_controller
from sfkd_jax.build._controllers import build_in_lane as build_in_lane
from sfkd_jax.build._controllers import controller_horizon as controller_horizon
from sfkd_jax.build._controllers import corridor_of as corridor_of
from sfkd_jax.build._controllers import in_corridor as in_corridor
from sfkd_jax.build._controllers import is_claimed as is_claimed
from sfkd_jax.data import Columns, Driver, from_logs
from sfkd_jax.geometry import PATH_SPEED
from sfkd_jax.ranges import Positive, imported
from sfkd_jax.settings import (
    BelowRoot,
    OneOf,
    Values,
    arguments,
    choose,
    parse,
    schema,
    takes,
)
from sfkd_jax.types import Control, Model, Reference, Space, State, Step

PLANTS = {
    "kinematic": plants.kinematic,
    "kinematic_stiff": plants.kinematic_stiff,
    "dynamic": plants.dynamic,
    "own": plants.own,
    "logged": plants.own,
}
IDENTIFIED = "vehicle"
"""Kind of the file that holds the model of a vehicle of logs."""
MODELS = models.FACTORIES | {"own": models.own}
"""Models of settings: those of the package, and one from outside by name."""
LAW_MODELS = ("learned", "nominal", "plant", *control.TEXTBOOK)
LAWS_ALONE = {f"law_{model}": model for model in LAW_MODELS}
"""System of an evaluation -> whose law drives alone in it."""
Directory = Annotated[str, BelowRoot()]


@takes()
class VehicleSettings:
    """A vehicle with its inner loop; the other fields are arguments of its factory."""

    name: str
    dt: Positive = 0.1
    inner_loop: Annotated[str, OneOf(("none", "speed"))] = "none"
    speed_gain: Positive = 1.0

    @classmethod
    def subclass_for(cls, values: Values) -> type[VehicleSettings]:
        """Return the dataclass of the vehicle of this name."""
        return choose(VEHICLES, values.get("name"), "vehicle")


@takes()
class OwnVehicleSettings(VehicleSettings):
    """An own vehicle, with its step or its simulator as package.module:function."""

    step: str | None = None
    env: str | None = None


_KNOWN = ("dt", "wheelbase", "limits", "needs_environment", "report")
takes_logs = takes(
    from_logs,
    skip=(*_KNOWN, "env_low", "env_high"),
    columns=schema("Columns", object, Columns),
)
"""Makes a class a dataclass with the arguments of `data.from_logs`."""


@takes_logs
class LoggedVehicleSettings(VehicleSettings):
    """A vehicle known from its logs, in whose place a model of them is simulated.

    Attributes:
        path: of the logs, a file, a folder or a glob.
        contents: hash of the logs; it is found from `path`.
        identified: file of the model; it is made from the logs.
    """

    columns: Any
    path: str | None = None
    contents: str | None = None
    identified: str | None = None


_KINDS = {"own": OwnVehicleSettings, "logged": LoggedVehicleSettings}
VEHICLES = {
    name: schema(
        "Vehicle",
        _KINDS.get(name, VehicleSettings),
        plant,
        skip=("stiffness_by_friction", "step"),
    )
    for name, plant in PLANTS.items()
}


def build_vehicle(settings: VehicleSettings | Values) -> plants.Vehicle:
    """Return the vehicle of the settings, with its inner loop."""
    settings = parse(VehicleSettings, settings, "vehicle.")
    factory: Callable[..., plants.Vehicle] = PLANTS[settings.name]
    options = arguments(settings, factory)
    if (name := options.get("step")) is not None:
        # At the call: a plant may be described where its code is not installed.
        options["step"] = lambda *inputs: imported(name, "vehicle.step")(*inputs)
    if (simulator := getattr(settings, "env", None)) is not None:
        options["step"] = plants.on_host(simulator)
    if (file := getattr(settings, "identified", None)) is not None:
        options["step"] = lambda *inputs: _identified(file)(*inputs)
    plant = factory(**options)._replace(name=settings.name)
    if settings.inner_loop == "none":
        return plant
    # Only the speed loop changes what the second control means.
    return plants.with_speed_loop(plant, gain=settings.speed_gain)


@cache
def _identified(file: str) -> Step:
    """Return the step of the model in a file."""
    # Arrays of numpy: those of jax would belong to the program that is traced now.
    tree = models.nested(store.read_arrays(Path(file), kind=IDENTIFIED)[0])
    return models.step_of(models.one_step(Space(**tree["space"])), tree["params"])


@takes(scenarios.scenario, skip=("state_size", "dt", "duration", "env_low", "env_high"))
class ScenarioSettings:
    """Friction, wind and road, as arguments of `scenario`."""

    name: str


def build_scenario(
    settings: ScenarioSettings | Values,
    plant: plants.Vehicle,
    *,
    duration: float,
    **box: tuple[float, ...] | None,
) -> scenarios.Family:
    """Return the scenario family of the settings, with episodes of a duration [s].

    `box` are the corners env_low and env_high of E, by default those of the benchmark.
    """
    settings = parse(ScenarioSettings, settings, "scenario.")
    corners: Any = {name: corner for name, corner in box.items() if corner}
    return scenarios.scenario(
        **arguments(settings, scenarios.scenario),
        **corners,
        duration=duration,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )


@takes()
class ModelSettings:
    """A model; the other fields are arguments of its factory.

    Attributes:
        name: of the factory.
        system: name of its runs and rows.
        environment: whether the model reads e.
    """

    name: str
    system: Directory
    environment: bool = True

    @classmethod
    def subclass_for(cls, values: Values) -> type[ModelSettings]:
        """Return the dataclass of the model of this name."""
        return choose(MODEL_SETTINGS, values.get("name"), "model")


MODEL_SETTINGS = {
    name: schema("Model", ModelSettings, factory, skip=("dt", "nominal"))
    for name, factory in MODELS.items()
}


def build_model(
    settings: ModelSettings | Values, space: Space, plant: plants.Vehicle
) -> Model:
    """Return the model of the settings.

    Models with prior knowledge take it from the vehicle: the sampling period and the
    derivative of the nominal bicycle.
    """
    settings = parse(ModelSettings, settings, "model.")
    factory = MODELS[settings.name]
    known = {"dt": plant.dt, "nominal": plant.nominal_derivative}
    # By signature: a factory takes what prior knowledge it names, and no more.
    taken = inspect.signature(factory).parameters
    prior = {name: value for name, value in known.items() if name in taken}
    return factory(space, **prior, **arguments(settings, factory))


def check_imported(settings: Any) -> None:
    """Check that the code that stored settings name was imported by the caller.

    Modules of the standard library are imported by anybody, and no models.
    """
    model = settings.get("model") if isinstance(settings, Mapping) else None
    factory = model.get("factory") if isinstance(model, Mapping) else None
    module = str(factory).partition(":")[0]
    if factory is None:
        return
    # A stored name must not reach os.system: Python's own modules are always loaded.
    if module.partition(".")[0] in sys.stdlib_module_names:
        raise ValueError(f"its model is {factory}, which is no model but Python's own")
    if module not in sys.modules:
        raise ValueError(
            f"its model is {factory}: import {module} first, if you trust it"
        )


def check_consistent(
    settings: Values, vehicle: plants.Vehicle, law: Mapping[str, Any] | None
) -> None:
    """Raise a ValueError if settings of a policy contradict each other or its law.

    The law is that of a policy along a path, as tables of numpy.
    """
    space, data = settings["space"], settings.get("dataset", {})
    for name, values in space.items():
        # No channel has a smaller scale: one that never moves has 1.
        least = 1e-6 if name.endswith("scale") else -math.inf
        if not all(least < value < math.inf for value in values):
            raise ValueError(f"its space.{name} = {values} is out of range")
    if law is not None:
        _check_law(settings, vehicle, law)
    elif "segments" in data:
        # Simulated runs never stop: a mean step is about as long as at the centre of v.
        length = space["body_mean"][0] * vehicle.dt
        if not 0.5 < space["increment_mean"][0] / length < 2.0:
            raise ValueError(f"its vehicle.dt = {vehicle.dt} is not that of its data")


def _check_law(
    settings: Values, vehicle: plants.Vehicle, law: Mapping[str, Any]
) -> None:
    """Raise a ValueError unless the tables of a law are those of the settings."""
    space, box = settings["space"], settings["environment"]
    size, axes = len(space["body_mean"]), 2 + len(space["env_mean"])
    grid = law["control"].shape[:-1]
    shapes = {"low": (axes,), "high": (axes,), "perturbation": (2,)}
    shapes |= {"state": (*grid, size), "control": (*grid, 2), "gain": (*grid, 2, size)}
    found = {name: table.shape for name, table in law.items()}
    if found != shapes or len(grid) != axes or min(grid) < 2:
        raise ValueError(f"its law has tables of shapes {found}, not of one grid")
    if (law["low"] >= law["high"]).any() or (law["perturbation"] <= 0).any():
        raise ValueError("its law has an axis without width, or no perturbation")
    # Of a law from elsewhere nothing more is known.
    if (asked := settings.get("dataset", {}).get("law")) is None:
        return
    side, (slow, fast) = asked["lateral_acceleration"], asked["speed"]
    ends = {"low": (-side, slow, *box["low"]), "high": (side, fast, *box["high"])}
    for name, wanted in {**ends, "perturbation": asked["perturbation"]}.items():
        if not np.allclose(law[name], wanted, rtol=1e-6, atol=0.0):
            raise ValueError(f"its law has {name} {law[name]}, its settings {wanted}")
    # The second control of a vehicle of one's own may be anything.
    if settings["vehicle"]["name"] in _KINDS or vehicle.speed_loop:
        return
    # The speed is the integral of the acceleration, so that the linear regulator has a
    # gain in closed form, which tells the sampling period.
    dt, weight, effort = vehicle.dt, asked["velocity"], asked["drive"]
    cost = 0.5 * (weight + math.sqrt(weight**2 + 4.0 * weight * effort / dt**2))
    gain = float(law["gain"][grid[0] // 2, ..., 1, PATH_SPEED].mean())
    if not 0.95 < gain * (effort + dt**2 * cost) / (dt * cost) < 1.05:
        raise ValueError(f"its vehicle.dt = {dt} is not that of its law")


def space_from_settings(settings: Values) -> Space:
    """Return the scales that a manifest holds."""
    # JSON has decimals: as float32 they are the bits that the model was trained with.
    arrays = [np.asarray(settings[name], dtype="float32") for name in Space._fields]
    return Space(*jax.device_put(arrays))


def build_driver(plant: plants.Vehicle) -> Driver:
    """Return the path-following law that drives while data are collected."""
    # Linear: it is part of every data set of a seed.
    law = control.LinearFeedback(wheelbase=plant.wheelbase, speed_loop=plant.speed_loop)

    def driver(state: State, reference: Reference) -> Control:
        curvature = control.reference_curvature(reference)[0]
        errors = control.path_errors(state, reference[0], curvature)
        return law(errors, curvature, reference[0, 3])

    return driver


@takes(control.derive_path_law, skip=("coordinates", "env_low", "env_high"))
class LawSettings:
    """The law of path coordinates, as arguments of `derive_path_law`.

    Attributes:
        model: whose steps it is derived from: "learned" from runs without a law,
            "nominal", the textbook bicycle, which knows no e, or "plant", the truth.
    """

    model: Annotated[str, OneOf(LAW_MODELS)] = "plant"


def build_loop(plant: plants.Vehicle, law: control.PathLaw) -> plants.Vehicle:
    """Return the closed loop of plant and law, in the coordinates of `path_frame`."""
    return plants.along_path(plant, law, perturbation=law.perturbation)


class System(NamedTuple):
    """A system that is evaluated, a row of a table; `env_source` is of `ENV_SOURCES`.

    The certificate is verified; a model in path coordinates was learned around the law.
    """

    model: Model
    params: Any
    env_source: str
    certificate: Mapping[str, Any] | None = None
    law: control.PathLaw | None = None


def reference_systems(
    plant: plants.Vehicle, law: control.PathLaw | None = None
) -> dict[str, System]:
    """Return the systems that need no learning, by name.

    "nominal" predicts with the bicycle, "oracle" with the true plant. With a law they
    describe its closed loop, in path coordinates; "law" is then the oracle once more,
    for a planner without samples (`num_samples=1`), so that the law drives alone.
    """
    plant = plant if law is None else build_loop(plant, law)
    physics = partial(models.physics, along_path=law is not None)
    oracle = System(physics(plant.step), {}, "measured", law=law)
    nominal = System(physics(plant.nominal), {}, "none", law=law)
    return {"nominal": nominal, "oracle": oracle} | ({"law": oracle} if law else {})
