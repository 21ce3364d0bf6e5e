"""Models whose latent is the physical state itself."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Array, Float

from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Fiber,
    Fitting,
    Key,
    Model,
    Params,
    State,
    Structure,
)

NO_FITTING = Fitting()
NO_STRUCTURE = Structure()


def body_of(state: State) -> Float[Array, " body"]:
    """Return the body state."""
    return state[BODY]


def state_model(
    init: Callable[[Key], Params],
    fiber: Callable[[Params, Environment], Fiber],
    step: Callable[[Fiber, State, Control], State],
    *,
    vector: Callable[[State], Float[Array, " body"]] = body_of,
    state_size: int | None = None,
    fitting: Fitting = NO_FITTING,
    structure: Structure = NO_STRUCTURE,
    along_path: bool = False,
) -> Model:
    """Return a model that steps the state itself, so that nothing is encoded.

    Args:
        init: key -> params.
        fiber: (params, env) -> all that depends on e alone.
        step: (fiber, state, control) -> state one sampling period later.
        vector: state -> the coordinates that prediction residuals are measured in.
        state_size: number of entries of a state, checked when one is encoded; None
            accepts any.
        fitting: as in `Model`.
        structure: as in `Model`.
        along_path: whether states and controls are those of `geometry`.
    """

    def encode(fiber: Fiber, state: State) -> State:
        del fiber
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
        transport=lambda fiber, fiber_next, state: state,
        observe=lambda fiber, latent, state: encode(fiber, state),
        vector=vector,
        fitting=fitting,
        structure=structure,
        along_path=along_path,
    )
