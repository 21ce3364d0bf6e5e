"""Models in continuous time: learned rates of the body state, integrated together with the pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.se2 import rotate
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Explicit,
    Fiber,
    Key,
    Model,
    Params,
    Space,
    State,
)

SOLVERS = ("rk4", "euler")
FRAMES = ("body", "path")


class Conditioned(NamedTuple):
    """The fibre of a model that reads e as one more input: nothing is worth computing ahead.

    Attributes:
        params: of the networks.
        env: scaled e.
    """

    params: Params
    env: Environment


def continuous(
    space: Space,
    *,
    dt: float,
    init: Callable[[Key], Params],
    fiber: Callable[[Params, Environment], Fiber],
    rates: Callable[[Fiber, Float[Array, " body"], Control], Float[Array, " rates"]],
    environment: bool = True,
    solver: str = "rk4",
    known: Callable[[Fiber, State, Control], State] | None = None,
    explicit: Callable[[Params], Explicit] | None = None,
    frame: str = "body",
) -> Model:
    """A model ds/dt = r_s(s, u; e) whose latent is the state itself, one step of a fixed-step solver per period.

        ġ = R(yaw) (m_g + S_g r_g(s, u; e)) / dt,   ṡ = S_s r_s(s, u; e)

    with s and u scaled, m_g, S_g centre and scale of the pose increment over dt, S_s
    the scale of s; u and e are held over dt. R turns the velocity along and across the
    body into the world, so the step commutes with SE(2).

    Args:
        space: measured scales; fixes all sizes.
        dt: sampling period [s].
        init: key -> params.
        fiber: (params, scaled e) -> all that depends on e alone.
        rates: (fiber, scaled s, scaled u) -> (r_g, r_s), shape (3 + body,); r_s per
            second.
        environment: use e at all; if not, `fiber` is given zeros.
        solver: "rk4" or "euler", in training and in use.
        known: (fiber, state, control) -> dx/dt known beforehand, in the world and in
            physical units, equivariant under SE(2). The rates are then added to it, and
            m_g is left out.
        explicit: as in `Model`.
        frame: "body", or "path" for path coordinates: no pose, so r_g counts for
            nothing.

    Raises:
        ValueError: an unknown solver; a state of the wrong length, when it is encoded.
    """
    if solver not in SOLVERS:
        raise ValueError(
            f"model.solver must be one of {', '.join(SOLVERS)}, got {solver!r}"
        )
    size, pose = 3 + space.body_mean.shape[0], has_pose(frame)
    drift = jnp.asarray(space.increment_mean) if known is None else jnp.zeros(3)

    def scaled_fiber(params: Params, env: Environment) -> Fiber:
        return fiber(params, scaled_env(space, env, environment))

    def derivative(at: Fiber, state: State, control: Control) -> State:
        scaled_control = (control - space.control_mean) / space.control_scale
        rate = rates(at, scaled_body(state), scaled_control)
        if not pose:
            return jnp.concatenate([jnp.zeros(3), space.body_scale * rate[3:]])
        twist = (drift + space.increment_scale * rate[:3]) / dt
        change = jnp.concatenate(
            [rotate(state[2], twist[:2]), twist[2:], space.body_scale * rate[3:]]
        )
        return change if known is None else change + known(at, state, control)

    def step(at: Fiber, state: State, control: Control) -> State:
        k1 = derivative(at, state, control)
        if solver == "euler":
            return state + dt * k1
        k2 = derivative(at, state + 0.5 * dt * k1, control)
        k3 = derivative(at, state + 0.5 * dt * k2, control)
        k4 = derivative(at, state + dt * k3, control)
        return state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    def encode(at: Fiber, state: State) -> State:
        del at
        if state.shape != (size,):
            raise ValueError(f"state must have shape ({size},), got {state.shape}")
        return state

    def scaled_body(state: State) -> Float[Array, " body"]:
        return (state[BODY] - space.body_mean) / space.body_scale

    return Model(
        init=init,
        fiber=scaled_fiber,
        encode=encode,
        step=step,
        decode=lambda at, latent: latent,
        transport=lambda at, after, latent: latent,
        observe=lambda at, latent, state: encode(at, state),
        vector=scaled_body,
        explicit=explicit,
        along_path=not pose,
    )


def has_pose(frame: str) -> bool:
    """Whether a model predicts a pose: in the frame of the body; along a path there is none.

    Raises:
        ValueError: an unknown frame.
    """
    if frame not in FRAMES:
        raise ValueError(
            f"model.frame must be one of {', '.join(FRAMES)}, got {frame!r}"
        )
    return frame == "body"


def scaled_env(space: Space, env: Environment, environment: bool) -> Environment:
    """(e − centre) / half width, in [-1, 1] inside the box E; zeros for a model that does not see e."""
    scaled = (env - space.env_mean) / space.env_scale
    return scaled if environment else jnp.zeros_like(scaled)


def network(
    hidden: Sequence[int],
    outputs: int,
    activations: Sequence[Callable[[Array], Array]],
    *,
    last: float,
) -> nn.Sequential:
    """W_L σ_{L-1}(… σ_1(W_1 x + b_1) …) + b_L.

    Args:
        hidden: widths, one a hidden layer.
        outputs: size of the result.
        activations: σ_1 … σ_{L-1}.
        last: what the initial W_L is multiplied by; near 0, the model starts from no
            learned rates at all.
    """
    layers = [
        part
        for width, σ in zip(hidden, activations, strict=True)
        for part in (nn.Dense(width), σ)
    ]
    small = nn.initializers.variance_scaling(last**2, "fan_in", "truncated_normal")
    return nn.Sequential([*layers, nn.Dense(outputs, kernel_init=small)])
