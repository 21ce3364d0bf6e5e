"""ICODE and ICODE-MPPI: rates that are affine in their inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._continuous import Conditioned, Rates, continuous, mlp
from sfkd_jax.ranges import check_choice
from sfkd_jax.types import (
    BODY_FRAME,
    Control,
    Frame,
    Key,
    Model,
    Params,
    Space,
    State,
    Step,
)

AFFINE_IN = ("both", "env", "control")


def affine_rates(
    space: Space,
    hidden: Sequence[int],
    activations: Sequence[Callable[[Array], Array]],
    *,
    last: float,
    affine_in: str = "both",
) -> Rates:
    """Return rates that are affine in some of their inputs.

        affine_in="both":     f(s) + G(s) [u; e]
        affine_in="env":      f(s, u) + G(s, u) e
        affine_in="control":  f(s, e) + G(s, e) u

    f and G are networks of the same widths, see `mlp` for the other arguments.
    """
    check_choice("model.affine_in", affine_in, AFFINE_IN)
    sizes = {
        "body": space.body_mean.shape[0],
        "control": space.control_mean.shape[0],
        "env": space.env_mean.shape[0],
    }
    # Only the affine inputs are multiplied by G; both networks read the others.
    affine_names = ("control", "env") if affine_in == "both" else (affine_in,)
    network_names = tuple(name for name in sizes if name not in affine_names)
    affine_size = sum(sizes[name] for name in affine_names)
    network_size = sum(sizes[name] for name in network_names)
    outputs = 3 + sizes["body"]
    # Two networks, as published, rather than one with two heads.
    f = mlp(hidden, outputs, activations, last=last)
    G = mlp(hidden, outputs * affine_size, activations, last=last)

    def init(key: Key) -> Params:
        # With one key for both, the weights of f and G would start correlated.
        f_key, G_key = jax.random.split(key)
        inputs = jnp.zeros(network_size)
        return {
            "f": f.init(f_key, inputs)["params"],
            "G": G.init(G_key, inputs)["params"],
        }

    def rates(
        fiber: Conditioned, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        parts = {"body": body, "control": control, "env": fiber.env}
        network_inputs = jnp.concatenate([parts[name] for name in network_names])
        affine_inputs = jnp.concatenate([parts[name] for name in affine_names])
        free: Any = f.apply({"params": fiber.params["f"]}, network_inputs)
        gain: Any = G.apply({"params": fiber.params["G"]}, network_inputs)
        # The affine inputs enter here alone.
        return free + gain.reshape(outputs, affine_size) @ affine_inputs

    return Rates(init, rates)


def icode(
    space: Space,
    *,
    dt: float = 0.1,
    width: int = 60,
    layers: int = 3,
    environment: bool = True,
    affine_in: str = "both",
    frame: Frame = BODY_FRAME,
) -> Model:
    """Input concomitant neural ODE: rates affine in control and environment.

        (ġ, ṡ) = f(s) + G(s) [u; e],   ġ in the body frame

    f and G have a tanh layer, then softplus layers. Tyre forces at their limit are not
    affine in e. That is a limitation of the published structure, and it is kept here.
    The original solves by Euler's method on the grid of the data. Since the rates of
    the pose are learned in the body frame, an Euler step composes learned increments
    and loses nothing.

    Args:
        width: of the hidden layers of f and of G.
        layers: number of hidden layers of f and of G.
        affine_in: "both" as above; "env" for f(s, u) + G(s, u) e, where e is what the
            paper calls an extrinsic input; "control" for f(s, e) + G(s, e) u.
        frame: the coordinates of states.

    Source: Li et al., arXiv 2411.13914.
    """
    # The first layer is a tanh, as published: it bounds what the unbounded softplus
    # layers read.
    activations = (nn.tanh, *(nn.softplus,) * (layers - 1))
    rates = affine_rates(
        space, (width,) * layers, activations, last=0.1, affine_in=affine_in
    )

    def euler(rate: Callable[[State], State], state: State, dt: float) -> State:
        return state + dt * rate(state)

    return continuous(
        space, rates, dt=dt, environment=environment, solve=euler, frame=frame
    )


def icode_mppi(
    space: Space,
    *,
    nominal: Step,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (64, 64),
    environment: bool = True,
    affine_in: str = "both",
) -> Model:
    """Known dynamics plus a residual f(s) + G(s) [u; e], the sum solved by RK4 at dt.

        ẋ = f_nom(x, u) + f(s) + G(s) [u; e]

    The pose part of the residual is in the body frame. f and G are softplus networks
    that start near 0, so that training starts from the known dynamics. The residual of
    the original is f(x) + G(x) u; here e joins u.

    Args:
        nominal: (x, u, e) -> dx/dt of the known dynamics in physical units. The caller
            passes it in, since models never import a plant. A model that ignores e
            passes the centre of the environment box to it.
        hidden: widths of f and of G.
        affine_in: as for `icode`; with "control" the gain of the control may depend on
            friction.

    Source: Song et al., arXiv 2605.03260, eqs. 10 and 11.
    """
    # 1e-3 and not 0.1, because the known dynamics are good already, and noise would
    # spoil them.
    rates = affine_rates(
        space, hidden, (nn.softplus,) * len(hidden), last=1e-3, affine_in=affine_in
    )

    def known(fiber: Conditioned, state: State, control: Control) -> State:
        # The known dynamics are in physical units.
        env = space.env_mean + space.env_scale * fiber.env
        return nominal(state, control, env)

    return continuous(space, rates, dt=dt, environment=environment, known=known)
