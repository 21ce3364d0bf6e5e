"""A run-time monitor: detect when a certificate does not apply, and fall back."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.wrappers._slow import slow_down
from sfkd_jax.ranges import PositiveFraction
from sfkd_jax.rollout import step_disturbances
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    ControllerInfo,
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
        inner: state of the wrapped controller.
        observation: of the last clean step; NaN before the first one.
        env: of the last clean step; NaN before the first one.
        control: applied last.
        previous_clean: whether the previous step was clean, so that it can be compared.
        breaches: number of steps so far with a breach.
        box_exits: number of steps so far with a box exit.
        remaining: number of steps for which the fallback stays active.
        held: number of consecutive steps for which the last plan was held.
    """

    inner: Any
    observation: State
    env: Environment
    control: Control
    previous_clean: Bool[Array, ""]
    breaches: Int[Array, ""]
    box_exits: Int[Array, ""]
    remaining: Int[Array, ""]
    held: Int[Array, ""]


class _Settings(NamedTuple):
    """Settings of `monitored` as its functions need them."""

    controller: Controller
    model: Model
    bounds: Float[Array, " 4"]
    low: Float[Array, " entry"]
    high: Float[Array, " entry"]
    initial_control: Control
    states: int
    environments: int
    fallback: str
    slow_factor: float
    release: int


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
    slow_factor: PositiveFraction = 0.7,
    release: int = 10,
) -> Controller:
    """Wrap a controller with a monitor of the bounds and boxes of a certificate.

        d_k = Φ(x_k, e_k) − T(e_{k−1} → e_k) F(Φ(x_{k−1}, e_{k−1}), u_{k−1}, e_{k−1})
        breach ⇔ not all kinds of |d_k| ≤ their bounds
        box exit ⇔ (s_k, u_{k−1}, e_k) outside its box

    A step is clean if observation and environment are finite. A breach needs two clean
    steps in a row. NaN lies outside every box. The first step has no u_{k−1}, but its
    s_0 and e_0 are checked.

    The fallback becomes active at the step of a breach or box exit and ends `release`
    steps after the last one:
        "none": report only.
        "hold": continue the last plan open loop. The controller must do so when the
            observation is NaN, as all planners do. Before the first clean step there is
            no plan, and nothing is changed. After as many steps as the reference has,
            the plan has ended, and the controller plans from its observations until
            `release` steps have passed without a flag. Otherwise a vehicle that left
            its box could not come back.
        "slow": follow the same path at `slow_factor` times its speed.

    Args:
        controller: any controller.
        model: the one that the bounds were measured for.
        bounds: on latent [-], position [m], yaw [rad] and body state, see
            `step_disturbances`; sensor noise included.
        state_low: lower end of the box of the body state.
        state_high: upper end of the box of the body state.
        control_low: lower end of the box of the control.
        control_high: upper end of the box of the control.
        env_low: lower end of the box of the environment.
        env_high: upper end of the box of the environment.
        fallback: see above.
        slow_factor: in (0, 1].
        release: at least 1 step.

    Returns:
        A `Controller`; `info` gains `breach`, `box_exit`, `breaches`, `box_exits`,
        `fallback_active` and `disturbance` (4,), which is NaN without comparison.

    Raises:
        ValueError: the fallback is unknown, or bounds, boxes or settings are out of
            range.
    """
    boxes = ((state_low, state_high), (control_low, control_high), (env_low, env_high))
    _check(bounds, boxes, fallback, slow_factor, release)
    low, high = (
        jnp.concatenate([jnp.asarray(box[side], dtype=float) for box in boxes])
        for side in (0, 1)
    )
    settings = _Settings(
        controller=controller,
        model=model,
        bounds=jnp.asarray(bounds),
        low=low,
        high=high,
        # No control was applied before the first step: any control in the box will do.
        initial_control=jnp.clip(
            jnp.zeros(len(control_low)),
            jnp.asarray(control_low),
            jnp.asarray(control_high),
        ),
        states=3 + len(state_low),
        environments=len(env_low),
        fallback=fallback,
        slow_factor=slow_factor,
        release=release,
    )
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> MonitorState:
    """The state before the first control step."""
    zero = jnp.zeros((), dtype=jnp.int32)
    return MonitorState(
        inner=settings.controller.init(key),
        observation=jnp.full(settings.states, jnp.nan, dtype=float),
        env=jnp.full(settings.environments, jnp.nan, dtype=float),
        control=settings.initial_control,
        previous_clean=jnp.asarray(False),
        breaches=zero,
        box_exits=zero,
        remaining=zero,
        held=zero,
    )


def _act(
    settings: _Settings,
    params: Params,
    state: MonitorState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, MonitorState, ControllerInfo]:
    """One control step."""
    clean = jnp.isfinite(observation).all() & jnp.isfinite(env).all()
    compared = state.previous_clean & clean
    disturbance = _disturbance(settings.model, params, state, observation, env)
    disturbance = jnp.where(compared, disturbance, jnp.nan)
    # Not "any above": a prediction from clean measurements that is not finite is a
    # breach as well.
    breach = compared & ~jnp.all(disturbance <= settings.bounds)
    point = jnp.concatenate([observation[BODY], state.control, env])
    inside = jnp.all((settings.low <= point) & (point <= settings.high))
    box_exit = ~(clean & inside)

    counted = jnp.maximum(state.remaining - 1, 0)
    remaining = jnp.where(breach | box_exit, settings.release, counted)
    has_plan = jnp.isfinite(state.observation).all() & (state.held < reference.shape[0])
    applies = {"none": False, "hold": has_plan, "slow": True}[settings.fallback]
    active = (remaining > 0) & applies
    inputs = _fall_back(settings, active, observation, reference)
    control, inner, info = settings.controller.act(
        params, state.inner, inputs[0], env, inputs[1]
    )

    after = MonitorState(
        inner=inner,
        observation=jnp.where(clean, observation, state.observation),
        env=jnp.where(clean, env, state.env),
        control=control,
        previous_clean=clean & jnp.isfinite(control).all(),
        breaches=state.breaches + breach,
        box_exits=state.box_exits + box_exit,
        remaining=remaining,
        held=jnp.where(remaining > 0, state.held + active, 0),
    )
    report: ControllerInfo = {
        **info,
        "breach": breach,
        "box_exit": box_exit,
        "disturbance": disturbance,
        "fallback_active": active,
        "breaches": after.breaches,
        "box_exits": after.box_exits,
    }
    return control, after, report


def _disturbance(
    model: Model,
    params: Params,
    last: MonitorState,
    observation: State,
    env: Environment,
) -> Float[Array, " 4"]:
    """Disturbance of the last step.

    Both fibres are evaluated again, so that the state does not hold a network.
    """
    fiber, fiber_next = model.fiber(params, last.env), model.fiber(params, env)
    origin = model.encode(fiber, last.observation)
    return step_disturbances(
        model, fiber, fiber_next, origin, last.observation, last.control, observation
    )


def _fall_back(
    settings: _Settings,
    active: Bool[Array, ""],
    observation: State,
    reference: Reference,
) -> tuple[State, Reference]:
    """Observation and reference for the wrapped controller."""
    if settings.fallback == "hold":
        # A plan from measurements that the model cannot explain is no better than the
        # plan before. An observation of NaN makes the controller continue that plan.
        observation = jnp.where(active, jnp.nan, observation)
    if settings.fallback == "slow":
        slowed = slow_down(reference, settings.slow_factor)
        reference = jnp.where(active, slowed, reference)
    return observation, reference


def _check(
    bounds: tuple[float, ...],
    boxes: tuple[Any, ...],
    fallback: str,
    slow_factor: float,
    release: int,
) -> None:
    """Raise a ValueError that names a setting out of its range."""
    if fallback not in FALLBACKS:
        raise ValueError(
            f"fallback must be one of {', '.join(FALLBACKS)}, got {fallback!r}"
        )
    if len(bounds) != 4 or not all(
        math.isfinite(bound) and bound > 0 for bound in bounds
    ):
        raise ValueError(
            "bounds must be 4 positive finite numbers (latent, position, yaw, body), "
            f"got {bounds}"
        )
    for name, (low, high) in zip(("state", "control", "env"), boxes, strict=True):
        if len(low) != len(high) or not all(
            a <= b for a, b in zip(low, high, strict=True)
        ):
            raise ValueError(
                f"{name}_low must lie below {name}_high, entry by entry, "
                f"got {low} and {high}"
            )
    if not 0 < slow_factor <= 1 or release < 1:
        raise ValueError(
            "slow_factor must lie in (0, 1] and release be at least 1, "
            f"got {slow_factor} and {release}"
        )
