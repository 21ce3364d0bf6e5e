"""Models whose latent is the state, such as those of known dynamics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from flax import traverse_util
from jaxtyping import Array, Float

from sfkd_jax.types import (
    BODY,
    BODY_FRAME,
    Control,
    Environment,
    Fiber,
    Frame,
    Key,
    Model,
    Params,
    State,
    Step,
)

flat = partial(traverse_util.flatten_dict, sep="/")
"""Nested dictionaries -> one dictionary by path, such as "network/layers_0/bias"."""
nested = partial(traverse_util.unflatten_dict, sep="/")
"""The inverse of `flat`."""


def body_state(state: State) -> Float[Array, " body"]:
    """Return the body state."""
    return state[BODY]


def state_model(
    init: Callable[[Key], Params],
    fiber: Callable[[Params, Environment], Fiber],
    step: Callable[[Fiber, State, Control], State],
    *,
    vector: Callable[[State], Float[Array, " body"]] = body_state,
    state_size: int | None = None,
    frame: Frame = BODY_FRAME,
) -> Model:
    """Return a model that steps the state itself, so that nothing is encoded.

    Args:
        init: key -> params.
        fiber: (params, env) -> all that depends on e alone.
        step: (fiber, state, control) -> state one sampling period later.
        vector: state -> the coordinates in which prediction residuals are measured; by
            default those of the body.
        state_size: number of entries of a state, which is checked when a state is
            encoded; None accepts any.
        frame: the coordinates of states, and the inputs of controls.
    """

    def encode(fiber: Fiber, state: State) -> State:
        # Broadcasting would accept a state of another plant silently.
        if state_size is not None and state.shape != (state_size,):
            raise ValueError(
                f"state must have shape ({state_size},), got {state.shape}"
            )
        return state

    def decode(fiber: Fiber, state: State) -> State:
        return state

    def transport(fiber: Fiber, fiber_next: Fiber, state: State) -> State:
        # The state means the same in every environment.
        return state

    def observe(fiber: Fiber, latent: State, state: State) -> State:
        return encode(fiber, state)

    return Model(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=decode,
        transport=transport,
        observe=observe,
        vector=vector,
        frame=frame,
    )


def physics(step: Step, *, frame: Frame = BODY_FRAME) -> Model:
    """Return known dynamics as a `Model` without parameters.

    Args:
        step: (x, u, e) -> x one sampling period later. The caller passes it in, since
            models never import a plant.
        frame: the coordinates of x, and the inputs of u.
    """

    def init(key: Key) -> Params:
        # There is nothing to learn. An empty tree passes through stores and optimisers.
        return {}

    def fiber(params: Params, env: Environment) -> Environment:
        return env

    def step_in(env: Environment, state: State, control: Control) -> State:
        return step(state, control, env)

    return state_model(init, fiber, step_in, frame=frame)


def step_of(model: Model, params: Params) -> Step:
    """Return the step of a model whose latent is the state."""

    def step(state: State, control: Control, env: Environment) -> State:
        return model.step(model.fiber(params, env), state, control)

    return step
