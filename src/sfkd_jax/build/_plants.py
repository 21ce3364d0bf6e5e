"""Vehicles, models and scenarios out of plain settings."""

from __future__ import annotations

import inspect

import jax.numpy as jnp

from sfkd_jax import control, datasets, models, scenarios, vehicle
from sfkd_jax.build._choices import Settings, choose, without
from sfkd_jax.types import Control, Model, Reference, Space, State

PLANTS = {
    "kinematic": vehicle.kinematic,
    "dynamic": vehicle.dynamic,
    "own": vehicle.own,
}
INNER_LOOPS = ("none", "speed")


def build_vehicle(settings: Settings) -> vehicle.Vehicle:
    """A plant by name, wrapped in its inner loop."""
    loop = settings["inner_loop"]
    if loop not in INNER_LOOPS:
        raise ValueError(
            f"unknown vehicle.inner_loop {loop!r}; choose one of {', '.join(INNER_LOOPS)}"
        )
    factory = choose(PLANTS, settings["name"], "vehicle")
    options = without(settings, "name", "inner_loop", "speed_gain")
    if options.get("step") is not None:
        options["step"] = vehicle.step_named(options["step"])
    plant = factory(**options)
    return (
        vehicle.with_speed_loop(plant, gain=settings["speed_gain"])
        if loop == "speed"
        else plant
    )


def build_model(settings: Settings, space: Space, plant: vehicle.Vehicle) -> Model:
    """A learned model by the name of its factory; those that lean on textbook knowledge get it from the vehicle."""
    factory = choose(models.FACTORIES, settings["name"], "model")
    known = {"dt": plant.dt, "nominal": plant.nominal_derivative}
    given = {
        name: value
        for name, value in known.items()
        if name in inspect.signature(factory).parameters
    }
    return factory(space, **given, **without(settings, "name", "system"))


def space_to_settings(space: Space) -> dict[str, list[float]]:
    """Scales as plain lists, to lie in a manifest."""
    return {
        name: [float(entry) for entry in value]
        for name, value in space._asdict().items()
    }


def space_from_settings(settings: Settings) -> Space:
    """Scales from a manifest."""
    return Space(
        **{
            name: jnp.asarray(settings[name], dtype=jnp.float32)
            for name in Space._fields
        }
    )


def build_scenario(
    settings: Settings, plant: vehicle.Vehicle, *, duration: float
) -> scenarios.Family:
    """The scenario family that a vehicle is to drive, episodes of `duration` [s]."""
    return scenarios.scenario(
        **without(settings),
        duration=duration,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )


def build_driver(plant: vehicle.Vehicle) -> datasets.Driver:
    """The path-following law that keeps data collection on the road."""
    law = control.path_feedback(wheelbase=plant.wheelbase, speed_loop=plant.speed_loop)

    def driver(state: State, reference: Reference) -> Control:
        curvature = control.reference_curvature(reference)[0]
        return law(
            control.path_errors(state, reference[0], curvature),
            curvature,
            reference[0, 3],
        )

    return driver
