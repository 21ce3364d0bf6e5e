"""A tube that is calibrated while driving, and the speed at which it fits the lane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import Stateful
from sfkd_jax.control.planners._planner import all_finite
from sfkd_jax.geometry import LATERAL, between, compose, curvature_ahead, wrap_angle
from sfkd_jax.ranges import AtLeastTwo, Fraction, Interval, Positive, check_intervals
from sfkd_jax.types import (
    POSE,
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

RADIUS = Interval("[1e-3, 1e2]")
"""Least and largest radius [m]."""
GRIP_SHARE = 0.8
"""Share of the grip that a turn must ask for to prove it."""


class OnlineTubeState(NamedTuple):
    """What the calibration carries from one control step to the next."""

    inner: Any  # state of the wrapped controller
    # e_y that the last plans predicted, newest first [m]; NaN where a plan is not
    # finite, and before there was one.
    plans: Float[Array, "horizon horizon"]
    radii: Float[Array, " horizon"]  # r_h of the tube [m]
    # Of the reference speed, at which the corridor fits the lane.
    corridor_factor: Scalar
    speed_factor: Scalar  # of the reference speed that is followed
    # Lateral acceleration at which the corridor fitted the lane [m/s²]; 0 if it is not
    # limited.
    grip: Scalar


@dataclass(frozen=True, kw_only=True)
class OnlineTube(Stateful):
    """A tube around the plans of a controller, and a speed at which it fits the lane.

    For every h up to the horizon, the plan of h steps ago said where the car would be
    across the path now. Adaptive conformal inference on the scale of the radius:

        r_h ← r_h exp(γ (1{|e_y − ê_{y,h}| > r_h} − (1 − level)))

    so that in N steps, whatever happens, the fraction of misses differs from 1 − level
    by at most |log(r_N / r_0)| / (γ N). Nothing is assumed about the run, and nothing
    is proved about a single step. Errors are those of the measured position.

    The online corridor is max_h |ê_{y,h}| + r_h. While it exceeds `lane`, the reference
    speed falls; otherwise it rises, so much slower that the speed settles where the
    corridor fits in a fraction `level` of the steps. Both are gentle: hard braking
    would take the grip that the tyres need to stay on the path.

    With a finite `grip`, a turn ahead is taken at a lateral acceleration at which the
    corridor has fitted before, whatever friction is measured. Nothing but a turn shows
    how much grip there is, and then it is too late to brake:

        c ≤ √(a / max_h v_h² |κ_h|)

    a rises while the corridor fits at 80 % of it, and falls while it does not.

    Attributes:
        inner: in the world, of `along_reference`: its `info` has `path_state` and
            `planned_path`, so that nothing is projected again.
        horizon: number of predicted steps.
        level: of the coverage.
        rate: γ.
        start_radius: r_h at the start [m].
        lane: largest |e_y| that is acceptable [m]; None for a tube that only reports.
        slowest: least speed that the corridor can ask for [m/s]: a model is of little
            use below the speeds that it was learned at.
        fall: of the factor per step, while the corridor exceeds the lane.
        grip: a at the start [m/s²]; None where friction is trusted.

    `info` gains `tube` (horizon,) [m], `tube_errors` (horizon,) [m]
        (NaN without a plan to compare with), `tube_missed` (horizon,),
        `online_corridor` [m], `speed_factor` and `grip` [m/s²; 0 without limit].

    Source: Gibbs and Candès (2021), Adaptive Conformal Inference Under Distribution
    Shift.
    """

    inner: Controller
    horizon: AtLeastTwo
    level: Fraction = 0.95
    rate: Positive = 0.2
    start_radius: Annotated[float, RADIUS] = 0.03
    lane: Positive | None = 0.1
    slowest: Positive = 8.0
    fall: Fraction = 0.01
    grip: Positive | None = None

    def __post_init__(self) -> None:
        check_intervals(self)

    def init(self, key: Key) -> OnlineTubeState:
        """Return the state before the first control step."""
        horizon = self.horizon
        return OnlineTubeState(
            inner=self.inner.init(key),
            plans=jnp.full((horizon, horizon), jnp.nan, dtype=float),
            radii=jnp.full(horizon, self.start_radius, dtype=float),
            corridor_factor=jnp.ones(()),
            speed_factor=jnp.ones(()),
            grip=jnp.asarray(self.grip or 0.0),
        )

    def act(
        self,
        params: Params,
        state: OnlineTubeState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, OnlineTubeState, ControllerInfo]:
        """Take one control step."""
        slowed = slow_down(reference, state.speed_factor)
        # At full speed the reference stays what it is, bit for bit.
        target = jnp.where(state.speed_factor < 1.0, slowed, reference)
        info: Any
        control, inner, info = self.inner.act(
            params, state.inner, observation, env, target
        )
        # The plan of h steps ago said where the car would be now: the h-th diagonal.
        errors = jnp.abs(info["path_state"][LATERAL] - jnp.diagonal(state.plans))
        missed = errors > state.radii
        change = jnp.exp(self.rate * (missed - (1.0 - self.level)))
        radii = jnp.clip(state.radii * change, *RADIUS.ends)
        # Without a comparison there is nothing to learn from.
        radii = jnp.where(jnp.isfinite(errors), radii, state.radii)
        plan = info["planned_path"][:, LATERAL]
        plan = jnp.where(all_finite(plan), plan, jnp.nan)
        corridor = jnp.max(jnp.abs(plan) + radii)
        fits = corridor <= (math.inf if self.lane is None else self.lane)
        corridor_factor, grip, factor = self._speeds(state, reference, fits)
        after = OnlineTubeState(
            inner=inner,
            plans=jnp.concatenate([plan[None], state.plans[:-1]]),
            radii=radii,
            corridor_factor=corridor_factor,
            speed_factor=factor,
            grip=grip,
        )
        report: Any = {
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
        self, state: OnlineTubeState, reference: Reference, fits: Bool[Array, ""]
    ) -> tuple[Scalar, Scalar, Scalar]:
        """The next corridor_factor, grip and speed_factor."""
        # So much slower up than down that it settles where `level` of the steps fit.
        rise = self.fall * (1.0 - self.level) / self.level
        change = jnp.where(fits, rise, -self.fall)
        least = jnp.clip(self.slowest / reference[0, 3], 0.0, 1.0)
        # A reference at rest has no speed to keep.
        least = jnp.where(jnp.isfinite(least), least, 0.0)
        corridor_factor = jnp.clip(state.corridor_factor + change, least, 1.0)

        before, cap, grip = state.speed_factor, jnp.ones(()), state.grip
        if self.grip is not None:
            cap, grip = self._shown(state, reference, fits)
        factor = jnp.minimum(corridor_factor, jnp.maximum(cap, least))
        factor = jnp.clip(factor, before - self.fall, before + self.fall)
        return corridor_factor, grip, factor

    def _shown(
        self, state: OnlineTubeState, reference: Reference, fits: Bool[Array, ""]
    ) -> tuple[Scalar, Scalar]:
        """The speed_factor for which the grip was shown, and the next grip."""
        ahead = reference[:, 3] ** 2 * jnp.abs(curvature_ahead(reference))
        now = state.speed_factor**2 * ahead[0]
        # Only a turn that asks for the grip proves it; a corridor that does not fit
        # disproves it anywhere.
        proved = jnp.where(now > GRIP_SHARE * state.grip, 1.0 + self.fall, 1.0)
        grip = state.grip * jnp.where(fits, proved, 1.0 - self.fall)
        cap = jnp.sqrt(grip / jnp.maximum(jnp.max(ahead), 1e-6))
        return jnp.where(jnp.isfinite(cap), cap, 1.0), grip


def slow_down(reference: Reference, factor: float | Scalar) -> Reference:
    """Follow the same path at a lower speed, linear between its points.

    g'(t) = g(c t),   v'(t) = c v(c t),   c in (0, 1]
    """
    horizon = reference.shape[0]
    # reference[0] is the target one step from now. The target now is one step back
    # along the circle through the first two poses. The pose of the vehicle would draw
    # its error into the path.
    now = compose(reference[0, POSE], between(reference[1, POSE], reference[0, POSE]))
    points = jnp.concatenate([jnp.append(now, reference[0, 3])[None], reference])
    times = factor * jnp.arange(1, horizon + 1)
    index = jnp.minimum(jnp.floor(times).astype(int), horizon - 1)
    start, step = points[index], points[index + 1] - points[index]
    step = step.at[:, 2].set(wrap_angle(step[:, 2]))
    return (start + (times - index)[:, None] * step).at[:, 3].multiply(factor)
