"""A predictive safety filter around any path-tracking controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.wrappers._nominal_copy import (
    Box,
    CopyState,
    Limits,
    Validity,
    as_box,
    initial_copy,
    update_copy,
)
from sfkd_jax.control.wrappers._safety_filter import safety_filter
from sfkd_jax.types import (
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


class ShieldState(NamedTuple):
    """What the filter carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        copy: the nominal copy of the vehicle.
        interventions: number of steps so far at which a request was reduced.
        broken_steps: number of steps so far at which the copy was too far from the
            measurement.
    """

    inner: Any
    copy: CopyState
    interventions: Int[Array, ""]
    broken_steps: Int[Array, ""]


class _Settings(NamedTuple):
    """Settings of `shielded` as its functions need them."""

    controller: Controller
    model: Model
    law: PathLaw
    valid: Validity
    control: Box
    limit: Control
    width: float
    tube: float
    environments: int
    initial_copy: Callable[[], CopyState]


def shielded(
    controller: Controller,
    model: Model,
    law: PathLaw,
    *,
    width: float,
    tube: float,
    control_low: Limits,
    control_high: Limits,
    horizon: int = 20,
    limit: Limits | None = None,
    noise_allowance: float = 0.0,
    reanchor: bool = True,
    env_low: Limits | None = None,
    env_high: Limits | None = None,
    state_low: Limits | None = None,
    state_high: Limits | None = None,
    preview_low: Limits | None = None,
    preview_high: Limits | None = None,
) -> Controller:
    """Wrap a controller with a filter that keeps a nominal copy in its corridor.

        ν = u − law(ξ; κ_0, v_0, e),   ν' = safety_filter(ν)
        u' = clip(law(ξ; κ_0, v_0, e) + ν'),   ẑ⁺ = F(ẑ; (ν', κ_0, v_0), e)
        |ê_y| ≤ width,   |e_y| ≤ width + tube

    The copy ẑ is the model driven with the vehicle's own inputs, without correction.
    `tube` is a certified bound of |e_y − ê_y|; `safety_filter` chooses ν'. A control
    whose request passes unchanged is returned bit for bit. Slew limits of the actuators
    are not considered.

    - Observation or reference not finite: ξ is that of the copy (`dead_reckoning`). The
      certificate does not apply, since the loop is not closed around the vehicle.
      Without a reference the last preview moves on. Environment not finite: the last
      finite one is used.
    - Before the first step at which all three were finite there is no copy. The control
      of the wrapped controller passes, clipped, or 0 if it is not finite.
    - ξ, κ_0, v_0 or e outside its box, or ξ beyond `path_frame.is_valid`: `void`. The
      certificate does not apply, and the law drives alone; e is clipped to its box.
    - |e_y − ê_y| > tube + noise_allowance: `broken`. The bound does not hold for this
      vehicle.

    Args:
        controller: any controller whose control is u in the world.
        model: of the closed loop, with `along_path`.
        law: around which the model was learned.
        width: of the nominal corridor to each side [m].
        tube: bound of |e_y − ê_y| [m].
        control_low: lower limits of u.
        control_high: upper limits of u.
        horizon: number of steps over which the law alone is predicted; beyond the
            reference, its last curvature and speed are used.
        limit: largest |ν|; `law.perturbation` if None.
        noise_allowance: error of a measured e_y that is added to the tube [m].
        reanchor: move the copy to the measurement when `broken`.
        env_low: lower end of the box of e; None: no limit.
        env_high: upper end of the box of e; None: no limit.
        state_low: lower end of the box of ξ; None: no limit.
        state_high: upper end of the box of ξ; None: no limit.
        preview_low: lower end of the box of (κ, v_ref); None: no limit.
        preview_high: upper end of the box of (κ, v_ref); None: no limit.

    Returns:
        A `Controller`; `info` gains `margin` [m], `intervention` (1 − s, of the request
        clipped to `limit`; 0 if it passed, 1 if `void` or steered back), `perturbation`
        ν', `copy` (its ξ), `copy_distance` |e_y − ê_y| [m] (NaN without comparison),
        `corridor` = width + tube [m], `feasible`, `broken`, `void`, `dead_reckoning`,
        `request_finite`, `env_inside`, `interventions`, `broken_steps`, and
        `shield_healthy`: feasible, and the certificate applies at this step.

    Raises:
        ValueError: the model is not in path coordinates, or a setting is out of range.

    Source: Wabersich and Zeilinger (2021), Automatica 129, 109597.
    """
    _check(model, width, tube, horizon, noise_allowance)
    environments, coordinates = law.low.shape[0] - 2, law.gain.shape[-1]
    if limit is None:
        largest = law.perturbation
    else:
        _, largest = as_box("limit", tuple(-entry for entry in limit), limit, 2)
    settings = _Settings(
        controller=controller,
        model=model,
        law=law,
        valid=Validity(
            env=as_box("env", env_low, env_high, environments),
            state=as_box("state", state_low, state_high, coordinates),
            preview=as_box("preview", preview_low, preview_high, 2),
            distance=tube + noise_allowance,
            reanchor=reanchor,
        ),
        control=as_box("control", control_low, control_high, 2),
        limit=largest,
        width=width,
        tube=tube,
        environments=environments,
        initial_copy=initial_copy(model, environments, coordinates, horizon),
    )
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> ShieldState:
    """The state before the first control step."""
    zero = jnp.zeros((), dtype=jnp.int32)
    inner = settings.controller.init(key)
    return ShieldState(inner, settings.initial_copy(), zero, zero)


def _act(
    settings: _Settings,
    params: Params,
    state: ShieldState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, ShieldState, ControllerInfo]:
    """One control step."""
    model, (low, high) = settings.model, settings.control
    if env.shape != (settings.environments,):
        raise ValueError(
            f"env must have shape ({settings.environments},), got {env.shape}"
        )
    planned, inner, info = settings.controller.act(
        params, state.inner, observation, env, reference
    )
    measured = (observation, env, reference)
    now = update_copy(model, settings.law, settings.valid, params, state.copy, measured)

    finite = all_finite(planned)
    planned = jnp.clip(jnp.where(finite, planned, 0.0), low, high)
    request = jnp.where(finite, _request(planned, now.law_control, low, high), 0.0)
    limit = jnp.where(now.void, 0.0, settings.limit)
    copy = now.state
    chosen = safety_filter(
        model,
        now.fiber,
        copy.latent,
        request,
        copy.preview,
        limit,
        width=settings.width,
    )
    unchanged = finite & jnp.all(chosen.nu == request)
    filtered = jnp.clip(now.law_control + chosen.nu, low, high)
    control = jnp.where(now.applicable & ~unchanged, filtered, planned)
    cut = jnp.where(now.void, 1.0, 1.0 - chosen.scale)
    cut = jnp.where(copy.started & jnp.any(chosen.nu != request), cut, 0.0)

    after = ShieldState(
        inner=inner,
        copy=copy.advanced(chosen.latent),
        interventions=state.interventions + (cut > 0.0),
        broken_steps=state.broken_steps + now.broken,
    )
    feasible = copy.started & chosen.feasible
    invalid = now.broken | now.void | now.dead_reckoning | ~now.env_inside
    report: ControllerInfo = {
        **info,
        "copy": now.copy,
        "copy_distance": now.copy_distance,
        "broken": now.broken,
        "void": now.void,
        "dead_reckoning": now.dead_reckoning,
        "env_inside": now.env_inside,
        "margin": jnp.where(copy.started, chosen.margin, jnp.nan),
        "intervention": cut,
        "perturbation": chosen.nu,
        "corridor": jnp.asarray(settings.width + settings.tube, dtype=float),
        "feasible": feasible,
        "request_finite": finite,
        "interventions": after.interventions,
        "broken_steps": after.broken_steps,
        "shield_healthy": feasible & ~invalid,
    }
    return control, after, report


def _request(
    planned: Control, law_control: Control, low: Control, high: Control
) -> Control:
    """The smallest ν with clip(law + ν) = u: 0 where both reach the same limit."""
    above = (planned >= high) & (law_control >= high)
    below = (planned <= low) & (law_control <= low)
    return jnp.where(above | below, 0.0, planned - law_control)


def _check(
    model: Model, width: float, tube: float, horizon: int, allowance: float
) -> None:
    """Raise a ValueError that names a setting out of its range."""
    if not model.along_path:
        raise ValueError("shielded needs a model in path coordinates: model.frame=path")
    for name, value in (("width", width), ("tube", tube)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be positive and finite [m], got {value}")
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1 step, got {horizon}")
    if not (math.isfinite(allowance) and allowance >= 0.0):
        raise ValueError(
            f"noise_allowance must be finite and not negative [m], got {allowance}"
        )
