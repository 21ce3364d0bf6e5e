"""Build vehicles, models, scenarios and drivers from plain settings."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from sfkd_jax import control, models, plants, scenarios
from sfkd_jax import data as datasets
from sfkd_jax.build._choices import Settings, as_kwargs, choose
from sfkd_jax.types import Control, Model, Reference, Space, State

PLANTS = {
    "kinematic": plants.kinematic,
    "kinematic_stiff": plants.kinematic_stiff,
    "dynamic": plants.dynamic,
    "own": plants.own,
}
MODELS = models.FACTORIES | {"own": models.own}
"""Models of settings: those of the package, and one from outside by name."""
INNER_LOOPS = ("none", "speed")


def build_vehicle(settings: Settings) -> plants.Vehicle:
    """Return the vehicle of the settings, with its inner loop.

    Raises:
        ValueError: an unknown vehicle or inner loop, or a step that does not exist.
    """
    loop = settings["inner_loop"]
    if loop not in INNER_LOOPS:
        raise ValueError(
            f"unknown vehicle.inner_loop {loop!r}; "
            f"choose one of {', '.join(INNER_LOOPS)}"
        )
    factory = choose(PLANTS, settings["name"], "vehicle")
    options = as_kwargs(settings, "name", "inner_loop", "speed_gain")
    if options.get("step") is not None:
        options["step"] = plants.step_named(options["step"])
    plant = factory(**options)
    return (
        plants.with_speed_loop(plant, gain=settings["speed_gain"])
        if loop == "speed"
        else plant
    )


def build_model(settings: Settings, space: Space, plant: plants.Vehicle) -> Model:
    """Return the model of the settings.

    Models with prior knowledge take it from the vehicle: the sampling period and the
    derivative of the nominal bicycle.

    Args:
        settings: the name of the factory and its arguments.
        space: scales of states, controls and environments.
        plant: the vehicle to be modelled.

    Raises:
        ValueError: an unknown model, or arguments that its factory refuses.
    """
    factory = choose(MODELS, settings["name"], "model")
    priors = {"dt": plant.dt, "nominal": plant.nominal_derivative}
    prior = {
        name: value
        for name, value in priors.items()
        if name in inspect.signature(factory).parameters
    }
    return factory(space, **prior, **as_kwargs(settings, "name", "system"))


def check_imported(settings: Any) -> None:
    """Check that the code that stored settings name was imported by the caller.

    Modules of the standard library are imported by anybody, and no models.

    Raises:
        ValueError: `model.factory` is of a module that is not imported, or of Python.
    """
    model = settings.get("model") if isinstance(settings, Mapping) else None
    factory = model.get("factory") if isinstance(model, Mapping) else None
    module = str(factory).partition(":")[0]
    if factory is None:
        return
    if module.partition(".")[0] in sys.stdlib_module_names:
        raise ValueError(f"its model is {factory}, which is no model but Python's own")
    if module not in sys.modules:
        raise ValueError(
            f"its model is {factory}: import {module} first, if you trust it"
        )


def space_to_settings(space: Space) -> dict[str, list[float]]:
    """Return scales as plain lists, for a manifest."""
    return {
        name: [float(entry) for entry in value]
        for name, value in space._asdict().items()
    }


def space_from_settings(settings: Settings) -> Space:
    """Return the scales that a manifest holds."""
    return Space(
        **{
            name: jnp.asarray(settings[name], dtype=jnp.float32)
            for name in Space._fields
        }
    )


def build_scenario(
    settings: Settings, plant: plants.Vehicle, *, duration: float
) -> scenarios.Family:
    """Return the scenario family of the settings.

    Args:
        settings: the name of the family and its arguments.
        plant: the vehicle that will drive.
        duration: of an episode [s].
    """
    return scenarios.scenario(
        **as_kwargs(settings),
        duration=duration,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )


def build_driver(plant: plants.Vehicle) -> datasets.Driver:
    """Return the path-following law that drives while data are collected."""
    law = control.path_feedback(wheelbase=plant.wheelbase, speed_loop=plant.speed_loop)

    def driver(state: State, reference: Reference) -> Control:
        curvature = control.reference_curvature(reference)[0]
        return law(
            control.path_errors(state, reference[0], curvature),
            curvature,
            reference[0, 3],
        )

    return driver
