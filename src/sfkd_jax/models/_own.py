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
    """Return the model that `package.module:function` makes for a data set.

    The function is called as function(space, **options). If it has arguments named
    `dt`, `nominal` or `environment`, these are passed as well.

    Args:
        space: measured scales, which fix all sizes.
        nominal: (x, u, e) -> dx/dt of the known dynamics in physical units.
        factory: of the model, as package.module:function.
        options: more arguments of the factory.
        dt: sampling period [s].
        environment: whether e is used. If not, the model of a factory without such an
            argument receives the centre of E instead of e.
    """
    function = imported(factory, SETTING)
    # The code of others may raise anything, but a command prints one line.
    with _one_line(factory):
        parameters = inspect.signature(function).parameters
        known = {"dt": dt, "nominal": nominal, "environment": environment}
        # A factory need not have all of these arguments.
        arguments = {name: known[name] for name in known if name in parameters}
        model = function(space, **arguments, **(options or {}))
    if not isinstance(model, Model):
        returned = type(model).__name__
        raise ValueError(
            f"{SETTING}={factory} returned {returned}, not sfkd_jax.types.Model"
        )
    with _one_line(factory):
        _check_shapes(model, space)
    if environment or "environment" in parameters:
        return model

    # A factory that does not know the switch gets a model that ignores e.
    def fiber(params: Params, env: Environment) -> Fiber:
        # The centre of E and not 0, which may be no environment at all (friction 0).
        return model.fiber(params, space.env_mean)

    return model._replace(fiber=fiber)


@contextmanager
def _one_line(factory: str) -> Iterator[None]:
    """Turn whatever the code of others raises into one line about the setting."""
    try:
        yield
    except Exception as reason:
        # Only the first line, since messages of jax run over pages.
        first = next(iter(str(reason).splitlines()), "")
        error = type(reason).__name__
        raise ValueError(f"{SETTING}={factory}: {error}: {first}") from reason


def _check_shapes(model: Model, space: Space) -> None:
    """Trace one step of a model, so that a wrong shape shows before the training."""
    state = jnp.zeros(3 + space.body_mean.size)
    control = jnp.zeros(space.control_mean.size)
    env = jnp.zeros(space.env_mean.size)

    def one_step(key: Key) -> State:
        fiber = model.fiber(model.init(key), env)
        latent = model.step(fiber, model.encode(fiber, state), control)
        return model.decode(fiber, latent)

    # Only shapes are evaluated; nothing is compiled.
    after = jax.eval_shape(one_step, jax.random.key(0))
    if after.shape != state.shape:
        raise ValueError(f"a step makes a state of {state.shape} one of {after.shape}")
