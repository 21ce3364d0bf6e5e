"""Constraints of a task: obstacles, lanes and limits that planned states must keep."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.tasks._task import StepIndex, Task
from sfkd_jax.lanes import outside_box
from sfkd_jax.types import Control, Scalar

Violations: TypeAlias = Float[Array, " constraint"]
"""How far each constraint is violated; negative where it is kept."""
Constraint: TypeAlias = Callable[[Any, Any, Control, Any, StepIndex], Violations]
"""(data, predicted state, control, target, step index) -> `Violations`."""


def constrained(task: Task, constraint: Constraint, data: Any = ()) -> Task:
    """Return a task whose plans must keep constraints at every step.

    A planner drops the samples that violate one, as long as any sample keeps all. If
    none does, it takes the samples with the smallest violations, whatever they cost. If
    the chosen mean of samples violates a constraint that single samples keep, the best
    of those replaces it.

    Args:
        task: any task.
        constraint: see `Constraint`; `outside_circles` and `outside_boxes` help.
        data: pytree of numbers that the constraint is given: positions of obstacles,
            margins. A planner carries it in `Tuning.constraints`, where it may change
            at every control step.
    """
    return task._replace(constraint=constraint, constraint_data=data)


def outside_circles(
    position: Float[Array, " 2"],
    circles: Float[Array, "circle 3"],
    margin: Scalar | float = 0.0,
) -> Float[Array, " circle"]:
    """Return how deep a point lies inside circles [m], negative outside.

    Args:
        position: x, y [m].
        circles: x, y, radius of each [m].
        margin: by which each is enlarged [m].
    """
    away = position - circles[:, :2]
    # Finite derivatives in the centre too.
    return circles[:, 2] + margin - jnp.sqrt(jnp.sum(away**2, axis=1) + 1e-12)


def outside_boxes(
    position: Float[Array, " 2"],
    boxes: Float[Array, "box 5"],
    margin: Scalar | float = 0.0,
) -> Float[Array, " box"]:
    """Return how deep a point lies inside rectangles [m], negative outside.

    Args:
        position: x, y [m].
        boxes: x, y of the centre, yaw [rad], length, width [m] of each.
        margin: by which each is enlarged, with round corners [m].
    """
    away = position - boxes[:, :2]
    cos, sin = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    along, left = (
        cos * away[:, 0] + sin * away[:, 1],
        cos * away[:, 1] - sin * away[:, 0],
    )
    return margin - outside_box(along, left, (0.5 * boxes[:, 3], 0.5 * boxes[:, 4]))


def at_step(values: Array, at: StepIndex) -> Array:
    """Return the entry of a step: of moving obstacles, or of a tube's radii.

    Args:
        values: (horizon, …).
        at: the step; beyond the last entry, that one.
    """
    return values[jnp.minimum(at.number, values.shape[0] - 1)]
