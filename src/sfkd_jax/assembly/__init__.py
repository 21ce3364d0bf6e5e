"""Build vehicles, models, scenarios, laws and controllers from their settings.

Every function takes an object of settings, or plain values that are parsed into one.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

from sfkd_jax import models, paper
from sfkd_jax.assembly._consistency import check_consistent as check_consistent
from sfkd_jax.assembly._consistency import check_imported as check_imported
from sfkd_jax.assembly._controller_settings import (
    CONTROLLER_SETTINGS as CONTROLLER_SETTINGS,
)
from sfkd_jax.assembly._controller_settings import ENV_SOURCES as ENV_SOURCES
from sfkd_jax.assembly._controller_settings import PLANNERS as PLANNERS
from sfkd_jax.assembly._controller_settings import (
    ControllerSettings as ControllerSettings,
)
from sfkd_jax.assembly._controller_settings import (
    controller_horizon as controller_horizon,
)
from sfkd_jax.assembly._controllers import build_controller as build_controller
from sfkd_jax.assembly._corridor import corridor_of as corridor_of
from sfkd_jax.assembly._corridor import in_corridor as in_corridor
from sfkd_jax.assembly._lanes import build_in_lane as build_in_lane
from sfkd_jax.assembly._vehicles import IDENTIFIED as IDENTIFIED
from sfkd_jax.assembly._vehicles import LOGGED as LOGGED
from sfkd_jax.assembly._vehicles import PLANTS as PLANTS
from sfkd_jax.assembly._vehicles import VEHICLES as VEHICLES
from sfkd_jax.assembly._vehicles import LoggedVehicleSettings as LoggedVehicleSettings
from sfkd_jax.assembly._vehicles import VehicleSettings as VehicleSettings
from sfkd_jax.assembly._vehicles import build_driver as build_driver
from sfkd_jax.assembly._vehicles import build_vehicle as build_vehicle
from sfkd_jax.assembly._vehicles import takes_logs as takes_logs
from sfkd_jax.driving import path_following, plants, scenarios
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.driving.sizes import length_scale
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
from sfkd_jax.types import BODY_FRAME, Model, Space

MODELS = models.FACTORIES | paper.MODELS | {"own": models.own}
"""Factories of models by name; "own" is for a model from outside this package."""
FRAMES = {frame.name: frame for frame in (BODY_FRAME, PATH_FRAME)}
"""Coordinates in which models are learned, by name."""
LAW_MODELS = ("learned", "nominal", "plant", *path_following.TEXTBOOK)
"""The models that a law of path coordinates may be derived from."""
LAWS_ALONE = {f"law_{model}": model for model in LAW_MODELS}
"""System of an evaluation -> the model of the law that drives alone in it."""
Directory = Annotated[str, BelowRoot()]


@takes(
    scenarios.scenario,
    skip=("state_size", "dt", "duration", "env_low", "env_high", "scale"),
)
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
    """Return the scenario family of the settings.

    Args:
        settings: of the scenario.
        plant: the vehicle that drives in it.
        duration: of an episode [s].
        box: the corners env_low and env_high of E, by default those of the benchmark.
    """
    settings = parse(ScenarioSettings, settings, "scenario.")
    corners: Any = {name: corner for name, corner in box.items() if corner}
    return scenarios.scenario(
        **arguments(settings, scenarios.scenario),
        **corners,
        duration=duration,
        state_size=len(plant.state_names),
        dt=plant.dt,
        scale=length_scale(plant.wheelbase),
    )


@takes()
class ModelSettings:
    """A model; the other fields are arguments of its factory.

    Attributes:
        name: of the factory.
        system: the name of its runs and of its rows in tables.
        environment: whether the model reads e.
    """

    name: str
    system: Directory
    environment: bool = True

    @classmethod
    def subclass_for(cls, values: Values) -> type[ModelSettings]:
        """Return the dataclass of the model of this name."""
        return choose(MODEL_SETTINGS, values.get("name"), "model")


@takes()
class FramedModelSettings(ModelSettings):
    """A model that can be learned in several coordinates.

    Attributes:
        frame: name of the coordinates, see `types.Frame`.
    """

    frame: Annotated[str, OneOf(FRAMES)] = "body"


def _schema(factory: Callable[..., Model]) -> type[ModelSettings]:
    """Return the settings of models of a factory."""
    framed = "frame" in inspect.signature(factory).parameters
    base = FramedModelSettings if framed else ModelSettings
    return schema("Model", base, factory, skip=("dt", "nominal"))


MODEL_SETTINGS = {name: _schema(factory) for name, factory in MODELS.items()}


def build_model(
    settings: ModelSettings | Values, space: Space, plant: plants.Vehicle
) -> Model:
    """Return the model of the settings.

    Models with prior knowledge take it from the vehicle: the sampling period and the
    derivative of the nominal bicycle.
    """
    settings = parse(ModelSettings, settings, "model.")
    factory = MODELS[settings.name]
    known: dict[str, Any] = {"dt": plant.dt, "nominal": plant.nominal_derivative}
    if isinstance(settings, FramedModelSettings):
        known["frame"] = FRAMES[settings.frame]
    # By signature: a factory takes what prior knowledge it names, and no more.
    parameters = inspect.signature(factory).parameters
    prior = {name: value for name, value in known.items() if name in parameters}
    return factory(space, **arguments(settings, factory) | prior)


def space_from_settings(settings: Values) -> Space:
    """Return the scales that a manifest holds."""
    # JSON has decimals: as float32 they are the bits that the model was trained with.
    arrays = [np.asarray(settings[name], dtype="float32") for name in Space._fields]
    return Space(*jax.device_put(arrays))


@takes(
    path_following.derive_path_law,
    skip=("coordinates", "env_low", "env_high", "unsettled"),
)
class LawSettings:
    """The law of path coordinates, as arguments of `derive_path_law`.

    Attributes:
        model: the model from whose steps the law is derived: "learned" from runs
            without a law; "nominal", the textbook bicycle, which knows no e; "plant",
            the truth; or one of `path_following.TEXTBOOK`, the laws of textbooks.
    """

    model: Annotated[str, OneOf(LAW_MODELS)] = "plant"


def build_loop(plant: plants.Vehicle, law: path_following.PathLaw) -> plants.Vehicle:
    """Return the closed loop of plant and law, in path coordinates.

    See `plants.along_path`.
    """
    return plants.along_path(plant, law, perturbation=law.perturbation)


class System(NamedTuple):
    """A system that is evaluated, one row of a table.

    Attributes:
        model: the model that its planner predicts with.
        params: parameters of the model.
        env_source: where its controller takes e from, one of `ENV_SOURCES`.
        certificate: the verified certificate, or None.
        law: the law that a model in path coordinates was learned around, or None.
    """

    model: Model
    params: Any
    env_source: str
    certificate: DrivingCertificate | None = None
    law: path_following.PathLaw | None = None


def reference_systems(
    plant: plants.Vehicle, law: path_following.PathLaw | None = None
) -> dict[str, System]:
    """Return the systems that need no learning, by name.

    "nominal" predicts with the bicycle, "oracle" with the true plant. With a law they
    describe its closed loop, in path coordinates; "law" is then the oracle once more,
    for a planner without samples (`num_samples=1`), so that the law drives alone.
    What a vehicle hides, no planner can know.
    """
    plant = plant.forgetting()
    if law is not None:
        plant = build_loop(plant, law)
    physics = partial(models.physics, frame=PATH_FRAME if law else BODY_FRAME)
    oracle = System(physics(plant.step), {}, "measured", law=law)
    nominal = System(physics(plant.nominal), {}, "none", law=law)
    systems = {"nominal": nominal, "oracle": oracle}
    if law is not None:
        systems["law"] = oracle
    return systems
