"""The guard of a planner along a path: nominal model, safety filter, and their flags.

Everything that decides whether the planner's control may pass is here. In one control
step (`Shield.act`) the measurement, which passed the `Gate`, is compared with the
nominal model (`Shield._compare`), and the request is filtered (`safety_filter`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import Stateful
from sfkd_jax.control._finite import all_finite
from sfkd_jax.control.laws._feedback import holding
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.tasks._along_path import Preview
from sfkd_jax.control.wrappers._gate import ANYWHERE, Box, Conditions
from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, PathState, path_state
from sfkd_jax.ranges import AtLeastOne, Fraction, NonNegative, Positive, check_intervals
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

FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Scales of a request that are tried, largest first; 0 is the law alone."""


class FilterResult(NamedTuple):
    """The outcome of `safety_filter`."""

    nu: Control  # the perturbation of the law to apply, (2,)
    latent: Latent  # of the nominal model one step later
    scale: Scalar  # s, of the request clipped to its limit; 0 while steering back
    margin: Scalar  # width − max |ê_y| over the predicted steps [m]; −inf if not finite
    feasible: Bool[Array, ""]  # whether the margin is at least 0


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


class ShieldState(NamedTuple):
    """The wrapped controller and the nominal model between two control steps."""

    inner: Any  # state of the wrapped controller
    latent: Latent  # of the nominal model, in the fibre of `env`; 0 before the start
    # Whether the nominal model is running and the loop was closed around the vehicle
    # since; otherwise it starts anew at the next measurement.
    started: Bool[Array, ""]
    # That of the last step, clipped to its box; NaN before the first one.
    env: Environment
    offset: Scalar  # what the start adds to the bound of |e_y − ê_y| [m]
    # Bound of |e_y| at the next step whatever steers [m]; NaN without one.
    rolling: Scalar


@dataclass(frozen=True, kw_only=True)
class Shield(Stateful):
    """A filter around a controller that keeps a nominal model in its corridor.

        ν = u − law(ξ; κ_0, v_0, e),   ν' = safety_filter(ν)
        u' = clip(law(ξ; κ_0, v_0, e) + ν'),   ẑ⁺ = F(ẑ; (ν', κ_0, v_0), e)
        |ê_y| ≤ width,   |e_y| ≤ width + tube + offset,   offset⁺ = decay · offset

    ẑ is the nominal model, driven with the vehicle's own inputs, without correction.
    `tube` is a certified bound of |e_y − ê_y|; `safety_filter` chooses ν'. A control
    whose request passes unchanged is returned bit for bit. Slew limits of the actuators
    are not considered. It belongs behind a `Gate`, which repairs what is not finite.

    - A planner that is not healthy, or whose control is not finite: the law alone.
    - Outside the conditions: `outside_box`. The certificate does not apply, and the law
      drives alone, back to the path.
    - A drive below that of the law by more than its perturbation: `braking`. It passes,
      everywhere; the steering stays filtered. The certificate does not apply.
    - |e_y − ê_y| > tube + offset + noise_allowance: `bound_exceeded`. The bound does
      not hold for this vehicle.
    - After any of these, and after steps that the gate did not measure or trust, the
      nominal model starts anew at the next measurement, with `offset` = start_error for
      the noise in it.
    - Slower than the conditions, down to rest and up again: the law drives alone, as
      outside of them, but the corridor goes on from its last value, if it had one:

          corridor⁺ = corridor + v dt |sin χ|,   χ = e_ψ − ψ*(κ, v, e)

      Time does not contract at rest, and this holds for every controller: proved is
      |e_y(t)| ≤ |e_y(0)| + ∫ |sin χ| ds for the course χ of the car relative to the
      path. That the heading of the steady turn, ψ*, tells its slip is measured, and
      so is χ once a step. `rolling` is how much of `corridor` came in this way [m].
    - Before the first measurement there is no nominal model. The control of the wrapped
      controller passes, clipped, or 0 if it is not finite.

    `info` gains `margin` [m], `intervention` (1 − s, of the request clipped to the
    law's perturbation; 0 if it passed, 1 outside the box or if steered back),
    `perturbation` ν', `nominal_state` (its ξ), `nominal_distance` |e_y − ê_y| [m] (NaN
    without comparison), `feasible`, `bound_exceeded`, `outside_box`, `braking`,
    `env_inside`, `corridor` (the bound of |e_y| at this step [m]; NaN where none
    holds), `shield_healthy` (there is one), and `healthy` is False unless the control
    is the plan of a healthy planner inside the corridor.

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
        start_error: `offset` of a nominal model that starts at a measurement [m].
        decay: of `offset` per step, the certified rate.
        conditions: where the certificate applies.
        dt: sampling period [s].
        rear: distance from the rear axle to the position of the vehicle [m], of which
            the slip is l κ at walking pace.
        claimed: whether `width` and `tube` are known of the vehicle that it drives. If
            they are those of a model in its place, `corridor` is NaN.

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
    start_error: NonNegative = 0.0
    decay: Fraction = 0.9
    conditions: Conditions = ANYWHERE
    dt: Positive = 0.1
    rear: NonNegative = 0.0
    claimed: bool = True

    def __post_init__(self) -> None:
        if not self.model.along_path:
            raise ValueError(
                "a shield needs a model in path coordinates: model.frame=path"
            )
        check_intervals(self)
        states = self.law.gain.shape[-1]
        environments = len(self.law.low) - 2
        _check_box("control", self.control, 2)
        _check_box("env", self.conditions.env, environments)
        _check_box("state", self.conditions.state, states)
        _check_box("road", self.conditions.road, 2)

    def init(self, key: Key) -> ShieldState:
        """Return the state before the first control step."""
        states = self.law.gain.shape[-1]
        environments = len(self.law.low) - 2

        def encode(params: Params) -> Latent:
            fiber = self.model.fiber(params, jnp.zeros(environments))
            return self.model.encode(fiber, path_state(jnp.zeros(states)))

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, jax.eval_shape(self.model.init, key))
        return ShieldState(
            inner=self.inner.init(key),
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent),
            started=jnp.asarray(False),
            env=jnp.full(environments, jnp.nan, dtype=float),
            offset=jnp.zeros(()),
            rolling=jnp.full((), jnp.nan, dtype=float),
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
        road = self._road(preview)
        nearest = self.conditions.nearest(env)
        turn = self.law.turn(road[0, 0], road[0, 1], nearest)
        law_control = turn.feedback(coordinates)
        now, fiber, flags = self._compare(
            params, state._replace(inner=inner), coordinates, env, preview, law_control
        )
        # A plan that continues an old one is worse than the law, which sees the car.
        usable = all_finite(planned) & info.get("healthy", True)
        planned = jnp.clip(jnp.where(all_finite(planned), planned, 0.0), low, high)
        request = _request(planned, law_control, low, high)
        request = jnp.where(usable, request, 0.0)
        # Outside the box no request is admissible: the law drives alone.
        limit = jnp.where(flags["outside_box"], 0.0, self.law.perturbation)
        chosen = safety_filter(
            self.model, fiber, now.latent, request, road, limit, width=self.width
        )
        # A request that passes is returned bit for bit, not as law + (u − law).
        filtered = jnp.clip(law_control + chosen.nu, low, high)
        changed = ~usable | jnp.any(chosen.nu != request)
        control = jnp.where(now.started & changed, filtered, planned)
        # Whoever brakes knows of something that no certificate does.
        gentlest = jnp.clip(law_control, low, high) - self.law.perturbation
        braking = usable & now.started & (planned[1] < gentlest[1] - 1e-3)
        drive = jnp.where(braking, planned[1], control[1])
        # Where the reference stands a law drives by the noise of a speed: it creeps.
        speed = road[0, 1]
        still = drive - holding(coordinates[PATH_SPEED], speed)
        stands = now.started & (speed == 0.0)
        drive = jnp.where(stands, jnp.clip(still, low[1], 0.0), drive)
        control = jnp.stack([control[0], drive])

        cut = jnp.where(flags["outside_box"], 1.0, 1.0 - chosen.scale)
        feasible = now.started & chosen.feasible
        applies = now.started & ~(flags["outside_box"] | flags["bound_exceeded"])
        known = preview.trusted & jnp.all(preview.measured)
        applies &= ~braking & flags["env_inside"] & known
        holds = applies & feasible
        intervention = jnp.where(now.started & jnp.any(chosen.nu != request), cut, 0.0)
        corridor = self.width + self.tube + now.offset
        usual = jnp.where(holds, corridor, jnp.nan)
        rolls = self._slow(coordinates, road[0]) & known & ~holds
        corridor = jnp.where(rolls, state.rolling, usual)
        claim = corridor if self.claimed else jnp.full_like(corridor, jnp.nan)
        report: Any = {
            **info,
            **flags,
            "margin": jnp.where(now.started, chosen.margin, jnp.nan),
            "intervention": intervention,
            "perturbation": chosen.nu,
            "braking": braking,
            "feasible": feasible,
            "corridor": claim,
            "rolling": jnp.where(rolls, corridor - self.width - self.tube, 0.0),
            "shield_healthy": jnp.isfinite(claim),
            "healthy": usable & holds & (intervention == 0.0),
        }
        # A latent that is not finite would stay so: the nominal model starts anew.
        running = applies & all_finite(chosen.latent)
        latent = jax.tree.map(partial(jnp.where, running), chosen.latent, now.latent)
        aside = self._aside(coordinates, road[0], turn.state[HEADING])
        after = now._replace(
            latent=latent,
            started=running,
            offset=self.decay * now.offset,
            rolling=corridor + aside,
        )
        return control, after, report

    def _slow(self, xi: PathState, road: Float[Array, " 2"]) -> Bool[Array, ""]:
        """Whether the car or its reference is slower than the conditions."""
        state = self.conditions.state
        given = self.conditions.road
        slow = xi[PATH_SPEED] < (-jnp.inf if state is None else state[0][PATH_SPEED])
        return slow if given is None else slow | (road[1] < given[0][1])

    def _aside(self, xi: PathState, road: Float[Array, " 2"], steady: Scalar) -> Scalar:
        """How far a step moves the car across the path: v dt |sin χ| [m]."""
        slowest = self.law.low[1]
        # The table ends at its lowest speed; below, the tyres slip less, and the car
        # turns about its rear axle.
        slower = 1.0 - jnp.minimum(road[1] / slowest, 1.0) ** 2
        course = xi[HEADING] - steady + self.rear * road[0] * slower
        return self.dt * jnp.abs(xi[PATH_SPEED] * jnp.sin(course))

    def _road(self, preview: Preview) -> Float[Array, "preview 2"]:
        """κ and v_ref over the horizon of the filter."""
        last = preview.road.shape[0] - 1
        return preview.road[jnp.minimum(jnp.arange(self.horizon), last)]

    def _compare(
        self,
        params: Params,
        before: ShieldState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
        law_control: Control,
    ) -> tuple[ShieldState, Fiber, dict[str, Any]]:
        """Compare the nominal model with a measurement.

        Returns:
            The nominal model in the fibre of the current environment, at the measured
            ξ if it starts anew; the fibre; entries of `info`.
        """
        model = self.model
        road = preview.road[0]
        inside = self.conditions.nearest(env)
        folded = fold(model, params)
        fiber = model.fiber(folded, inside)

        def switched() -> Latent:
            old = model.fiber(folded, before.env)
            return model.transport(old, fiber, before.latent)

        latent = jax.lax.cond(
            jnp.all(inside == before.env), lambda: before.latent, switched
        )
        anchor = model.encode(fiber, path_state(coordinates))
        readable = all_finite((anchor, law_control))
        compared = before.started & preview.measured[LATERAL]
        distance = jnp.abs(coordinates - model.decode(fiber, latent)[BODY])[LATERAL]
        allowed = self.tube + self.noise_allowance + before.offset
        exceeded = compared & ~(distance <= allowed)
        # The bound does not hold for this vehicle: what follows is about a nominal
        # model that starts at the vehicle.
        moved = ~before.started | exceeded
        latent = jax.tree.map(partial(jnp.where, moved), anchor, latent)
        started = readable & all_finite(latent)
        covered = self.conditions.hold(coordinates, road) & jnp.all(inside == env)
        flags = {
            "nominal_state": jnp.where(
                started, model.decode(fiber, latent)[BODY], jnp.nan
            ),
            "nominal_distance": jnp.where(compared, distance, jnp.nan),
            "bound_exceeded": exceeded,
            "outside_box": started & ~covered,
            "env_inside": jnp.all(inside == env),
        }
        offset = jnp.where(moved, self.start_error, before.offset)
        now = before._replace(latent=latent, started=started, env=inside, offset=offset)
        return now, fiber, flags


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
