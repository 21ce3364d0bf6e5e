"""The guard of a planner along a path: nominal model, safety filter, and their flags.

Everything that decides whether the planner's control may pass is here: whether a
measurement is believed (`Shield._nominal`), where the certificate applies
(`Conditions`), which control a request becomes (`safety_filter`), and what drives
instead (`Shield.law`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._along_path import Preview
from sfkd_jax.geometry import LATERAL, PathState, is_valid, path_state
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    ControllerInfo,
    Environment,
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
    fiber: Any,
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


class NominalState(NamedTuple):
    """The nominal model between two control steps.

    Attributes:
        latent: in the fibre of `env`; 0 before the start.
        started: whether the nominal model is running.
        env: the last finite environment, clipped to its box; NaN before the first one.
        road: κ [1/m] and v_ref [m/s] over the next steps of the last finite reference;
            NaN before the first one.
    """

    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    road: Float[Array, "preview 2"]


class ShieldState(NamedTuple):
    """What the shield carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        nominal: the nominal model.
        interventions: number of steps so far at which a request was reduced.
        exceeded_steps: number of steps so far at which the nominal model was too far
            from the measurement.
    """

    inner: Any
    nominal: NominalState
    interventions: Int[Array, ""]
    exceeded_steps: Int[Array, ""]


class Comparison(NamedTuple):
    """Vehicle and nominal model at one control step.

    Attributes:
        nominal: in the fibre of the current environment, moved to the measurement if
            necessary.
        fiber: of that environment.
        law_control: of the law at the measurement or, without one, at the nominal ξ.
        applicable: whether that control is finite and the nominal model is running.
        flags: entries of `info`.
    """

    nominal: NominalState
    fiber: Any
    law_control: Control
    applicable: Bool[Array, ""]
    flags: dict[str, Any]


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
      for this vehicle.

    `info` gains `margin` [m], `intervention` (1 − s, of the request clipped to `limit`;
    0 if it passed, 1 outside the box or if steered back), `perturbation` ν',
    `nominal_state` (its ξ), `nominal_distance` |e_y − ê_y| [m] (NaN without
    comparison), `corridor` = width + tube [m], `feasible`, `bound_exceeded`,
    `outside_box`, `dead_reckoning`, `request_finite`, `env_inside`, `interventions`,
    `exceeded_steps`, and `shield_healthy`: feasible, and the certificate applies at
    this step.

    Attributes:
        inner: any controller along a path; its control is u.
        model: of the closed loop, with `along_path`.
        law: around which the model was learned.
        width: of the nominal corridor to each side [m].
        tube: bound of |e_y − ê_y| [m].
        control: box of u.
        horizon: number of steps over which the law alone is predicted; beyond the
            preview, its last curvature and speed are used.
        limit: largest |ν|; `law.perturbation` if None.
        noise_allowance: error of a measured e_y that is added to the tube [m].
        reanchor: move the nominal model to the measurement when the bound is exceeded.
        conditions: where the certificate applies.

    Raises:
        ValueError: the model is not in path coordinates, or a setting is out of range.

    Source: Wabersich and Zeilinger (2021), Automatica 129, 109597.
    """

    inner: Controller
    model: Model
    law: PathLaw
    width: float
    tube: float
    control: Box
    horizon: int = 20
    limit: tuple[float, ...] | None = None
    noise_allowance: float = 0.0
    reanchor: bool = True
    conditions: Conditions = Conditions()

    def __post_init__(self) -> None:
        if not self.model.along_path:
            raise ValueError(
                "a shield needs a model in path coordinates: model.frame=path"
            )
        for name in ("width", "tube"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive and finite [m], got {value}")
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 step, got {self.horizon}")
        if not 0.0 <= self.noise_allowance < math.inf:
            raise ValueError(
                "noise_allowance must be finite and not negative [m], "
                f"got {self.noise_allowance}"
            )
        check_box("control", self.control, 2)
        if self.limit is not None:
            check_box("limit", (tuple(-entry for entry in self.limit), self.limit), 2)
        check_box("env", self.conditions.env, self._environments)
        check_box("state", self.conditions.state, self.law.gain.shape[-1])
        check_box("road", self.conditions.road, 2)

    @property
    def _environments(self) -> int:
        return self.law.low.shape[0] - 2

    def controller(self) -> Controller:
        """Return the controller along a path."""
        return Controller(self.init, self.act)

    def init(self, key: Key) -> ShieldState:
        """Return the state before the first control step."""

        def encode(key: Key) -> Latent:
            params = fold(self.model, self.model.init(key))
            fiber = self.model.fiber(params, jnp.zeros(self._environments))
            return self.model.encode(
                fiber, path_state(jnp.zeros(self.law.gain.shape[-1]))
            )

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, jax.random.key(0))
        nominal = NominalState(
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent),
            started=jnp.asarray(False),
            env=jnp.full(self._environments, jnp.nan, dtype=float),
            road=jnp.full((self.horizon, 2), jnp.nan, dtype=float),
        )
        zero = jnp.zeros((), dtype=jnp.int32)
        return ShieldState(self.inner.init(key), nominal, zero, zero)

    def act(
        self,
        params: Params,
        state: ShieldState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, ShieldState, ControllerInfo]:
        """Take one control step."""
        if env.shape != (self._environments,):
            raise ValueError(
                f"env must have shape ({self._environments},), got {env.shape}"
            )
        low, high = map(jnp.asarray, self.control)
        planned, inner, info = self.inner.act(
            params, state.inner, coordinates, env, preview
        )
        now = self._compare(params, state.nominal, coordinates, env, preview)
        nominal, flags = now.nominal, now.flags
        finite = all_finite(planned)
        planned = jnp.clip(jnp.where(finite, planned, 0.0), low, high)
        request = _request(planned, now.law_control, low, high)
        request = jnp.where(finite, request, 0.0)
        limit = self.law.perturbation if self.limit is None else jnp.asarray(self.limit)
        # Outside the box no request is admissible: the law drives alone.
        limit = jnp.where(flags["outside_box"], 0.0, limit)
        chosen = safety_filter(
            self.model,
            now.fiber,
            nominal.latent,
            request,
            nominal.road,
            limit,
            width=self.width,
        )
        unchanged = finite & jnp.all(chosen.nu == request)
        filtered = jnp.clip(now.law_control + chosen.nu, low, high)
        # A request that passes is returned bit for bit, not as law + (u − law).
        control = jnp.where(now.applicable & ~unchanged, filtered, planned)
        cut = jnp.where(flags["outside_box"], 1.0, 1.0 - chosen.scale)
        cut = jnp.where(nominal.started & jnp.any(chosen.nu != request), cut, 0.0)

        # A latent that is not finite would stay so: the nominal model starts anew.
        running = nominal.started & all_finite(chosen.latent)
        after = ShieldState(
            inner=inner,
            nominal=nominal._replace(
                latent=_where(running, chosen.latent, nominal.latent), started=running
            ),
            interventions=state.interventions + (cut > 0.0),
            exceeded_steps=state.exceeded_steps + flags["bound_exceeded"],
        )
        feasible = nominal.started & chosen.feasible
        invalid = flags["bound_exceeded"] | flags["outside_box"]
        invalid |= flags["dead_reckoning"] | ~flags["env_inside"]
        report: Any = {
            **info,
            **flags,
            "margin": jnp.where(nominal.started, chosen.margin, jnp.nan),
            "intervention": cut,
            "perturbation": chosen.nu,
            "corridor": jnp.asarray(self.width + self.tube, dtype=float),
            "feasible": feasible,
            "request_finite": finite,
            "interventions": after.interventions,
            "exceeded_steps": after.exceeded_steps,
            "shield_healthy": feasible & ~invalid,
        }
        return control, after, report

    def _compare(
        self,
        params: Params,
        before: NominalState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
    ) -> Comparison:
        """Compare the nominal model with a measurement, and evaluate the law."""
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
        started = before.started | believed
        # The bound does not hold for this vehicle: what follows is about a nominal
        # model that starts at the vehicle.
        moved = believed & (~before.started | (exceeded & self.reanchor))
        latent = _where(moved, anchor, latent)

        nominal_xi = model.decode(fiber, latent)[BODY]
        # Without a measurement the loop is closed around the nominal model.
        xi = jnp.where(believed, coordinates, nominal_xi)
        law_control = self.law(xi, road[0, 0], road[0, 1], inside)
        applicable = started & all_finite(law_control)
        covered = applicable & jnp.all(inside == last_env)
        covered &= self.conditions.hold(xi, road[0])
        flags = {
            "nominal_state": jnp.where(started, nominal_xi, jnp.nan),
            "nominal_distance": jnp.where(compared, distance, jnp.nan),
            "bound_exceeded": exceeded,
            "outside_box": started & ~covered,
            "dead_reckoning": started & ~believed,
            "env_inside": jnp.all(inside == env),
        }
        nominal = NominalState(latent, started, inside, road)
        return Comparison(nominal, fiber, law_control, applicable, flags)


def _request(
    planned: Control, law_control: Control, low: Control, high: Control
) -> Control:
    """The smallest ν with clip(law + ν) = u: 0 where both reach the same limit."""
    above = (planned >= high) & (law_control >= high)
    below = (planned <= low) & (law_control <= low)
    return jnp.where(above | below, 0.0, planned - law_control)


def check_box(name: str, box: Box | None, size: int) -> None:
    """Raise a ValueError if a box has the wrong size or is empty."""
    if box is None:
        return
    low, high = box
    sized = len(low) == len(high) == size
    if not sized or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"the box of {name} needs {size} lower limits below {size} upper ones, "
            f"got {low} and {high}"
        )


def _where(condition: Bool[Array, ""], left: Latent, right: Latent) -> Latent:
    """`jnp.where` for latents."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), left, right)
