"""Input concomitant neural ordinary differential equation: rates affine in control and environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._continuous import Conditioned, continuous, network
from sfkd_jax.types import Control, Key, Model, Params, Space


def softplus(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """log(1 + exp x), without the branches for NaN that cost `jax.nn.softplus` a quarter of its time."""
    return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


def affine_rates(
    space: Space, hidden: Sequence[int], activations: Sequence[Callable[[Array], Array]], *, last: float
) -> tuple[Callable[[Key], Params], Callable[[Conditioned, Array, Control], Array]]:
    """`init` and `rates` of a model in continuous time with rates f(s) + G(s) [u; e], two networks of one shape.

    Args:
        space: measured scales; fixes all sizes.
        hidden, activations: widths of f and of G, and what follows each.
        last: initial scale of both last layers.
    """
    body = space.body_mean.shape[0]
    outputs, inputs = 3 + body, space.control_mean.shape[0] + space.env_mean.shape[0]
    f = network(hidden, outputs, activations, last=last)
    G = network(hidden, outputs * inputs, activations, last=last)

    def init(key: Key) -> Params:
        f_key, G_key = jax.random.split(key)
        return {"f": f.init(f_key, jnp.zeros(body))["params"], "G": G.init(G_key, jnp.zeros(body))["params"]}

    def rates(fiber: Conditioned, body: Float[Array, " body"], control: Control) -> Float[Array, " rates"]:
        free = cast(jax.Array, f.apply({"params": fiber.params["f"]}, body))
        gain = cast(jax.Array, G.apply({"params": fiber.params["G"]}, body)).reshape(outputs, inputs)
        return free + gain @ jnp.concatenate([control, fiber.env])

    return init, rates


def icode(
    space: Space, *, dt: float = 0.1, width: int = 60, layers: int = 3, solver: str = "euler", environment: bool = True
) -> Model:
    """Rates that are affine in the control and in the environment.

        (ġ, ṡ) = f(s) + G(s) [u; e],   ġ in the frame of the body

    f and G: a tanh layer, then softplus layers. Tyre forces at their limit are not affine in e: that is a limit of
    the structure, and it is kept. The original solves by Euler on the grid of the data; since
    the pose's rates are learned in the frame of the body, an Euler step composes learned increments and loses nothing.

    Args:
        space: measured scales; fixes all sizes.
        dt: sampling period [s], the solver's step in training and in use.
        width, layers: of the hidden layers of f and of G. solver: "euler" or "rk4".
        environment: use e at all; if not, G(s) [u; 0].

    Raises:
        ValueError: no hidden layer.

    Source: Li et al., arXiv 2411.13914.
    """
    if layers < 1:
        raise ValueError(f"model.layers must be at least 1, got {layers}")
    activations = (nn.tanh, *(softplus,) * (layers - 1))
    init, rates = affine_rates(space, (width,) * layers, activations, last=0.1)
    return continuous(space, dt=dt, init=init, fiber=Conditioned, rates=rates, environment=environment, solver=solver)
