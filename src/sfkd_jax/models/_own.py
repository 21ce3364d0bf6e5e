"""A model from outside this package, by the name of its factory."""

from __future__ import annotations

import inspect
from typing import Any

from sfkd_jax.core.named import imported
from sfkd_jax.types import Environment, Fiber, Model, Params, Space, Step

SETTING = "model.factory"


def own(
    space: Space,
    *,
    nominal: Step,
    factory: str,
    options: dict[str, Any] | None = None,
    dt: float = 0.1,
    environment: bool = True,
) -> Model:
    """Return what `package.module:function` makes of the scales of a data set.

    The function is called as function(space, **options). If it has arguments of these
    names, it is given `dt`, `nominal` and `environment` as well.

    Args:
        space: measured scales; fixes all sizes.
        nominal: (x, u, e) -> dx/dt of the known dynamics in physical units.
        factory: of the model, as package.module:function.
        options: more arguments of the factory.
        dt: sampling period [s].
        environment: whether e is used. A factory without such an argument is given the
            centre of E instead of e.

    Raises:
        ValueError: there is no such function, it does not take the options, or returns
            something else than a model.
    """
    function = imported(factory, SETTING)
    try:
        takes = inspect.signature(function).parameters
        offered = {"dt": dt, "nominal": nominal, "environment": environment}
        given = {name: value for name, value in offered.items() if name in takes}
        model = function(space, **given, **(options or {}))
    except TypeError as reason:
        raise ValueError(f"{SETTING}={factory}: {reason}") from None
    if not isinstance(model, Model):
        kind = type(model).__name__
        raise ValueError(
            f"{SETTING}={factory} returned {kind}, not sfkd_jax.types.Model"
        )
    if environment or "environment" in takes:
        return model

    def fiber(params: Params, env: Environment) -> Fiber:
        del env
        return model.fiber(params, space.env_mean)

    return model._replace(fiber=fiber)
