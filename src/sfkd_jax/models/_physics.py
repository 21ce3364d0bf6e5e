"""Known dynamics as a rollout model: nominal bicycle, true plant, or a biased e."""

from __future__ import annotations

from collections.abc import Callable

from sfkd_jax.models._state_model import state_model
from sfkd_jax.types import Environment, Model, Step


def physics(
    step: Step,
    *,
    distort: Callable[[Environment], Environment] = lambda env: env,
    along_path: bool = False,
) -> Model:
    """Return a one-step function as a `Model` without parameters.

    Args:
        step: (x, u, e) -> x one sampling period later, passed in by the caller (models
            never import the vehicle).
        distort: the environment that the model assumes instead of e; the identity for
            the true plant.
        along_path: whether x and u are those of `geometry`.
    """
    return state_model(
        init=lambda key: {},
        fiber=lambda params, env: distort(env),
        step=lambda env, state, control: step(state, control, env),
        along_path=along_path,
    )
