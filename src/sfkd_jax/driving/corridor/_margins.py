"""Stability margins of a law on its plant, linearised at its steady turns."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.driving.certificate import LawMargins
from sfkd_jax.driving.corridor._closed_loop import Loop, spread_of
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.driving.path_following import by_differences
from sfkd_jax.geometry import without_pose
from sfkd_jax.types import BODY

PARTS = 10
"""Delays that are tested, per sampling period."""
LONGEST = 5
"""Longest delay that is tested [periods]."""
FACTORS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Factors of the gains that are tested, and their inverses."""
SQUARINGS = 10
"""The rate of a loop is that of 2 to this power steps."""
CURVATURES = 7
"""Points of the grid on the axis of κ."""
SPEEDS = 13
"""Points of the grid on the axis of v_ref."""
CONDITIONS = 3
"""Points of the grid on each axis of e."""
SETTLING = 80
"""Steps of the closed loop after which hidden states have settled."""
HELD = 0.1
"""Lateral error up to which the law holds a vehicle on its path [wheelbases]."""


class Linearisation(NamedTuple):
    """ξ⁺ = A ξ + B u around a steady turn, with u = −K ξ."""

    A: Float[Array, "coordinate coordinate"]
    B: Float[Array, "coordinate 2"]
    K: Float[Array, "2 coordinate"]


def law_margins(loop: Loop, data: Mapping[str, Any]) -> LawMargins | None:
    """Return the margins of a law at some speeds: the least over turns and e.

    They rest on a grid and on linearisations, and are no proof. There are none if the
    law does not stabilise all of them, since the noise grows without a limit there.

    Args:
        loop: of plant and law.
        data: settings of the data set: lateral_acceleration [m/s²], peak_curvature
            [1/m], speed [m/s], env_low and env_high.
    """
    slowest, fastest = data["speed"]
    speeds = np.linspace(slowest, fastest, SPEEDS)
    shares = np.linspace(-1.0, 1.0, CURVATURES)
    ends = zip(data["env_low"], data["env_high"], strict=True)
    envs = [np.linspace(low, high, CONDITIONS) for low, high in ends]
    axes = np.meshgrid(shares, *envs, indexing="ij")
    turns = jnp.asarray(np.stack(axes, axis=-1).reshape(-1, len(axes)), jnp.float32)
    spread = spread_of(loop.noise, loop.law.gain.shape[-1] + BODY.start)[BODY]
    spread = jnp.pad(spread, (0, loop.plant.hidden))

    def at_speed(v: Array) -> tuple[Array, ...]:
        sharpest = jnp.minimum(
            data["peak_curvature"], data["lateral_acceleration"] / v**2
        )
        loops = jax.vmap(partial(linearised, loop, v, sharpest))(turns)
        delays = jax.vmap(delay_margin)(loops)
        lows, highs = jax.vmap(gain_margin)(loops)
        lateral, steering = jax.vmap(partial(noise_of, spread))(loops)
        return (
            jnp.min(delays),
            jnp.max(lows),
            jnp.min(highs),
            jnp.max(lateral),
            jnp.max(steering),
        )

    columns = jax.jit(partial(jax.lax.map, at_speed))(jnp.asarray(speeds, jnp.float32))
    if not np.isfinite(columns).all():
        return None
    delays, lows, highs, lateral, steering = (
        tuple(np.asarray(column, float).tolist()) for column in columns
    )
    return LawMargins(
        speed=tuple(speeds.tolist()),
        delay_s=tuple(loop.plant.dt * delay for delay in delays),
        gain_low=lows,
        gain_high=highs,
        noise_lateral_m=lateral,
        noise_steering=steering,
    )


def linearised(
    loop: Loop, speed: Array, sharpest: Array, turn: Float[Array, " axis"]
) -> Linearisation:
    """Linearise plant and law at a steady turn, by differences.

    A plant with hidden states is linearised where the closed loop settles. The law
    reads none of them.

    Args:
        loop: of the policy.
        speed: v_ref [m/s].
        sharpest: largest κ [1/m].
        turn: share of the largest κ, and e.
    """
    env = turn[1:]
    curvature = turn[0] * sharpest
    road = jnp.stack([curvature, speed])
    steady = loop.law.turn(curvature, speed, env)
    hidden = loop.plant.hidden
    xi = jnp.pad(steady.state, (0, hidden))
    gain = jnp.pad(steady.gain, ((0, 0), (0, hidden)))
    nothing = jnp.zeros(2)

    def advance(turn: Array) -> Array:
        before, nu = jnp.split(turn, [xi.shape[0]])
        inputs = jnp.concatenate([nu, road])
        return loop.plant.step(without_pose(before), inputs, env)[BODY]

    if hidden:
        # A steady turn says nothing of them.
        xi = jax.lax.fori_loop(
            0, SETTLING, lambda _, now: advance(jnp.append(now, nothing)), xi
        )
        # Beside the path the actuators may be at their limits, where all is stable.
        held = jnp.abs(xi[LATERAL]) <= HELD * loop.plant.wheelbase
        xi = jnp.where(held, xi, jnp.nan)
    # Of the closed loop, whose inputs are ν: A − B K and B.
    _, slopes = by_differences(advance, jnp.concatenate([xi, nothing]))
    closed, B = jnp.split(slopes, [xi.shape[0]], axis=1)
    return Linearisation(closed + B @ gain, B, gain)


def rate(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return ‖Mᴺ‖^(1/N) for N = 2¹⁰, which is at least the spectral radius."""

    def square(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        power, logarithm = carry
        size = jnp.linalg.norm(power)
        scaled = power / size
        return scaled @ scaled, 2.0 * (logarithm + jnp.log(size))

    start = (matrix, jnp.zeros(()))
    power, logarithm = jax.lax.fori_loop(0, SQUARINGS, square, start)
    return jnp.exp((logarithm + jnp.log(jnp.linalg.norm(power))) / 2.0**SQUARINGS)


def late_matrix(
    loop: Linearisation, whole: Array, part: Array
) -> Float[Array, "both both"]:
    """Return the matrix of the loop whose commands act whole + part periods late.

    Its state is ξ and the last commands; between two periods a command acts in part of
    each, as in `latency.CommandDelay`.
    """
    size, inputs = loop.B.shape
    count = LONGEST + 1
    age = jnp.arange(count + 1)
    shares = jnp.where(age == whole, 1.0 - part, jnp.where(age == whole + 1, part, 0.0))
    now = loop.A - shares[0] * loop.B @ loop.K
    earlier = jnp.concatenate([share * loop.B for share in shares[1:]], axis=1)
    shift = jnp.eye(inputs * count, k=-inputs)
    sent = jnp.concatenate([-loop.K, jnp.zeros((inputs * (count - 1), size))])
    return jnp.block([[now, earlier], [sent, shift]])


def delay_margin(loop: Linearisation) -> Float[Array, ""]:
    """Return the largest delay up to which the loop is stable [periods].

    It is at most `LONGEST`, and 0 for a loop that is unstable without a delay.
    """

    def is_stable(number: Array) -> Array:
        whole = number // PARTS
        part = (number % PARTS) / PARTS
        return rate(late_matrix(loop, whole, part)) < 1.0

    numbers = jnp.arange(PARTS * LONGEST + 1)
    stable = jax.lax.map(is_stable, numbers)
    # Up to the first delay that is not stable.
    upto = jnp.cumprod(stable.astype(jnp.int32))
    return jnp.maximum(jnp.sum(upto) - 1, 0) / PARTS


def gain_margin(loop: Linearisation) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the factors of the gains between which the loop is stable."""

    def is_stable(factor: Array) -> Array:
        return rate(loop.A - factor * loop.B @ loop.K) < 1.0

    lower = jnp.asarray(FACTORS[::-1])
    stable_below = jnp.cumprod(jax.lax.map(is_stable, lower).astype(jnp.int32))
    stable_above = jnp.cumprod(jax.lax.map(is_stable, 1.0 / lower).astype(jnp.int32))
    lowest = jnp.min(jnp.where(stable_below == 1, lower, 1.0))
    highest = jnp.max(jnp.where(stable_above == 1, 1.0 / lower, 1.0))
    return lowest, highest


def noise_of(
    spread: Float[Array, " coordinate"], loop: Linearisation
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the standard deviations of e_y [m] and steering [rad] by sensor noise.

    S = (A − B K) S (A − B K)ᵀ + B K N Kᵀ Bᵀ,   steering: K (S + N) Kᵀ
    """
    noise = jnp.diag(spread**2)
    closed = loop.A - loop.B @ loop.K
    added = loop.B @ loop.K @ noise @ loop.K.T @ loop.B.T

    def double(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        power, total = carry
        return power @ power, total + power @ total @ power.T

    _, covariance = jax.lax.fori_loop(0, SQUARINGS, double, (closed, added))
    steering = loop.K[0] @ (covariance + noise) @ loop.K[0]
    return jnp.sqrt(covariance[LATERAL, LATERAL]), jnp.sqrt(steering)
