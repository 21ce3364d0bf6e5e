"""A predictive safety filter around any controller along a path; the law is its backup."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.wrappers._nominal_copy import (
    CopyState,
    Limits,
    Validity,
    as_box,
    blank_copy,
    locate,
)
from sfkd_jax.control.wrappers._safety_filter import safety_filter
from sfkd_jax.types import (
    Control,
    Controller,
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
        inner: state of the controller that is filtered.
        copy: the nominal copy of the car.
        interventions: steps so far at which a request was cut.
        broken_steps: steps so far at which the copy was too far from the measurement.
    """

    inner: Any
    copy: CopyState
    interventions: Int[Array, ""]
    broken_steps: Int[Array, ""]


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
    """The same controller, filtered: a nominal copy of the car never leaves its corridor.

        ν = u − law(ξ; κ_0, v_0, e),   ν' = admit(ν),   u' = clip(law(ξ; κ_0, v_0, e) + ν'),
        ẑ⁺ = F(ẑ; (ν', κ_0, v_0), e),   |ê_y| ≤ width,   |e_y| ≤ width + tube

    The copy ẑ is the model driven with the car's own inputs and never corrected. `tube`
    is a certified bound of |e_y − ê_y|; see `admit` for what is let through. A control
    whose request passes whole is returned as it came. Slew limits of the actuators are
    not known here. Source: Wabersich and Zeilinger, Automatica 129 (2021) 109597.

    - Observation or reference not finite: ξ is that of the copy (`dead_reckoning`), and the
      certificate does not speak, since the law is not closed around the car; without a
      reference the last preview moves on. Environment not finite: the last finite one.
    - Before the first step at which all three were finite there is no copy: the controller's
      control passes, clipped, or 0 if it is not finite.
    - ξ, κ_0, v_0 or e outside its box, or ξ beyond `path_frame.is_valid`: `void`, the
      certificate says nothing, and the law drives alone; e is clipped to its box.
    - |e_y − ê_y| > tube + noise_allowance: `broken`, the bound does not hold on this car.

    Args:
        controller: any whose control is u in the world and whose `info` is a dict.
        model: of the closed loop, `along_path`.
        law: around which the model was learned.
        width: of the nominal corridor to each side [m].
        tube: bound of |e_y − ê_y| [m].
        control_low: of u.
        control_high: of u.
        horizon: steps that the law alone is followed ahead; beyond the reference its
            last curvature and speed are held.
        limit: largest |ν|; `law.perturbation` if None.
        noise_allowance: error of a measured e_y that is not held against the tube [m].
        reanchor: put the copy at the measurement when `broken`.
        env_low, env_high: box of e.
        state_low, state_high: box of ξ.
        preview_low, preview_high: box of (κ, v_ref). None: no limit.

    Returns:
        A `Controller`; `info` gains `margin` [m], `intervention` (1 − s, of the request
        clipped to `limit`; 0 if it passed, 1 if `void` or steered back), `perturbation`
        ν', `copy` (its ξ), `copy_distance` |e_y − ê_y| [m] (NaN where there is nothing
        to compare), `corridor` = width + tube [m], `feasible`, `broken`, `void`,
        `dead_reckoning`, `request_finite`, `env_inside`, `interventions`,
        `broken_steps`, and `shield_healthy`: feasible, and nothing at this step speaks
        against the corridor.

    Raises:
        ValueError: a model of another frame, or settings or limits that cannot be
            meant.
    """
    _check(model, width, tube, horizon, noise_allowance)
    environments, coordinates = law.low.shape[0] - 2, law.gain.shape[-1]
    low, high = as_box("control", control_low, control_high, 2)
    valid = Validity(
        env=as_box("env", env_low, env_high, environments),
        state=as_box("state", state_low, state_high, coordinates),
        preview=as_box("preview", preview_low, preview_high, 2),
        distance=tube + noise_allowance,
        reanchor=reanchor,
    )
    if limit is None:
        largest = law.perturbation
    else:
        _, largest = as_box("limit", tuple(-entry for entry in limit), limit, 2)
    blank = blank_copy(model, environments, coordinates, horizon)

    def init(key: Key) -> ShieldState:
        none = jnp.zeros((), dtype=jnp.int32)
        return ShieldState(controller.init(key), blank(), none, none)

    def act(
        params: Params,
        state: ShieldState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, ShieldState, dict[str, Array]]:
        if env.shape != (environments,):
            raise ValueError(f"env must have shape ({environments},), got {env.shape}")
        planned, inner, info = controller.act(
            params, state.inner, observation, env, reference
        )
        seen = (observation, env, reference)
        now, flags = locate(model, law, valid, params, state.copy, seen)

        finite = all_finite(planned)
        planned = jnp.clip(jnp.where(finite, planned, 0.0), low, high)
        request = jnp.where(finite, _request(planned, now.lawful, low, high), 0.0)
        bound = jnp.where(now.void, 0.0, largest)
        running = now.state
        chosen = safety_filter(
            model, now.fiber, running.latent, request, running.ahead, bound, width=width
        )
        untouched = finite & jnp.all(chosen.nu == request)
        filtered = jnp.clip(now.lawful + chosen.nu, low, high)
        control = jnp.where(now.applicable & ~untouched, filtered, planned)
        cut = jnp.where(now.void, 1.0, 1.0 - chosen.share)
        cut = jnp.where(running.started & jnp.any(chosen.nu != request), cut, 0.0)

        after = ShieldState(
            inner=inner,
            copy=running.stepped(chosen.latent),
            interventions=state.interventions + (cut > 0.0),
            broken_steps=state.broken_steps + flags["broken"],
        )
        feasible = running.started & chosen.feasible
        doubts = (
            flags["broken"] | now.void | flags["dead_reckoning"] | ~flags["env_inside"]
        )
        report = {
            "margin": jnp.where(running.started, chosen.margin, jnp.nan),
            "intervention": cut,
            "perturbation": chosen.nu,
            "corridor": jnp.asarray(width + tube, dtype=float),
            "feasible": feasible,
            "request_finite": finite,
            "interventions": after.interventions,
            "broken_steps": after.broken_steps,
            "shield_healthy": feasible & ~doubts,
        }
        return control, after, info | flags | report

    return Controller(init, act)


def _request(planned: Control, lawful: Control, low: Control, high: Control) -> Control:
    """The smallest ν with clip(law + ν) = u: 0 where both are at or beyond one limit."""
    above = (planned >= high) & (lawful >= high)
    below = (planned <= low) & (lawful <= low)
    return jnp.where(above | below, 0.0, planned - lawful)


def _check(
    model: Model, width: float, tube: float, horizon: int, allowance: float
) -> None:
    """Refuse settings that cannot be meant, naming them."""
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
