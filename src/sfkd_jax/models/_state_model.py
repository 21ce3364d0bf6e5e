"""Models whose latent is the physical state itself; known dynamics as one."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Array, Float

from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Fiber,
    Key,
    Model,
    Params,
    State,
    Step,
)


def state_model(
    init: Callable[[Key], Params],
    fiber: Callable[[Params, Environment], Fiber],
    step: Callable[[Fiber, State, Control], State],
    *,
    vector: Callable[[State], Float[Array, " body"]] = lambda state: state[BODY],
    state_size: int | None = None,
    along_path: bool = False,
) -> Model:
    """Return a model that steps the state itself, so that nothing is encoded.

    Args:
        init: key -> params.
        fiber: (params, env) -> all that depends on e alone.
        step: (fiber, state, control) -> state one sampling period later.
        vector: state -> the coordinates that prediction residuals are measured in;
            those of the body without it.
        state_size: number of entries of a state, checked when one is encoded; None
            accepts any.
        along_path: whether states and controls are those of `geometry`.
    """

    def encode(fiber: Fiber, state: State) -> State:
        del fiber
        # Broadcasting would accept a state of another plant silently.
        if state_size is not None and state.shape != (state_size,):
            raise ValueError(
                f"state must have shape ({state_size},), got {state.shape}"
            )
        return state

    return Model(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=lambda fiber, state: state,
        # The state means the same in every environment, so nothing is to be carried.
        transport=lambda fiber, fiber_next, state: state,
        observe=lambda fiber, latent, state: encode(fiber, state),
        vector=vector,
        along_path=along_path,
    )


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
        # Nothing to learn; an empty tree passes through stores and optimisers.
        init=lambda key: {},
        # Distorted once per environment, so that a mismatch costs nothing in a step.
        fiber=lambda params, env: distort(env),
        step=lambda env, state, control: step(state, control, env),
        along_path=along_path,
    )
