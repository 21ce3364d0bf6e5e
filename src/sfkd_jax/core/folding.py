"""Parameters together with everything that follows from them for every environment."""

from __future__ import annotations

from typing import Any, NamedTuple

from sfkd_jax.types import Model, Params


class Folded(NamedTuple):
    """Parameters to drive with: `Model.fiber` need not bound or factorise them again.

    Attributes:
        weights: the parameters as they were learned and stored.
        shared: `Model.shared` of these parameters.
    """

    weights: Params
    shared: Any


def fold(model: Model, params: Params) -> Params:
    """Evaluate once what every control step would otherwise evaluate again.

    `policy.load` and the evaluation pipeline do this; only a program that drives with
    parameters it has just trained calls it, and compiles it.

    Args:
        model: any model.
        params: of the model; folded ones are returned unchanged.

    Returns:
        `Folded`, or the parameters themselves if the model has nothing to share.
    """
    if model.shared is None or isinstance(params, Folded):
        return params
    return Folded(params, model.shared(params))


def unfold(params: Params) -> Params:
    """Return the parameters as they were learned, folded or not."""
    return params.weights if isinstance(params, Folded) else params
