"""Delay compensation: plan from the state in which a late control will arrive."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control._factory import Stateful, factory
from sfkd_jax.ranges import AtLeastOne, check_intervals
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
    """What delay compensation carries from one control step to the next."""

    inner: Any  # state of the wrapped controller
    # Controls that have not arrived yet, oldest first.
    sent: Float[Array, "delay control"]


@dataclass(frozen=True, eq=False)
class DelayCompensation(Stateful):
    """A controller for actuators that respond `delay` sampling periods late.

        x̂_{k+d} = F(… F(x_k, u_{k−d}, e_k) …, u_{k−1}, e_k)
        u_k = act(x̂_{k+d}, e_k, reference)

    The model predicts the observation through the controls already sent, and the
    controller plans from the result. The reference must be that of the time at which
    the control arrives. `info` gains `arrival_state`, x̂_{k+d}.

    Attributes:
        inner: any controller.
        model: used for the prediction; usually that of the controller's rollouts.
        delay: d, at least 1.
    """

    inner: Controller
    model: Model
    _: KW_ONLY
    delay: AtLeastOne

    def __post_init__(self) -> None:
        check_intervals(self)
        # Sent are controls of the vehicle, which its closed loop does not take.
        if self.model.along_path:
            raise ValueError(
                "delay compensation predicts the vehicle from its controls, and this "
                "model its closed loop along a path: use models.physics(plant.step)"
            )

    def init(self, key: Key) -> DelayState:
        """Return the state before the first control step."""
        return DelayState(self.inner.init(key), jnp.zeros((self.delay, 2)))

    def act(
        self,
        params: Params,
        state: DelayState,
        observation: State,
        env: Environment,
        reference: Any,
    ) -> tuple[Control, DelayState, ControllerInfo]:
        """Take one control step."""
        model, fiber = self.model, self.model.fiber(params, env)

        def predict(latent: Any, control: Control) -> tuple[Any, None]:
            return model.step(fiber, latent, control), None

        # From the oldest on, in the order in which the actuators will apply them.
        latent, _ = jax.lax.scan(predict, model.encode(fiber, observation), state.sent)
        arrival = model.decode(fiber, latent)
        control, inner, info = self.inner.act(
            params, state.inner, arrival, env, reference
        )
        sent = jnp.concatenate([state.sent[1:], control[None]])
        return control, DelayState(inner, sent), {**info, "arrival_state": arrival}


delay_compensated = factory(DelayCompensation, DelayCompensation.controller)
"""(controller, model, settings of `DelayCompensation`) -> `Controller`."""
