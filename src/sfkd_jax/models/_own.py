"""A model from outside this package, by the name of its factory."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax.ranges import imported
from sfkd_jax.types import Environment, Fiber, Key, Model, Params, Space, State, Step

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
    """
    function = imported(factory, SETTING)
    # Somebody else's code may raise anything; a command prints one line.
    with _one_line(factory):
        takes = inspect.signature(function).parameters
        offered = {"dt": dt, "nominal": nominal, "environment": environment}
        # Only what it asks for: a factory need not know our names.
        given = {name: value for name, value in offered.items() if name in takes}
        model = function(space, **given, **(options or {}))
    if not isinstance(model, Model):
        kind = type(model).__name__
        raise ValueError(
            f"{SETTING}={factory} returned {kind}, not sfkd_jax.types.Model"
        )
    with _one_line(factory):
        _check_shapes(model, space)
    # A factory that does not know the switch is made blind from outside.
    if environment or "environment" in takes:
        return model

    def fiber(params: Params, env: Environment) -> Fiber:
        # The centre of E, not 0, which may be no environment at all (friction 0).
        return model.fiber(params, space.env_mean)

    return model._replace(fiber=fiber)


@contextmanager
def _one_line(factory: str) -> Iterator[None]:
    """Turn whatever somebody else's code raises into one line about the setting."""
    try:
        yield
    except Exception as reason:
        # The first line alone: messages of jax run over pages.
        first = next(iter(str(reason).splitlines()), "")
        kind = type(reason).__name__
        raise ValueError(f"{SETTING}={factory}: {kind}: {first}") from reason


def _check_shapes(model: Model, space: Space) -> None:
    """Trace one step of a model, so that a wrong shape shows before it is trained."""
    sizes = (3 + space.body_mean.size, space.control_mean.size, space.env_mean.size)
    state, control, env = map(jnp.zeros, sizes)

    def one_step(key: Key) -> State:
        fiber = model.fiber(model.init(key), env)
        latent = model.step(fiber, model.encode(fiber, state), control)
        return model.decode(fiber, latent)

    # On shapes only: nothing is compiled, whatever a step costs.
    after = jax.eval_shape(one_step, jax.random.key(0))
    if after.shape != state.shape:
        raise ValueError(f"a step makes a state of {state.shape} one of {after.shape}")
