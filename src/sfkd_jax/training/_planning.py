"""Training of what planners add to a certified model, whose own weights stay."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sfkd_jax.ranges import Positive
from sfkd_jax.rollout import Folded, fold, rollout, state_errors
from sfkd_jax.training._loop import Draw, descend
from sfkd_jax.training._losses import Evaluated, Loss, error_units
from sfkd_jax.types import Key, Model, Params, Scalar, Space, Trajectory


def fit_planning(
    model: Model,
    params: Params,
    space: Space,
    draw: Draw,
    data: Trajectory,
    key: Key,
    *,
    steps: int,
    learning_rate: Positive = 3e-3,
) -> Params:
    """Return the parameters with those of `model.planning` fitted; no other changes.

    Its loss is the one-step part of `multi_step_loss`: along a path z is the state, so
    that a rollout is right where its steps are.

    Args:
        model: with `planning`.
        params: trained, see `fit`.
        space: its scales.
        draw: (data, key) -> a batch of windows; of one step they are as good as any.
        data: the training trajectories.
        key: for the batches.
        steps: optimiser steps.
        learning_rate: the largest.
    """
    # In millimetres. Folded, since what is certified is frozen.
    units, frozen = error_units(model, space) / 0.001, fold(model, params)
    planning = model.planning or model

    def error(weights: Params, window: Trajectory) -> Scalar:
        own = Folded({**params, "planning": weights}, frozen.shared)
        predicted, _, _ = rollout(planning, own, window)
        return jnp.mean((state_errors(predicted, window.states[1:]) * units) ** 2)

    def evaluate(weights: Params, batch: Trajectory) -> Evaluated:
        errors = jax.vmap(error, (None, 0))(weights, batch)
        return jnp.mean(errors), {}, errors

    fitted = descend(
        params["planning"],
        Loss(evaluate, evaluate),
        draw,
        data,
        key,
        steps=steps,
        learning_rate=learning_rate,
    )
    return {**params, "planning": fitted}
