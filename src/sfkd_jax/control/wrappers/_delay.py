"""Delay compensation: plan from the state in which a late control will arrive."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Model,
    Params,
    State,
)


class DelayState(NamedTuple):
    """What delay compensation carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        sent: controls that have not arrived yet, oldest first.
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
    """Wrap a controller for actuators that respond `delay` sampling periods late.

        x̂_{k+d} = F(… F(x_k, u_{k−d}, e_k) …, u_{k−1}, e_k)
        u_k = act(x̂_{k+d}, e_k, reference)

    The model predicts the observation through the controls already sent, and the
    controller plans from the result. The reference must be that of the time at which
    the control arrives.

    Args:
        controller: any controller.
        model: used for the prediction; usually that of the controller's rollouts.
        delay: d, at least 1.
        initial_control: in force before the first control arrives.

    Returns:
        A `Controller`; `info` gains `arrival_state`, x̂_{k+d}.

    Raises:
        ValueError: the delay is less than 1.
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
    ) -> tuple[Control, DelayState, ControllerInfo]:
        fiber = model.fiber(params, env)

        def predict(latent: Any, control: Control) -> tuple[Any, None]:
            return model.step(fiber, latent, control), None

        # From the oldest on, in the order in which the actuators will apply them.
        latent, _ = jax.lax.scan(predict, model.encode(fiber, observation), state.sent)
        arrival = model.decode(fiber, latent)
        control, inner, info = controller.act(
            params, state.inner, arrival, env, reference
        )
        sent = jnp.concatenate([state.sent[1:], control[None]])
        return control, DelayState(inner, sent), {**info, "arrival_state": arrival}

    return Controller(init, act)
