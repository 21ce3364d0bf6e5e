"""A tube that is calibrated while driving, and the speed at which it fits the lane."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._along_path import curvature_ahead, path_coordinates
from sfkd_jax.control.wrappers._slow import slow_down
from sfkd_jax.geometry import LATERAL
from sfkd_jax.ranges import Fraction, Positive
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Params,
    Reference,
    Scalar,
    State,
)

RADIUS_RANGE = (1e-3, 1e2)
"""Least and largest radius [m]."""
GRIP_SHARE = 0.8
"""Share of the grip that a turn must ask for to prove it."""


class OnlineTubeState(NamedTuple):
    """What the calibration carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        plans: e_y that the last plans predicted, newest first [m].
        known: which of them were finite.
        radii: r_h of the tube [m].
        corridor_factor: of the reference speed, at which the corridor fits the lane.
        speed_factor: of the reference speed that is followed.
        grip: lateral acceleration at which the corridor fitted the lane [m/s²]; 0 if
            it is not limited.
    """

    inner: Any
    plans: Float[Array, "horizon horizon"]
    known: Bool[Array, " horizon"]
    radii: Float[Array, " horizon"]
    corridor_factor: Scalar
    speed_factor: Scalar
    grip: Scalar


class _Settings(NamedTuple):
    """Settings of `online_tube` as its functions need them."""

    controller: Controller
    horizon: int
    level: float
    rate: float
    start_radius: float
    lane: float | None
    slowest: float
    fall: float
    grip: float | None


def online_tube(
    controller: Controller,
    *,
    horizon: int,
    level: Fraction = 0.95,
    rate: Positive = 0.2,
    start_radius: Positive = 0.03,
    lane: Positive | None = 0.1,
    slowest: Positive = 8.0,
    fall: Fraction = 0.01,
    grip: Positive | None = None,
) -> Controller:
    """Wrap a controller with a tube around its plans, and slow down until it fits.

    For every h up to the horizon, the plan of h steps ago said where the car would be
    across the path now. Adaptive conformal inference on the scale of the radius:

        r_h ← r_h exp(γ (1{|e_y − ê_{y,h}| > r_h} − (1 − level)))

    so that in N steps, whatever happens, the share of misses differs from 1 − level by
    at most |log(r_N / r_0)| / (γ N). Nothing is assumed about the drive, and nothing is
    proved about a single step. Errors are those of the measured position.

    The online corridor is max_h |ê_{y,h}| + r_h. While it exceeds `lane`, the reference
    speed falls; otherwise it rises, so much slower that the speed settles where the
    corridor fits in a share `level` of the steps. Both are gentle: hard braking would
    take the grip that the tyres need to stay on the path.

    With a finite `grip`, a turn ahead is taken at a lateral acceleration at which the
    corridor has fitted before, whatever friction is measured. Nothing but a turn shows
    how much grip there is, and then it is too late to brake:

        c ≤ √(a / max_h v_h² |κ_h|)

    a rises while the corridor fits at 80 % of it, and falls while it does not.

    Args:
        controller: any planner of a path; its `info` has `predicted_states`.
        horizon: number of predicted steps.
        level: of the coverage.
        rate: γ.
        start_radius: r_h at the start [m].
        lane: largest |e_y| that is acceptable [m]; None for a tube that only reports.
        slowest: least speed that the corridor can ask for [m/s]: a model is of little
            use below the speeds that it was learned at.
        fall: of the factor per step, while the corridor exceeds the lane.
        grip: a at the start [m/s²]; None where friction is trusted.

    Returns:
        A `Controller`; `info` gains `tube` (horizon,) [m], `tube_errors` (horizon,) [m]
        (NaN without a plan to compare with), `tube_missed` (horizon,),
        `online_corridor` [m], `speed_factor` and `grip` [m/s²; 0 without limit].

    Raises:
        ValueError: a setting is out of its range.

    Source: Gibbs and Candès (2021), Adaptive Conformal Inference Under Distribution
    Shift.
    """
    _check(level, rate, start_radius, lane, slowest, grip)
    settings = _Settings(
        controller, horizon, level, rate, start_radius, lane, slowest, fall, grip
    )
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> OnlineTubeState:
    """The state before the first control step."""
    horizon = settings.horizon
    return OnlineTubeState(
        inner=settings.controller.init(key),
        plans=jnp.zeros((horizon, horizon), dtype=float),
        known=jnp.zeros(horizon, dtype=bool),
        radii=jnp.full(horizon, settings.start_radius, dtype=float),
        corridor_factor=jnp.ones(()),
        speed_factor=jnp.ones(()),
        grip=jnp.asarray(settings.grip or 0.0),
    )


def _act(
    settings: _Settings,
    params: Params,
    state: OnlineTubeState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, OnlineTubeState, ControllerInfo]:
    """One control step."""
    measured = path_coordinates(
        observation, reference[0], curvature_ahead(reference)[0]
    )
    errors = jnp.abs(measured[LATERAL] - jnp.diagonal(state.plans))
    errors = jnp.where(state.known, errors, jnp.nan)
    missed = errors > state.radii
    radii = _calibrated(settings, state.radii, errors)
    slowed = slow_down(reference, state.speed_factor)
    target = jnp.where(state.speed_factor < 1.0, slowed, reference)
    control, inner, info = settings.controller.act(
        params, state.inner, observation, env, target
    )
    plan = _lateral(info["predicted_states"], target)
    corridor = jnp.max(jnp.abs(plan) + radii)
    fits = corridor <= (math.inf if settings.lane is None else settings.lane)
    corridor_factor, grip, factor = _speeds(settings, state, reference, fits)
    after = OnlineTubeState(
        inner=inner,
        plans=jnp.concatenate([jnp.nan_to_num(plan)[None], state.plans[:-1]]),
        known=jnp.append(all_finite(plan), state.known[:-1]),
        radii=radii,
        corridor_factor=corridor_factor,
        speed_factor=factor,
        grip=grip,
    )
    report: ControllerInfo = {
        **info,
        "tube": radii,
        "tube_errors": errors,
        "tube_missed": missed,
        "online_corridor": corridor,
        "speed_factor": factor,
        "grip": grip,
    }
    return control, after, report


def _speeds(
    settings: _Settings,
    state: OnlineTubeState,
    reference: Reference,
    fits: Bool[Array, ""],
) -> tuple[Scalar, Scalar, Scalar]:
    """The next corridor_factor, grip and speed_factor."""
    rise = settings.fall * (1.0 - settings.level) / settings.level
    change = jnp.where(fits, rise, -settings.fall)
    least = jnp.clip(settings.slowest / reference[0, 3], 0.0, 1.0)
    least = jnp.where(jnp.isfinite(least), least, 0.0)
    corridor_factor = jnp.clip(state.corridor_factor + change, least, 1.0)

    before = state.speed_factor
    cap, grip = jnp.ones(()), state.grip
    if settings.grip is not None:
        cap, grip = _shown(settings, state, reference, fits)
    factor = jnp.minimum(corridor_factor, jnp.maximum(cap, least))
    factor = jnp.clip(factor, before - settings.fall, before + settings.fall)
    return corridor_factor, grip, factor


def _shown(
    settings: _Settings,
    state: OnlineTubeState,
    reference: Reference,
    fits: Bool[Array, ""],
) -> tuple[Scalar, Scalar]:
    """The speed_factor for which the grip was shown, and the next grip."""
    ahead = reference[:, 3] ** 2 * jnp.abs(curvature_ahead(reference))
    now = state.speed_factor**2 * ahead[0]
    proved = jnp.where(now > GRIP_SHARE * state.grip, 1.0 + settings.fall, 1.0)
    grip = state.grip * jnp.where(fits, proved, 1.0 - settings.fall)
    cap = jnp.sqrt(grip / jnp.maximum(jnp.max(ahead), 1e-6))
    return jnp.where(jnp.isfinite(cap), cap, 1.0), grip


def _calibrated(
    settings: _Settings,
    radii: Float[Array, " horizon"],
    errors: Float[Array, " horizon"],
) -> Float[Array, " horizon"]:
    """The radii after a comparison; unchanged where there was none."""
    missed = errors > radii
    change = settings.rate * (missed - (1.0 - settings.level))
    after = jnp.clip(radii * jnp.exp(change), *RADIUS_RANGE)
    return jnp.where(jnp.isfinite(errors), after, radii)


def _lateral(
    states: Float[Array, "horizon state"], reference: Reference
) -> Float[Array, " horizon"]:
    """e_y of predicted states; NaN for a plan that is not finite."""
    coordinates = jax.vmap(path_coordinates)(
        states, reference, curvature_ahead(reference)
    )
    lateral = coordinates[:, LATERAL]
    return jnp.where(all_finite(lateral), lateral, jnp.nan)


def _check(
    level: float,
    rate: float,
    start_radius: float,
    lane: float | None,
    slowest: float,
    grip: float | None,
) -> None:
    """Raise a ValueError that names a setting out of its range."""
    if not 0 < level < 1 or not 0 < rate < math.inf:
        raise ValueError(
            f"level must lie in (0, 1) and rate be positive, got {level} and {rate}"
        )
    if not RADIUS_RANGE[0] <= start_radius <= RADIUS_RANGE[1]:
        raise ValueError(
            f"start_radius must lie in {list(RADIUS_RANGE)}, got {start_radius}"
        )
    for name, value in (("lane", lane), ("grip", grip)):
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive or None, got {value}")
    if not 0 < slowest < math.inf:
        raise ValueError(f"slowest must be positive, got {slowest}")
