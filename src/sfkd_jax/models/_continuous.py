"""Models with learned rates, solved over each sampling period; the neural ODE."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import rotate
from sfkd_jax.models._state_model import state_model
from sfkd_jax.rollout import runge_kutta
from sfkd_jax.types import (
    BODY_FRAME,
    Control,
    Environment,
    Fiber,
    Frame,
    Key,
    Model,
    Params,
    Space,
    State,
)


class Conditioned(NamedTuple):
    """The fiber of a model that reads the scaled e as one more input."""

    params: Params
    env: Environment


class Rates(NamedTuple):
    """Learned rates.

    Attributes:
        init: key -> params.
        at: (fiber, scaled s, scaled u) -> (r_g, r_s), shape (3 + body,). r_g is per
            sampling period, r_s per second.
        fiber: (params, scaled e) -> all that depends on e alone.
    """

    init: Callable[[Key], Params]
    at: Callable[[Fiber, Float[Array, " body"], Control], Float[Array, " rates"]]
    fiber: Callable[[Params, Environment], Fiber] = Conditioned


def continuous(
    space: Space,
    rates: Rates,
    *,
    dt: float,
    environment: bool = True,
    solve: Callable[[Callable[[State], State], State, float], State] = runge_kutta,
    known: Callable[[Fiber, State, Control], State] | None = None,
    frame: Frame = BODY_FRAME,
) -> Model:
    """Return a model with learned rates and one solver step per sampling period.

        ġ = R(yaw) (m_g + S_g r_g(s, u; e)) / dt,   ṡ = S_s r_s(s, u; e)

    The latent is the state itself. s and u are scaled. m_g and S_g are centre and scale
    of the pose increment over dt, and S_s is the scale of s. u and e are held over dt.
    R turns the velocity along and across the body into the world frame, so the model is
    equivariant under SE(2).

    Args:
        space: measured scales, which fix all sizes.
        rates: learned rates.
        dt: sampling period [s], which is the solver's step in training and in use.
        environment: whether e is used; if not, the fiber is that of zeros.
        solve: (x -> dx/dt, x, dt) -> x after dt, in training and in use.
        known: (fiber, state, control) -> known dx/dt in the world frame and physical
            units, equivariant under SE(2). The rates are added to it, and m_g is
            omitted.
        frame: the coordinates of states. Without a pose r_g is ignored.
    """
    # Known dynamics include the mean motion; learned rates start from that of the data.
    drift = jnp.asarray(space.increment_mean) if known is None else jnp.zeros(3)

    def fiber(params: Params, env: Environment) -> Fiber:
        return rates.fiber(params, space.scaled_env(env, environment))

    def derivative(fiber: Fiber, control: Control, state: State) -> State:
        rate = rates.at(fiber, space.scaled_body(state), space.scaled_control(control))
        # Without a pose the first three entries stay 0.
        if not frame.has_pose:
            return jnp.concatenate([jnp.zeros(3), space.body_scale * rate[3:]])
        # Increments over dt are the units in which the data are of size 1.
        twist = (drift + space.increment_scale * rate[:3]) / dt
        # The rates are in the body frame and are turned at every stage of the solver,
        # so the step is equivariant to all orders.
        change = jnp.concatenate(
            [rotate(state[2], twist[:2]), twist[2:], space.body_scale * rate[3:]]
        )
        if known is None:
            return change
        return change + known(fiber, state, control)

    def step(fiber: Fiber, state: State, control: Control) -> State:
        return solve(partial(derivative, fiber, control), state, dt)

    return state_model(
        rates.init,
        fiber,
        step,
        vector=space.scaled_body,
        state_size=3 + space.body_mean.shape[0],
        frame=frame,
    )


def mlp(
    hidden: Sequence[int],
    outputs: int,
    activations: Sequence[Callable[[Array], Array]],
    *,
    last: float,
) -> nn.Sequential:
    """Return the network W_L σ_{L-1}(… σ_1(W_1 x + b_1) …) + b_L.

    Args:
        hidden: widths of the hidden layers.
        outputs: number of outputs.
        activations: σ_1 … σ_{L-1}.
        last: factor of the initial W_L. If it is small, an untrained model stands still
            instead of diverging.
    """
    layers = []
    for width, activation in zip(hidden, activations, strict=True):
        layers += [nn.Dense(width), activation]
    small = nn.initializers.variance_scaling(last**2, "fan_in", "truncated_normal")
    return nn.Sequential([*layers, nn.Dense(outputs, kernel_init=small)])


def neural_ode(
    space: Space,
    *,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (96, 96),
    environment: bool = True,
    frame: Frame = BODY_FRAME,
) -> Model:
    """Rates of the body state and the pose from one tanh network, solved by RK4 at dt.

        (ġ, ṡ) = W_L tanh(… tanh(W_1 [s; u; e] + b_1) …) + b_L,   ġ in the body frame

    The original has no inputs. Here u and e are held over dt and are inputs like s.

    Args:
        hidden: widths of the network.
        frame: the coordinates of states.

    Source: Chen et al., NeurIPS 2018, arXiv 1806.07366.
    """
    body = space.body_mean.shape[0]
    inputs = body + space.control_mean.shape[0] + space.env_mean.shape[0]
    # W_L starts at a tenth of its usual size: the first rollouts stay near the data.
    network = mlp(hidden, 3 + body, (nn.tanh,) * len(hidden), last=0.1)

    def init(key: Key) -> Params:
        return network.init(key, jnp.zeros(inputs))["params"]

    def rates(
        fiber: Conditioned, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        inputs = jnp.concatenate([body, control, fiber.env])
        return cast(jax.Array, network.apply({"params": fiber.params}, inputs))

    learned = Rates(init, rates)
    return continuous(space, learned, dt=dt, environment=environment, frame=frame)
