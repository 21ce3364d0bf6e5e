"""The ControlSynth neural ODE, which contracts by construction."""

from __future__ import annotations

from typing import NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._continuous import Rates, continuous, mlp
from sfkd_jax.ranges import Positive
from sfkd_jax.types import (
    BODY_FRAME,
    Control,
    Environment,
    Frame,
    Key,
    Model,
    Params,
    Space,
)

GAIN = 0.3
"""Initial size of the networks of the state. Their decay is GAIN² per second, which is
slow against the sampling period.
"""
ROUNDING = 1e-5
"""Margin on the rate relative to the size of the matrices, so that the inequality
holds in float32 as well.
"""


class Synthesis(NamedTuple):
    """L s + Σ_j A_j tanh(W_j s + c_j), with the M networks stacked.

    Attributes:
        linear: L.
        outer: [A_1 … A_M].
        inner: [W_1; …; W_M].
        offsets: [c_1; …; c_M].
        metric: P, in which the flow contracts; None if that is not claimed.
        multipliers: diagonal of the Λ that proves it; None likewise.
    """

    linear: Float[Array, "out body"]
    outer: Float[Array, "out hidden"]
    inner: Float[Array, "hidden body"]
    offsets: Float[Array, " hidden"]
    metric: Float[Array, "body body"] | None = None
    multipliers: Float[Array, " hidden"] | None = None

    def __call__(self, body: Float[Array, " body"]) -> Float[Array, " out"]:
        """Evaluate at one scaled body state."""
        return self.linear @ body + self.outer @ jnp.tanh(
            self.inner @ body + self.offsets
        )


class ControlSynthFiber(NamedTuple):
    """Matrices of ds/dt and of the output, and the network of u and the scaled e."""

    change: Synthesis
    twist: Synthesis
    inputs: Params
    env: Environment


def control_synth(
    space: Space,
    *,
    dt: float = 0.1,
    networks: int = 2,
    width: int = 48,
    rate: Positive = 0.05,
    input_hidden: tuple[int, ...] = (96, 96),
    environment: bool = True,
    frame: Frame = BODY_FRAME,
) -> Model:
    """Networks of the state plus a network of the input, with a contraction rate.

        ds/dt = A_0 s + Σ_j A_j tanh(W_j s + c_j) + g(u, e)
        twist = C_0 s + Σ_j C_j tanh(V_j s + d_j) + h(u, e)

    Solved by RK4 at dt. By construction, for all weights, two solutions under the same
    inputs approach each other at γ = `rate`, in the metric of a learned P = T'T: with
    A = [A_1 … A_M], W = [W_1; …; W_M] and a learned diagonal Λ > 0,

        [ A_0'P + P A_0 + 2γP   PA + W'Λ ]
        [          ·               −2Λ   ]  ≤  0,   since

        T A_0 T⁻¹ = −γI − ¼ BB' − ½ XX' + (Y − Y'),
        T A = (B − Ŵ') Λ^½,   W T⁻¹ = Λ^(−½) Ŵ

    (Schur's complement of −2Λ leaves −XX'). B, X, Y, Ŵ and Λ are free; T is triangular
    and well conditioned. The claim is about the continuous flow, not about its RK4
    discretisation. Inputs are only added, as in the original. That is a limitation of
    the published structure, and it is kept here. In the original the input is a second
    state of an autonomous system, and the published code has neither A_j nor a matrix
    inequality. The offsets c_j and d_j do not affect the proof.

    Args:
        networks: M, number of networks of the state and of the output.
        width: of each network.
        rate: γ [1/s].
        input_hidden: widths of the network that holds g and h.
        frame: the coordinates of states.

    Source: Mei, Zheng and Li, NeurIPS 2024, arXiv 2411.02292.
    """
    body = space.body_mean.shape[0]
    control = space.control_mean.shape[0]
    # A network of u and e alone: it adds the same to any two solutions.
    inputs = mlp(input_hidden, 3 + body, (nn.tanh,) * len(input_hidden), last=0.1)

    def init(key: Key) -> Params:
        hidden = networks * width
        network_inputs = jnp.zeros(control + space.env_mean.shape[0])
        keys = jax.random.split(key, 6)
        return {
            "free": {
                # Small, because the proof costs −¼ BB', which damps the state.
                "B": 0.1 * jax.random.normal(keys[0], (body, hidden)),
                "W": jax.random.normal(keys[1], (hidden, body)),
                # Not 0, where the gradient of XX' vanishes and X would stay.
                "X": 0.1 * jnp.eye(body),
                # T is 0 below the diagonal and exp 0 = 1 on it, so P = I at the start.
                "Y": jnp.zeros((body, body)),
                "T": jnp.zeros((body, body)),
                "log_multipliers": jnp.zeros(hidden),
                "offsets": jax.random.uniform(keys[2], (hidden,), minval=-1.0),
            },
            "twist": {
                "linear": jnp.zeros((3, body)),
                "outer": 0.1 * hidden**-0.5 * jax.random.normal(keys[3], (3, hidden)),
                "inner": jax.random.normal(keys[4], (hidden, body)),
                # Spread over the range, or all units would saturate at the same state.
                "offsets": jnp.linspace(-1.0, 1.0, hidden),
            },
            "inputs": inputs.init(keys[5], network_inputs)["params"],
        }

    def fiber(params: Params, env: Environment) -> ControlSynthFiber:
        change = contracting(params["free"], rate)
        twist = Synthesis(**params["twist"])
        return ControlSynthFiber(change, twist, params["inputs"], env)

    def rates(
        fiber: ControlSynthFiber, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        # Inputs are only added, or the contraction would depend on them.
        network_inputs = jnp.concatenate([control, fiber.env])
        added = inputs.apply({"params": fiber.inputs}, network_inputs)
        added = cast(jax.Array, added)
        return jnp.concatenate([fiber.twist(body), fiber.change(body)]) + added

    learned = Rates(init, rates, fiber)
    return continuous(space, learned, dt=dt, environment=environment, frame=frame)


def contracting(free: Params, rate: float) -> Synthesis:
    """Map free matrices to a state equation that contracts at `rate` [1/s].

    See `control_synth` for the parametrisation.
    """
    body, hidden = free["B"].shape
    entries = jnp.tanh(free["T"])  # so that the metric stays well conditioned
    T = jnp.tril(entries, -1) + jnp.diag(jnp.exp(jnp.diag(entries)))
    T_inverse = jnp.linalg.inv(T)
    P = T.T @ T
    # The multipliers are exponentials, hence positive without a constraint.
    roots = GAIN * hidden**-0.5 * jnp.exp(0.5 * free["log_multipliers"])
    # Scaled by the width, so that norms do not grow with the number of units.
    B = hidden**-0.5 * free["B"]
    W = GAIN * hidden**-0.5 * free["W"]
    A = B - W.T
    # The skew part cancels in the symmetric inequality: it turns without growth.
    linear = free["Y"] - free["Y"].T - 0.25 * B @ B.T - 0.5 * free["X"] @ free["X"].T
    norms = jnp.stack([jnp.linalg.norm(part) for part in (linear, A, W)])
    # How much rounding may disturb the inequality, from norms alone.
    size = rate + jnp.sum(norms) + jnp.sum(norms[1:] ** 2)
    slack = ROUNDING * jnp.sum(T**2) * jnp.sum(T_inverse**2) * size
    # The margin is no design variable, and gradients through it only add noise.
    linear -= (rate + jax.lax.stop_gradient(slack)) * jnp.eye(body)
    return Synthesis(
        # The proof is in the coordinates T s, the model in s.
        linear=T_inverse @ linear @ T,
        outer=T_inverse @ A * roots,
        inner=W @ T / roots[:, None],
        # The offsets are not in the matrix inequality.
        offsets=free["offsets"],
        # P is symmetric up to rounding only, and an eigenvalue check would read one
        # triangle.
        metric=0.5 * (P + P.T),
        multipliers=roots**2,
    )
