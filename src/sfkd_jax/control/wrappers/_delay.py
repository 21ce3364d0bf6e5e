"""Planning for the state that the vehicle will be in once the control arrives."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Control, Controller, Environment, Key, Model, Params, State


class DelayState(NamedTuple):
    """What delay compensation carries.

    Attributes:
        inner: state of the controller.
        sent: controls on their way, oldest first.
    """

    inner: Any
    sent: Float[Array, "delay control"]


def delay_compensated(
    controller: Controller,
    model: Model,
    *,
    delay: int,
    initial_control: tuple[float, ...] = (0.0, 0.0),
) -> Controller:
    """The same controller for actuators that answer `delay` sampling periods late.

        x̂_{k+d} = F(… F(x_k, u_{k−d}, e_k) …, u_{k−1}, e_k),   u_k = act(x̂_{k+d}, e_k, reference)

    The observation is carried forward by the model through the controls already sent,
    and the controller plans from there. The reference must be that of the time at which
    the control arrives.

    Args:
        controller: any.
        model: predicts; the one of the controller's own rollouts.
        delay: d, at least 1.
        resting: what is in force before the first control arrives.

    Returns:
        A `Controller`; `info` gains `arrival_state`, x̂_{k+d}.

    Raises:
        ValueError: a delay below 1.
    """
    if delay < 1:
        raise ValueError(f"delay must be at least 1 sampling period, got {delay}")

    def init(key: Key) -> DelayState:
        return DelayState(
            controller.init(key),
            jnp.tile(jnp.asarray(initial_control, dtype=float), (delay, 1)),
        )

    def act(
        params: Params,
        state: DelayState,
        observation: State,
        env: Environment,
        reference: Any,
    ) -> tuple[Control, DelayState, dict[str, Array]]:
        fiber = model.fiber(params, env)
        advance = lambda latent, control: (model.step(fiber, latent, control), None)  # noqa: E731
        latent, _ = jax.lax.scan(advance, model.encode(fiber, observation), state.sent)
        arrival = model.decode(fiber, latent)
        control, inner, info = controller.act(
            params, state.inner, arrival, env, reference
        )
        sent = jnp.concatenate([state.sent[1:], control[None]])
        return control, DelayState(inner, sent), info | {"arrival_state": arrival}

    return Controller(init, act)
