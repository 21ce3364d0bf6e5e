"""Stage costs of path tracking."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from sfkd_jax.control.laws._path_errors import PathErrors
from sfkd_jax.types import Control, Scalar


class StageInputs(NamedTuple):
    """Arguments of a stage cost at one step of one rollout.

    Attributes:
        errors: path errors after the step.
        errors_before: path errors before the step.
        control: applied in the step.
        control_before: applied in the step before.
        speed: of the reference [m/s].
    """

    errors: PathErrors
    errors_before: PathErrors
    control: Control
    control_before: Control
    speed: Scalar


class Cost(NamedTuple):
    """A stage cost whose weights are data: changing them does not recompile anything.

    Attributes:
        weights: a pytree of numbers.
        stage: (weights, `StageInputs`) -> cost of one step.
    """

    weights: Any
    stage: Callable[[Any, StageInputs], Scalar]


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
    """Return the quadratic path-tracking cost, its weights under the argument names.

        ℓ = q_y e_y² + q_c (Δe_y / v dt)² + q_v e_v² + q_δ̇ (Δδ / dt)² + q_a a²

    The course error Δe_y / (v dt) is the direction of travel relative to the path. A
    vehicle that crabs in a side wind or through a bend then aligns its direction of
    travel with the path, not its body heading.

    Args:
        dt: sampling period [s].
        lateral: q_y [1/m²].
        course: q_c [1/rad²].
        speed: q_v [s²/m²].
        steering_rate: q_δ̇ [s²/rad²].
        effort: q_a, on the acceleration [s⁴/m²]; ignored with a speed loop.
        speed_loop: whether the second control is a speed command.
    """
    weights = {
        "lateral": lateral,
        "course": course,
        "speed": speed,
        "steering_rate": steering_rate,
        "effort": effort,
    }

    def stage(weights: Mapping[str, Any], inputs: StageInputs) -> Scalar:
        errors, before = inputs.errors, inputs.errors_before
        travelled = inputs.speed * dt + 1e-3
        angle = (errors.lateral - before.lateral) / travelled
        rate = (inputs.control[0] - inputs.control_before[0]) / dt
        total = weights["lateral"] * errors.lateral**2 + weights["course"] * angle**2
        total = total + weights["speed"] * errors.speed**2
        total = total + weights["steering_rate"] * rate**2
        return (
            total if speed_loop else total + weights["effort"] * inputs.control[1] ** 2
        )

    return Cost(weights, stage)
