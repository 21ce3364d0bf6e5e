"""Stage costs of path tracking."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from sfkd_jax.control.laws._path_errors import PathErrors
from sfkd_jax.types import Control, Scalar


class Stage(NamedTuple):
    """What a stage cost sees: errors now and one step ago, controls now and one step ago, dt [s], speed [m/s]."""

    errors: PathErrors
    errors_before: PathErrors
    control: Control
    control_before: Control
    speed: Scalar


class Cost(NamedTuple):
    """A stage cost whose weights are data: they may change from step to step without a compilation.

    Attributes:
        weights: a pytree of numbers.
        stage: (weights, `Stage`) -> cost of one step.
    """

    weights: Any
    stage: Callable[[Any, Stage], Scalar]


def tracking_cost(
    *,
    dt: float,
    lateral: float = 200.0,
    course: float = 20.0,
    speed: float = 1.0,
    steering_rate: float = 5.0,
    effort: float = 0.02,
    speed_loop: bool = False,
) -> Cost:
    """ℓ = q_y e_y² + q_c (Δe_y / v dt)² + q_v e_v² + q_δ̇ (Δδ / dt)² + q_a a²; its weights by the names below.

    Course, Δe_y / (v dt), is the direction of travel against the path: a car that crabs
    against the wind or through a bend keeps its course, not its body heading, along the
    path.

    Args:
        dt: [s].
        lateral: [1/m²].
        course: [1/rad²].
        speed: [s²/m²].
        steering_rate: [s²/rad²].
        effort: on the acceleration [s⁴/m²]; not charged under a speed loop.
        speed_loop: whether the second control is a speed command.
    """
    weights = {
        "lateral": lateral,
        "course": course,
        "speed": speed,
        "steering_rate": steering_rate,
        "effort": effort,
    }

    def stage(weights: Mapping[str, Any], seen: Stage) -> Scalar:
        travelled = seen.speed * dt + 1e-3
        angle = (seen.errors.lateral - seen.errors_before.lateral) / travelled
        rate = (seen.control[0] - seen.control_before[0]) / dt
        total = (
            weights["lateral"] * seen.errors.lateral**2 + weights["course"] * angle**2
        )
        total = (
            total
            + weights["speed"] * seen.errors.speed**2
            + weights["steering_rate"] * rate**2
        )
        return total if speed_loop else total + weights["effort"] * seen.control[1] ** 2

    return Cost(weights, stage)
