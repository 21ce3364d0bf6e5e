"""What a task is made of, chosen by name or given, and refused in one line."""

from __future__ import annotations

import math

import jax

from sfkd_jax import build
from sfkd_jax.scenarios import Family
from sfkd_jax.vehicle import Vehicle


def choose_plant(vehicle: str | Vehicle, inner_loop: str) -> Vehicle:
    """A plant by name, at the gain that its speed loop has by default."""
    if isinstance(vehicle, Vehicle):
        return vehicle
    return build.build_vehicle(
        {"name": vehicle, "inner_loop": inner_loop, "speed_gain": 1.0}
    )


def choose_family(scenario: str | Family, plant: Vehicle, duration: float) -> Family:
    """A scenario family by name, with the roads of the benchmark."""
    if not isinstance(scenario, str):
        return scenario
    return build.build_scenario({"name": scenario}, plant, duration=duration)


def count_steps(family: Family, plant: Vehicle) -> int:
    """Length of the family's episodes; nothing is computed.

    Raises:
        ValueError: the family is for another plant.
    """
    road = jax.eval_shape(family, jax.random.key(0))
    given, wanted = road.initial_state.shape, (len(plant.state_names),)
    if given != wanted:
        raise ValueError(
            f"the scenario starts in a state of shape {given}, {plant.name!r} has {wanted}"
        )
    return road.envs.shape[0]


def check_sizes(dt: float, *, duration: float, preview: int, lane: float) -> None:
    """Refuse what leaves no step, no point ahead, or no lane."""
    if not (math.isfinite(duration) and duration >= dt):
        raise ValueError(
            f"duration must be finite and at least one step of {dt} s, got {duration}"
        )
    if preview < 1 or preview != int(preview):
        raise ValueError(f"preview must be a whole number of at least 1, got {preview}")
    if not lane > 0:
        raise ValueError(f"lane must be positive, got {lane}")


def check_weights(**weights: float) -> None:
    """Refuse what is negative or not finite."""
    for name, weight in weights.items():
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(f"{name} must be finite and at least 0, got {weight}")
