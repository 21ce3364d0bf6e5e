"""Choose and check the settings of a task."""

from __future__ import annotations

import math

import jax

from sfkd_jax import build
from sfkd_jax.plants import Vehicle
from sfkd_jax.scenarios import Family


def choose_plant(vehicle: str | Vehicle, inner_loop: str) -> Vehicle:
    """Return a plant, or build one by name with the default gain of its speed loop."""
    if isinstance(vehicle, Vehicle):
        return vehicle
    return build.build_vehicle(
        {"name": vehicle, "inner_loop": inner_loop, "speed_gain": 1.0}
    )


def choose_family(scenario: str | Family, plant: Vehicle, duration: float) -> Family:
    """Return a scenario family, or build one of the benchmark by name."""
    if not isinstance(scenario, str):
        return scenario
    return build.build_scenario({"name": scenario}, plant, duration=duration)


def count_steps(family: Family, plant: Vehicle) -> int:
    """Return the length of the family's episodes, from shapes alone.

    Raises:
        ValueError: the family is for another plant.
    """
    road = jax.eval_shape(family, jax.random.key(0))
    given, wanted = road.initial_state.shape, (len(plant.state_names),)
    if given != wanted:
        raise ValueError(
            f"the scenario starts in a state of shape {given}, "
            f"{plant.name!r} has {wanted}"
        )
    return road.envs.shape[0]


def check_sizes(dt: float, *, duration: float, preview: int, lane: float) -> None:
    """Check that there is a step, a point ahead, and a lane."""
    if not (math.isfinite(duration) and duration >= dt):
        raise ValueError(
            f"duration must be finite and at least one step of {dt} s, got {duration}"
        )
    if preview < 1 or preview != int(preview):
        raise ValueError(f"preview must be a whole number of at least 1, got {preview}")
    if not lane > 0:
        raise ValueError(f"lane must be positive, got {lane}")


def check_weights(**weights: float) -> None:
    """Check that weights are finite and not negative."""
    for name, weight in weights.items():
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(f"{name} must be finite and at least 0, got {weight}")


def observation_bounds(
    plant: Vehicle, preview: int
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the limits of observations: of angles, actions and friction, else ∞."""
    inf, turn = float("inf"), math.pi
    body, controls = len(plant.state_names) - 3, len(plant.control_low)
    high = (inf, turn, *[inf] * body, *[1.0] * controls, inf, inf)
    high = (*high, *(inf, inf, turn, inf) * preview)
    low = [-value for value in high]
    low[2 + body + controls] = 0.0  # friction
    return tuple(low), high
