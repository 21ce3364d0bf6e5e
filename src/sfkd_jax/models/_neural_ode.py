"""Neural ordinary differential equation: one network gives the rates."""

from __future__ import annotations

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._continuous import Conditioned, continuous, mlp
from sfkd_jax.types import Control, Key, Model, Params, Space


def neural_ode(
    space: Space,
    *,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (96, 96),
    environment: bool = True,
    frame: str = "body",
) -> Model:
    """Rates of the body state and the pose from one tanh network, solved by RK4 at dt.

        (ġ, ṡ) = W_L tanh(… tanh(W_1 [s; u; e] + b_1) …) + b_L,   ġ in the body frame

    The original has no inputs; here u and e are held over dt and are inputs like s.

    Args:
        space: measured scales; fixes all sizes.
        dt: sampling period [s], the solver's step in training and in use.
        hidden: widths.
        environment: whether e is used.
        frame: "body", or "path" for path coordinates.

    Source: Chen et al., NeurIPS 2018, arXiv 1806.07366.
    """
    body = space.body_mean.shape[0]
    inputs = body + space.control_mean.shape[0] + space.env_mean.shape[0]
    network = mlp(hidden, 3 + body, (nn.tanh,) * len(hidden), last=0.1)

    def init(key: Key) -> Params:
        return network.init(key, jnp.zeros(inputs))["params"]

    def rates(
        fiber: Conditioned, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        read = jnp.concatenate([body, control, fiber.env])
        return cast(jax.Array, network.apply({"params": fiber.params}, read))

    return continuous(
        space,
        dt=dt,
        init=init,
        fiber=Conditioned,
        rates=rates,
        environment=environment,
        frame=frame,
    )
