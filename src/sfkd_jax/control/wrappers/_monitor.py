"""A run-time monitor: whether a drive stays where a certificate speaks, and what is done when it does not."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.core.rollouts import step_disturbances
from sfkd_jax.core.se2 import between, compose, wrap_angle
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Controller,
    Environment,
    Key,
    Model,
    Params,
    Reference,
    State,
)

FALLBACKS = ("none", "hold", "slow")


class MonitorState(NamedTuple):
    """What the monitor carries from one control step to the next.

    Attributes:
        inner: state of the controller that is watched.
        observation, env: at the last clean step; NaN before the first one.
        control: applied last.
        primed: whether the step before was clean, so that there is something to compare
            with.
        breaches, box_exits: steps so far with one.
        remaining: steps that the fallback still lasts.
        held: steps in a row that the last plan was held.
    """

    inner: Any
    observation: State
    env: Environment
    control: Control
    primed: Bool[Array, ""]
    breaches: Int[Array, ""]
    box_exits: Int[Array, ""]
    remaining: Int[Array, ""]
    held: Int[Array, ""]


def monitored(
    controller: Controller,
    model: Model,
    *,
    bounds: tuple[float, ...],
    state_low: tuple[float, ...],
    state_high: tuple[float, ...],
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    fallback: str = "none",
    slow_factor: float = 0.7,
    release: int = 10,
) -> Controller:
    """The same controller, watched: every step is held against the bounds and boxes of a certificate.

        d_k = Φ(x_k, e_k) − T(e_{k−1} → e_k) F(Φ(x_{k−1}, e_{k−1}), u_{k−1}, e_{k−1})
        breach ⇔ not every kind of |d_k| ≤ its bound,   box exit ⇔ (s_k, u_{k−1}, e_k) outside its box

    Two clean steps in a row (observation and environment finite) are needed to compare;
    without them there is no evidence of a breach. NaN lies outside every box. The first
    step has no u_{k−1}, but s_0 and e_0 are checked.

    A fallback is in force at the step of a breach or box exit and ends `release` steps after the last one:
        "none": report only.
        "hold": continue the last plan open loop; for controllers that do so when the observation is NaN, as `mppi`
            does. Before the first clean step there is no plan, and nothing is changed. Held for as many steps as the
            reference has, a plan has ended: from then on the controller plans from what it sees, until `release` steps
            have passed without a flag. A car that left its box while nothing was planned could not come back else.
        "slow": follow the same path at `slow_factor` times its speed.

    Args:
        controller: any whose `info` is a dict.
        model: the one that the bounds were measured for.
        bounds: on latent [-], position [m], yaw [rad], body state, see
            `step_disturbances`; sensor noise included.
        state_low, state_high: of the body state. control_low, control_high.
        env_low, env_high: of E.
        fallback: see above.
        slow_factor: in (0, 1].
        release: at least 1 step.

    Returns:
        A `Controller`; `info` gains `breach`, `box_exit`, `breaches`, `box_exits`,
        `fallback_active` and `disturbance` (4,), which is NaN where there is nothing to
        compare.

    Raises:
        ValueError: unknown fallback, or bounds, boxes or settings that cannot be meant.
    """
    boxes = ((state_low, state_high), (control_low, control_high), (env_low, env_high))
    _check(bounds, boxes, fallback, slow_factor, release)
    limits = jnp.asarray(bounds)
    low, high = (
        jnp.concatenate([jnp.asarray(box[side], dtype=float) for box in boxes])
        for side in (0, 1)
    )

    def init(key: Key) -> MonitorState:
        unseen = partial(jnp.full, fill_value=jnp.nan, dtype=float)
        # The first step must not be blamed for a control that nobody applied: any one
        # inside its box will do.
        control = jnp.clip(
            jnp.zeros(len(control_low)),
            jnp.asarray(control_low),
            jnp.asarray(control_high),
        )
        none, nothing = jnp.zeros((), dtype=jnp.int32), jnp.asarray(False)
        return MonitorState(
            inner=controller.init(key),
            observation=unseen(3 + len(state_low)),
            env=unseen(len(env_low)),
            control=control,
            primed=nothing,
            breaches=none,
            box_exits=none,
            remaining=none,
            held=none,
        )

    def act(
        params: Params,
        state: MonitorState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, MonitorState, dict[str, Array]]:
        clean = jnp.isfinite(observation).all() & jnp.isfinite(env).all()
        pair = state.primed & clean
        disturbance = jnp.where(
            pair, disturbances(params, state, observation, env), jnp.nan
        )
        # Not "any above": a prediction that is not finite, made from clean
        # measurements, is a breach as well.
        breach = pair & ~jnp.all(disturbance <= limits)
        point = jnp.concatenate([observation[BODY], state.control, env])
        box_exit = ~(clean & jnp.all((low <= point) & (point <= high)))

        remaining = jnp.where(
            breach | box_exit, release, jnp.maximum(state.remaining - 1, 0)
        )
        planned = jnp.isfinite(state.observation).all() & (
            state.held < reference.shape[0]
        )
        active = (remaining > 0) & {"none": False, "hold": planned, "slow": True}[
            fallback
        ]
        seen, wanted = fall_back(active, observation, reference)
        control, inner, info = controller.act(params, state.inner, seen, env, wanted)

        after = MonitorState(
            inner=inner,
            observation=jnp.where(clean, observation, state.observation),
            env=jnp.where(clean, env, state.env),
            control=control,
            primed=clean & jnp.isfinite(control).all(),
            breaches=state.breaches + breach,
            box_exits=state.box_exits + box_exit,
            remaining=remaining,
            held=jnp.where(remaining > 0, state.held + active, 0),
        )
        report = {
            "breach": breach,
            "box_exit": box_exit,
            "disturbance": disturbance,
            "fallback_active": active,
        }
        return (
            control,
            after,
            info | report | {"breaches": after.breaches, "box_exits": after.box_exits},
        )

    def disturbances(
        params: Params, last: MonitorState, observation: State, env: Environment
    ) -> Float[Array, " 4"]:
        """Of the step that led here; fibres are evaluated again, so that the state holds no network."""
        fiber, fiber_next = model.fiber(params, last.env), model.fiber(params, env)
        origin = model.encode(fiber, last.observation)
        return step_disturbances(
            model,
            fiber,
            fiber_next,
            origin,
            last.observation,
            last.control,
            observation,
        )

    def fall_back(
        active: Bool[Array, ""], observation: State, reference: Reference
    ) -> tuple[State, Reference]:
        """What the watched controller is shown."""
        if fallback == "hold":
            # A plan made from measurements that the model cannot explain is no better
            # than the one made before, so the controller is told that it sees nothing:
            # it shifts its last clean plan by itself.
            observation = jnp.where(active, jnp.nan, observation)
        if fallback == "slow":
            reference = jnp.where(active, _slowed(reference, slow_factor), reference)
        return observation, reference

    return Controller(init, act)


def _slowed(reference: Reference, factor: float) -> Reference:
    """The same path at a lower speed, linear between its points: g'(t) = g(c t), v'(t) = c v(c t)."""
    horizon = reference.shape[0]
    # reference[0] is wanted one step from now. What is wanted now lies one step back
    # along the circle through the first two poses; where the vehicle stands instead
    # would draw its error into the path.
    now = compose(reference[0, POSE], between(reference[1, POSE], reference[0, POSE]))
    points = jnp.concatenate([jnp.append(now, reference[0, 3])[None], reference])
    times = factor * jnp.arange(1, horizon + 1)
    index = jnp.minimum(jnp.floor(times).astype(int), horizon - 1)
    start, step = points[index], points[index + 1] - points[index]
    step = step.at[:, 2].set(wrap_angle(step[:, 2]))
    return (start + (times - index)[:, None] * step).at[:, 3].multiply(factor)


def _check(
    bounds: tuple[float, ...],
    boxes: tuple[Any, ...],
    fallback: str,
    slow_factor: float,
    release: int,
) -> None:
    """Refuse settings that cannot be meant, naming them."""
    if fallback not in FALLBACKS:
        raise ValueError(
            f"fallback must be one of {', '.join(FALLBACKS)}, got {fallback!r}"
        )
    if len(bounds) != 4 or not all(
        math.isfinite(bound) and bound > 0 for bound in bounds
    ):
        raise ValueError(
            f"bounds must be 4 positive finite numbers (latent, position, yaw, body), got {bounds}"
        )
    for name, (low, high) in zip(("state", "control", "env"), boxes, strict=True):
        if len(low) != len(high) or not all(
            a <= b for a, b in zip(low, high, strict=True)
        ):
            raise ValueError(
                f"{name}_low must lie below {name}_high, entry by entry, got {low} and {high}"
            )
    if not 0 < slow_factor <= 1 or release < 1:
        raise ValueError(
            f"slow_factor must lie in (0, 1] and release be at least 1, got {slow_factor} and {release}"
        )
