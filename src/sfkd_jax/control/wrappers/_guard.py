"""The guard of a planner along a path: nominal model, safety filter, and their flags.

Everything that decides whether the planner's control may pass is here. In one control
step (`Shield.act`) the measurement is compared with the nominal model
(`Shield._compare`), the request is filtered (`safety_filter`), and both are reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._planner import all_finite
from sfkd_jax.control.tasks._along_path import Preview
from sfkd_jax.geometry import LATERAL, PathState, is_valid, path_state
from sfkd_jax.ranges import AtLeastOne, NonNegative, Positive, check_intervals
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Fiber,
    Key,
    Latent,
    Model,
    Params,
    Scalar,
)

Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Lower and upper limits."""
FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Scales of a request that are tried, largest first; 0 is the law alone."""


class FilterResult(NamedTuple):
    """The outcome of `safety_filter`.

    Attributes:
        nu: the perturbation of the law to apply, (2,).
        latent: of the nominal model one step later.
        scale: s, of the request clipped to its limit; 0 while steering back.
        margin: width − max |ê_y| over the predicted steps [m]; −inf if not finite.
        feasible: whether the margin is at least 0.
    """

    nu: Control
    latent: Latent
    scale: Scalar
    margin: Scalar
    feasible: Bool[Array, ""]


def safety_filter(
    model: Model,
    fiber: Fiber,
    latent: Latent,
    request: Control,
    preview: Float[Array, "preview 2"],
    limit: Control,
    *,
    width: float,
) -> FilterResult:
    """Scale a request so that the law alone then keeps the nominal model inside.

        ẑ_1 = F(ẑ_0; (s ν, κ_0, v_0), e),   ẑ_{k+1} = F(ẑ_k; (0, κ_k, v_k), e)
        margin(s) = width − max_k |ê_y,k|
        s = the largest of `FILTER_SCALES` with margin(s) ≥ 0

    The environment is constant over the prediction. One scale applies to both
    channels, so the control lies between the law, which is the backup, and the
    request, at the planner's ratio of steering to drive. If no scale passes, the
    result is the best margin of the law alone and of the largest steering to either
    side, so the predicted deviation never exceeds that of the law alone.

    Args:
        model: of the closed loop along a path.
        fiber: of e.
        latent: ẑ_0, of the nominal model now.
        request: ν [rad, control unit]; a request that is not finite counts as 0.
        preview: κ_k [1/m] and v_k [m/s] over the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        width: of the nominal corridor to each side [m].

    Returns:
        `FilterResult`; if no prediction is finite, the law alone with margin −inf.
    """
    clipped = jnp.clip(jnp.where(all_finite(request), request, 0.0), -limit, limit)
    steering_back = limit * jnp.asarray([[1.0, 0.0], [-1.0, 0.0]])
    scales = jnp.asarray((*FILTER_SCALES, 0.0, 0.0), dtype=float)
    scaled = scales[: len(FILTER_SCALES), None] * clipped
    candidates = jnp.concatenate([scaled, steering_back])

    def advance(
        latent: Latent, nu: Control, road: Float[Array, " 2"]
    ) -> tuple[Latent, Scalar]:
        after = model.step(fiber, latent, jnp.concatenate([nu, road]))
        return after, model.decode(fiber, after)[BODY][LATERAL]

    def law_alone(
        latents: Latent, road: Float[Array, " 2"]
    ) -> tuple[Latent, Float[Array, " candidate"]]:
        return jax.vmap(lambda latent: advance(latent, jnp.zeros(2), road))(latents)

    first, lateral = jax.vmap(lambda nu: advance(latent, nu, preview[0]))(candidates)
    _, later = jax.lax.scan(law_alone, first, preview[1:])
    deviations = jnp.max(jnp.abs(jnp.concatenate([lateral[None], later])), axis=0)
    margins = jnp.where(jnp.isfinite(deviations), width - deviations, -jnp.inf)

    passing = margins[: len(FILTER_SCALES)] >= 0.0
    law_index = len(FILTER_SCALES) - 1
    # In a tie argmax takes the first of the backups, which is the law.
    backup = law_index + jnp.argmax(margins[law_index:])
    chosen = jnp.where(jnp.any(passing), jnp.argmax(passing), backup)
    return FilterResult(
        nu=candidates[chosen],
        latent=jax.tree.map(lambda leaf: leaf[chosen], first),
        scale=scales[chosen],
        margin=margins[chosen],
        feasible=margins[chosen] >= 0.0,
    )


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Where a certificate applies; None: no limit.

    Attributes:
        env: box of e.
        state: box of ξ.
        road: box of (κ, v_ref).
    """

    env: Box | None = None
    state: Box | None = None
    road: Box | None = None

    def nearest(self, env: Environment) -> Environment:
        """Return e, clipped to its box."""
        return env if self.env is None else jnp.clip(env, *map(jnp.asarray, self.env))

    def hold(self, xi: PathState, road: Float[Array, " 2"]) -> Bool[Array, ""]:
        """Whether ξ, κ and v_ref are inside; False for NaN."""
        inside = is_valid(xi[LATERAL], road[0])
        for box, point in ((self.state, xi), (self.road, road)):
            if box is not None:
                low, high = map(jnp.asarray, box)
                inside &= jnp.all((low <= point) & (point <= high))
        return inside


class ShieldState(NamedTuple):
    """The wrapped controller and the nominal model between two control steps.

    Attributes:
        inner: state of the wrapped controller.
        latent: of the nominal model, in the fibre of `env`; 0 before the start.
        started: whether the nominal model is running.
        env: the last finite environment, clipped to its box; NaN before the first one.
        road: κ [1/m] and v_ref [m/s] over the next steps of the last finite reference;
            NaN before the first one.
    """

    inner: Any
    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    road: Float[Array, "preview 2"]


@dataclass(frozen=True, kw_only=True)
class Shield:
    """A filter around a controller that keeps a nominal model in its corridor.

        ν = u − law(ξ; κ_0, v_0, e),   ν' = safety_filter(ν)
        u' = clip(law(ξ; κ_0, v_0, e) + ν'),   ẑ⁺ = F(ẑ; (ν', κ_0, v_0), e)
        |ê_y| ≤ width,   |e_y| ≤ width + tube

    ẑ is the nominal model, driven with the vehicle's own inputs, without correction.
    `tube` is a certified bound of |e_y − ê_y|; `safety_filter` chooses ν'. A control
    whose request passes unchanged is returned bit for bit. Slew limits of the actuators
    are not considered.

    - ξ or preview not finite: ξ is that of the nominal model (`dead_reckoning`). The
      certificate does not apply, since the loop is not closed around the vehicle.
      Without a preview the last one moves on. Environment not finite: the last finite
      one is used.
    - Before the first step at which all three were finite there is no nominal model.
      The control of the wrapped controller passes, clipped, or 0 if it is not finite.
    - Outside the conditions, or where the law is not finite: `outside_box`. The
      certificate does not apply, and the law drives alone; e is clipped to its box.
    - |e_y − ê_y| > tube + noise_allowance: `bound_exceeded`. The bound does not hold
      for this vehicle, and the nominal model starts anew at the measurement.

    `info` gains `margin` [m], `intervention` (1 − s, of the request clipped to the
    law's perturbation; 0 if it passed, 1 outside the box or if steered back),
    `perturbation` ν', `nominal_state` (its ξ), `nominal_distance` |e_y − ê_y| [m] (NaN
    without comparison), `corridor` = width + tube [m], `feasible`, `bound_exceeded`,
    `outside_box`, `dead_reckoning`, `env_inside`, and `shield_healthy`: feasible, and
    the certificate applies at this step.

    Attributes:
        inner: any controller along a path; its control is u.
        model: of the closed loop, with `along_path`.
        law: around which the model was learned.
        width: of the nominal corridor to each side [m].
        tube: bound of |e_y − ê_y| [m].
        control: box of u.
        horizon: number of steps over which the law alone is predicted; beyond the
            preview, its last curvature and speed are used.
        noise_allowance: error of a measured e_y that is added to the tube [m].
        conditions: where the certificate applies.

    Raises:
        ValueError: the model is not in path coordinates, or a setting is out of range.

    Source: Wabersich and Zeilinger (2021), Automatica 129, 109597.
    """

    inner: Controller
    model: Model
    law: PathLaw
    width: Positive
    tube: Positive
    control: Box
    horizon: AtLeastOne = 20
    noise_allowance: NonNegative = 0.0
    conditions: Conditions = Conditions()

    def __post_init__(self) -> None:
        if not self.model.along_path:
            raise ValueError(
                "a shield needs a model in path coordinates: model.frame=path"
            )
        check_intervals(self)
        states, environments = self._sizes
        _check_box("control", self.control, 2)
        _check_box("env", self.conditions.env, environments)
        _check_box("state", self.conditions.state, states)
        _check_box("road", self.conditions.road, 2)

    @property
    def _sizes(self) -> tuple[int, int]:
        """Numbers of entries of ξ and of e."""
        return self.law.gain.shape[-1], self.law.low.shape[0] - 2

    def controller(self) -> Controller:
        """Return the controller along a path."""
        return Controller(self.init, self.act)

    def init(self, key: Key) -> ShieldState:
        """Return the state before the first control step."""
        states, environments = self._sizes

        def encode(key: Key) -> Latent:
            params = fold(self.model, self.model.init(key))
            fiber = self.model.fiber(params, jnp.zeros(environments))
            return self.model.encode(fiber, path_state(jnp.zeros(states)))

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, key)
        return ShieldState(
            inner=self.inner.init(key),
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent),
            started=jnp.asarray(False),
            env=jnp.full(environments, jnp.nan, dtype=float),
            road=jnp.full((self.horizon, 2), jnp.nan, dtype=float),
        )

    def act(
        self,
        params: Params,
        state: ShieldState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, ShieldState, ControllerInfo]:
        """Take one control step."""
        low, high = map(jnp.asarray, self.control)
        planned, inner, info = self.inner.act(
            params, state.inner, coordinates, env, preview
        )
        now, fiber, law_control, flags = self._compare(
            params, state._replace(inner=inner), coordinates, env, preview
        )
        finite = all_finite(planned)
        planned = jnp.clip(jnp.where(finite, planned, 0.0), low, high)
        request = _request(planned, law_control, low, high)
        request = jnp.where(finite, request, 0.0)
        # Outside the box no request is admissible: the law drives alone.
        limit = jnp.where(flags["outside_box"], 0.0, self.law.perturbation)
        chosen = safety_filter(
            self.model, fiber, now.latent, request, now.road, limit, width=self.width
        )
        # A request that passes is returned bit for bit, not as law + (u − law).
        filtered = jnp.clip(law_control + chosen.nu, low, high)
        changed = ~finite | jnp.any(chosen.nu != request)
        applicable = now.started & all_finite(law_control)
        control = jnp.where(applicable & changed, filtered, planned)

        # A latent that is not finite would stay so: the nominal model starts anew.
        running = now.started & all_finite(chosen.latent)
        latent = jax.tree.map(partial(jnp.where, running), chosen.latent, now.latent)
        cut = jnp.where(flags["outside_box"], 1.0, 1.0 - chosen.scale)
        feasible = now.started & chosen.feasible
        invalid = flags["bound_exceeded"] | flags["outside_box"]
        invalid |= flags["dead_reckoning"] | ~flags["env_inside"]
        report: Any = {
            **info,
            **flags,
            "margin": jnp.where(now.started, chosen.margin, jnp.nan),
            "intervention": jnp.where(
                now.started & jnp.any(chosen.nu != request), cut, 0.0
            ),
            "perturbation": chosen.nu,
            "corridor": jnp.asarray(self.width + self.tube, dtype=float),
            "feasible": feasible,
            "shield_healthy": feasible & ~invalid,
        }
        return control, now._replace(latent=latent, started=running), report

    def _compare(
        self,
        params: Params,
        before: ShieldState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[ShieldState, Fiber, Control, dict[str, Any]]:
        """Compare the nominal model with a measurement, and evaluate the law.

        Returns:
            The nominal model in the fibre of the current environment, moved to the
            measurement if necessary; the fibre; the law's control at the measurement
            or, without one, at the nominal ξ; entries of `info`.
        """
        model = self.model
        last_env = jnp.where(all_finite(env), env, before.env)
        inside = self.conditions.nearest(last_env)
        readable = all_finite(preview.road)
        ahead = jnp.minimum(jnp.arange(self.horizon), preview.road.shape[0] - 1)
        moved_on = jnp.concatenate([before.road[1:], before.road[-1:]])
        road = jnp.where(readable, preview.road[ahead], moved_on)
        folded = fold(model, params)
        fiber = model.fiber(folded, inside)

        def switched() -> Latent:
            old = model.fiber(folded, before.env)
            return model.transport(old, fiber, before.latent)

        latent = jax.lax.cond(
            jnp.all(inside == before.env), lambda: before.latent, switched
        )
        anchor = model.encode(fiber, path_state(coordinates))
        # Every finite measurement is believed; a gate would belong here.
        believed = readable & all_finite((coordinates, anchor))
        distance = jnp.abs(coordinates - model.decode(fiber, latent)[BODY])[LATERAL]
        compared = believed & before.started
        exceeded = compared & ~(distance <= self.tube + self.noise_allowance)
        # The bound does not hold for this vehicle: what follows is about a nominal
        # model that starts at the vehicle.
        moved = believed & (~before.started | exceeded)
        latent = jax.tree.map(partial(jnp.where, moved), anchor, latent)
        started = before.started | believed

        nominal_xi = model.decode(fiber, latent)[BODY]
        # Without a measurement the loop is closed around the nominal model.
        xi = jnp.where(believed, coordinates, nominal_xi)
        law_control = self.law(xi, road[0, 0], road[0, 1], inside)
        covered = all_finite(law_control) & jnp.all(inside == last_env)
        covered &= self.conditions.hold(xi, road[0])
        flags = {
            "nominal_state": jnp.where(started, nominal_xi, jnp.nan),
            "nominal_distance": jnp.where(compared, distance, jnp.nan),
            "bound_exceeded": exceeded,
            "outside_box": started & ~covered,
            "dead_reckoning": started & ~believed,
            "env_inside": jnp.all(inside == env),
        }
        now = ShieldState(before.inner, latent, started, inside, road)
        return now, fiber, law_control, flags


def _request(
    planned: Control, law_control: Control, low: Control, high: Control
) -> Control:
    """The smallest ν with clip(law + ν) = u: 0 where both reach the same limit."""
    above = (planned >= high) & (law_control >= high)
    below = (planned <= low) & (law_control <= low)
    return jnp.where(above | below, 0.0, planned - law_control)


def _check_box(name: str, box: Box | None, size: int) -> None:
    """Raise a ValueError if a box has the wrong size or is empty."""
    low, high = box or ((0.0,) * size,) * 2
    sized = len(low) == len(high) == size
    if not sized or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"the box of {name} needs {size} lower limits below {size} upper ones, "
            f"got {low} and {high}"
        )
