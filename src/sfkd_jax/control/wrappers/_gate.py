"""The gate of the measurements along a path: what one step cannot explain is not used.

One gate for all layers behind it: estimator, shield and planner receive a state, an
environment and a road that are finite, and which coordinates were measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control._factory import Stateful
from sfkd_jax.control._finite import all_finite
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.tasks._along_path import Preview, check_preview
from sfkd_jax.control.wrappers._estimator import Applied, input_error
from sfkd_jax.control.wrappers._innovations import (
    InnovationState,
    InnovationTest,
    expected_coordinates,
    turning_rate,
)
from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    is_valid,
    put,
    wrap_angle,
)
from sfkd_jax.ranges import AtLeastOne, Fraction, Positive, check_intervals
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Model,
    Params,
    Scalar,
)

Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Lower and upper limits."""
MOVING = 0.3
"""Speed [m/s] above which a repeated observation is that of a sensor that froze."""
PATIENCE_AHEAD = 6.0
"""Longest time on observations from another place of the path, or without them [s]."""
LATEST = 1.2
"""Largest delay of an observation that is recognised [s]."""
SLOWING = 0.8
"""Speed [m/s] by which a lost vehicle's reference is below its speed: braking."""

AS_LATE = 0.5
"""Of the limits: how far a late observation may be from the estimate of its time. A
wrong position is behind on the path as well, and rarely that close.
"""
OUTSIDE = 0.5
"""How far outside the box of ξ the model predicts a car that is not seen, as a share of
its width.
"""


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


ANYWHERE = Conditions()
"""No limits."""


class GateState(NamedTuple):
    """What the gate carries from one control step to the next."""

    inner: Any  # state of the wrapped controller
    expected: PathState  # ξ predicted for this step; NaN before the first measurement
    modelled: Bool[Array, ""]  # whether the model predicted it, inside the conditions
    # Distance along the path of the last measured position, see `Preview`.
    along: Scalar
    # Number of steps since a coordinate was last used.
    missing: Int[Array, " coordinate"]
    skew: Scalar  # what a wrong pose adds to the relative yaw [rad]; 0 for a right one
    # Number of steps until the certificate may be claimed again, after a measurement
    # was believed that nothing explains.
    doubt: Int[Array, ""]
    env: Environment  # the last finite environment
    # κ [1/m] and v_ref [m/s] over the next steps of the last finite reference; 0 before
    # the first one.
    road: Float[Array, "preview 2"]
    test: InnovationState | None  # of the innovations, or None
    # Estimates of ξ at the last steps, newest first, and κ there [1/m].
    past: Float[Array, "step coordinate+1"]


@dataclass(frozen=True, kw_only=True)
class Gate(Stateful):
    """A controller along a path that follows plausible measurements only.

        ξ⁻ = F(ξ̂; u − law(ξ̂), κ, v_ref, e),   |ξ_i − ξ⁻_i| ≤ limit_i
        ξ̂ = ξ⁻ + L (ξ − ξ⁻) where ξ_i passes, else ξ⁻

    A coordinate that does not pass, is not finite, or belongs to an observation that
    repeats the last one bit for bit while the vehicle moves, is replaced by ξ⁻: the
    vehicle drives on its nominal model, with the other coordinates measured; of the yaw
    of a wrong pose the changes are. An observation that lies behind on the path, where
    the vehicle was up to 1.2 s ago, is late, and corrects the estimates since then.
    After `patience` a finite measurement is believed, whatever it says, and the
    certificate is not claimed for a `trial`; without one, or 6 s of late ones, the
    reference speed falls, and the vehicle stops. Far outside the conditions, and
    without a box of ξ, ξ⁻ is a point that keeps its heading and speed; outside them the
    limits are what a vehicle can reach.

    An environment or reference that is not finite is replaced by the last one, and by
    the middle of the box of e before the first; the road moves on with every step.

    `info` gains `measured` (coordinate,), `dead_reckoning` (a coordinate is not
    measured), `innovation` ξ − ξ⁻ (coordinate,; NaN without comparison), `path_state`
    (ξ where it is measured, else NaN), `innovation_statistic` (of `test`; NaN without
    one), `innovation_alarm` (the vehicle or its sensors are not those of the test) and
    `trusted` (the last call was one period ago, e and reference are finite, there is
    no trial and no alarm). `healthy` is False unless all of it is measured and trusted.

    Attributes:
        inner: controller along a path.
        model: of the closed loop, with `along_path`.
        law: around which the model was learned.
        dt: sampling period [s].
        conditions: where the model predicts.
        horizon: number of steps of the preview.
        reads_env: whether `inner` reads the environment that it is given.
        test: of the innovations, with what `inner` estimates taken into account.
        patience: longest time on the nominal model [s].
        trial: time without a claim after an implausible measurement was believed [s].
        share: of the half widths of the box of ξ that one step may be off.
        gain: L of the estimate from which the next step is predicted.
        growth: of the limits per step without a measurement.
    """

    inner: Controller
    model: Model
    law: PathLaw
    dt: Positive
    horizon: AtLeastOne
    conditions: Conditions = ANYWHERE
    reads_env: bool = True
    test: InnovationTest | None = None
    patience: Positive = 2.0
    trial: Positive = 10.0
    share: Positive = 0.55
    gain: Fraction = 0.8
    growth: Positive = 0.02

    def __post_init__(self) -> None:
        check_intervals(self)

    def init(self, key: Key) -> GateState:
        """Return the state before the first control step."""
        size = self.law.gain.shape[-1]
        box = self.conditions.env or (self.law.low[2:], self.law.high[2:])
        return GateState(
            inner=self.inner.init(key),
            expected=jnp.full(size, jnp.nan, dtype=float),
            modelled=jnp.asarray(False),
            along=jnp.full((), jnp.nan, dtype=float),
            missing=jnp.zeros(size, jnp.int32),
            skew=jnp.zeros(()),
            doubt=jnp.zeros((), jnp.int32),
            env=0.5 * jnp.sum(jnp.asarray(box, dtype=float), axis=0),
            road=jnp.zeros((self.horizon, 2)),
            test=self.test and self.test.init(),
            past=jnp.full((round(LATEST / self.dt), size + 1), jnp.nan, dtype=float),
        )

    def act(
        self,
        params: Params,
        state: GateState,
        coordinates: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, GateState, ControllerInfo]:
        """Take one control step."""
        check_preview(coordinates, env, preview, self.horizon)
        readable = all_finite(preview.road)
        moved_on = jnp.concatenate([state.road[1:], state.road[-1:]])
        road = jnp.where(readable, preview.road, moved_on)
        # Without the road a position is beside nothing.
        coordinates = jnp.where(readable, coordinates, jnp.nan)
        env_known = all_finite(env) | (not self.reads_env)
        env = jnp.where(all_finite(env), env, state.env)
        periods = _elapsed(state.inner)
        on_time = jnp.abs(periods - 1.0) < 1e-3
        preview = preview._replace(road=road, on_time=on_time)

        xi, measured, lost, after = self._believed(state, coordinates, preview, periods)
        clean = jnp.all(measured)
        compared = all_finite(state.expected)
        tested = None
        statistic = jnp.asarray(jnp.nan)
        alarm = jnp.asarray(False)
        if self.test is not None and state.test is not None:
            used = measured & clean & on_time
            tested, statistic = self.test.update(state.test, coordinates, used)
            alarm = tested.alarm
        clear = on_time & readable & env_known
        trusted = preview.trusted & clear & (after.doubt == 0) & ~alarm
        # Nothing to believe and nothing to rely on: stop.
        slower = jnp.minimum(road[:, 1], jnp.maximum(xi[PATH_SPEED] - SLOWING, 0.0))
        road = jnp.stack([road[:, 0], jnp.where(lost, slower, road[:, 1])], axis=1)

        seen = preview._replace(
            road=road, along=after.along, measured=measured, trusted=trusted
        )
        control, inner, info = self.inner.act(params, state.inner, xi, env, seen)

        applied = Applied(control, road[0], info.get("env_estimate", env))
        # What an estimator has found and counteracts is not found again.
        causes = info.get("causes")
        found = 0.0 * control if causes is None else input_error(causes, road[0])
        states = jnp.stack([after.past[0, :-1], xi])
        expected, modelled, tested = self._predict(
            params, states, applied, found, ~measured[LATERAL], tested, clear & clean
        )
        innovation = _difference(coordinates, state.expected)
        report: Any = {
            **info,
            "healthy": info.get("healthy", True) & clean & trusted,
            "measured": measured,
            "dead_reckoning": compared & ~clean,
            "innovation": jnp.where(measured, innovation, jnp.nan),
            "path_state": jnp.where(measured, coordinates, jnp.nan),
            "innovation_statistic": statistic,
            "innovation_alarm": alarm,
            "trusted": trusted,
            "env_inside": info.get("env_inside", True) & env_known,
        }
        after = after._replace(
            inner=inner,
            expected=expected,
            modelled=modelled,
            doubt=jnp.maximum(after.doubt - 1, 0),
            env=env,
            road=road,
            test=tested,
        )
        return control, after, report

    def _believed(
        self,
        state: GateState,
        coordinates: PathState,
        preview: Preview,
        periods: Scalar,
    ) -> tuple[PathState, Bool[Array, " coordinate"], Bool[Array, ""], GateState]:
        """What a measurement says: it is right, late, or wrong in position or yaw.

        Returns:
            ξ, measured where that is believed; where it is; whether there has been
            nothing to believe for too long; the state with what follows from that.
        """
        expected = state.expected
        compared = all_finite(state.expected)
        innovation = _difference(coordinates, expected)
        limit = self._limit(state, periods, preview.on_time)
        grown = limit * (1.0 + self.growth * state.missing)
        plausible = jnp.abs(innovation) <= grown
        moving = jnp.abs(expected[PATH_SPEED]) > MOVING
        seen = jnp.isfinite(coordinates) & ~(preview.repeated & moving)

        # The path goes on under the vehicle: an observation that is suddenly ahead or
        # behind is of another time or place, in all of its entries.
        gap = preview.along - state.along
        shifted = (jnp.abs(gap) > self._reach(state, periods)) & moving
        earlier, off, past = self._earlier(state, coordinates, preview.road[0, 0], gap)
        late = jnp.all(seen & (jnp.abs(earlier) <= AS_LATE * grown))
        late &= preview.on_time & shifted
        # Not for ever: the reference may have moved, and the car has stopped by then.
        longest = round(PATIENCE_AHEAD / self.dt)
        usable = seen & ~(late | (shifted & (jnp.max(state.missing) < longest)))

        # What stays implausible for so long is true: the prediction was wrong.
        longest = jnp.where(late, longest, round(self.patience / self.dt))
        overdue = state.missing >= longest
        # But a yaw alone: the position would show it.
        overdue = put(overdue, HEADING, overdue[HEADING] & ~plausible[LATERAL])
        measured = usable & (plausible | overdue | ~compared)
        # Either it or all that was believed before is wrong, and nothing says which.
        forced = compared & jnp.any(measured & ~(jnp.abs(innovation) <= limit))
        missing = jnp.where(measured, 0, state.missing + 1)
        xi = jnp.where(measured, coordinates, expected)
        xi = jnp.where(late, expected + off, xi)

        # A yaw that is off stays off by the same angle, and so does one relative to
        # the wrong place of a bend: its changes are still measured.
        turned = innovation[HEADING]
        stays = jnp.abs(wrap_angle(turned - state.skew)) <= grown[HEADING]
        skew = jnp.where((state.skew != 0.0) & stays, state.skew, turned)
        skewed = compared & usable[HEADING] & ~(measured[LATERAL] & measured[HEADING])
        heading = jnp.where(skewed, coordinates[HEADING] - skew, xi[HEADING])
        xi = put(xi, HEADING, heading)

        # A believed outlier starts anew; noise is averaged.
        estimate = expected + self.gain * _difference(xi, expected)
        estimate = jnp.where(compared & (plausible | ~measured), estimate, xi)
        here = jnp.append(estimate, preview.road[0, 0])
        past = jnp.where(late, past, state.past)
        lost = (missing > longest) & ~usable
        after = state._replace(
            along=jnp.where(jnp.all(measured), preview.along, state.along),
            missing=missing,
            skew=jnp.where(skewed, skew, 0.0),
            doubt=jnp.where(forced, round(self.trial / self.dt), state.doubt),
            past=jnp.concatenate([here[None], past[:-1]]),
        )
        return xi, measured, jnp.any(lost), after

    def _earlier(
        self, state: GateState, xi: PathState, curvature: Scalar, gap: Scalar
    ) -> tuple[PathState, PathState, Float[Array, "step coordinate+1"]]:
        """A measurement that lies behind on the path, as one of an earlier step.

        Returns:
            What it differs by from the estimate of that step, NaN if none was there;
            what the estimate of now then differs by; the past, corrected by it.
        """
        past = state.past[:, :-1]
        bends = state.past[:, -1]
        steps = self.dt * past[:, PATH_SPEED]
        behind = jnp.cumsum(steps)
        miss = jnp.nan_to_num(jnp.abs(behind + gap), nan=jnp.inf)
        which = jnp.argmin(miss)
        # ξ is relative to the circle of the road here, which was another one there.
        turned = jnp.cumsum((bends - curvature) * steps)
        then = past[which]
        then = put(then, HEADING, then[HEADING] - turned[which])
        then = put(then, LATERAL, then[LATERAL] + jnp.cumsum(turned * steps)[which])
        off = _difference(xi, then)
        off = jnp.where(miss[which] <= 0.6 * jnp.abs(steps[which]) + 0.1, off, jnp.nan)
        # Where it was wrong about the heading it went on into the wrong direction.
        kept = jnp.where(np.arange(len(off)) > PATH_SPEED, 0.0, off)

        def gone_on(distance: Scalar) -> PathState:
            return put(kept, LATERAL, kept[LATERAL] + distance * off[HEADING])

        later = jnp.arange(len(behind)) <= which
        change = self.gain * jax.vmap(gone_on)(behind[which] - behind)
        corrected = past + jnp.where(later[:, None], change, 0.0)
        corrected = jnp.concatenate([corrected, bends[:, None]], axis=1)
        return off, gone_on(behind[which]), corrected

    def _reach(self, state: GateState, periods: Scalar) -> Scalar:
        """How far the vehicle gets in a step, and somewhat more [m]."""
        speed = jnp.abs(state.expected[PATH_SPEED])
        return (1.3 * speed * self.dt + 0.2) * jnp.maximum(periods, 1.0)

    def _limit(
        self, state: GateState, periods: Scalar, on_time: Bool[Array, ""]
    ) -> Float[Array, " coordinate"]:
        """The largest difference that one step explains, entry by entry."""
        # What a vehicle can reach in a step without knowing its model: sideways what
        # it drives, and more than any tyre turns, accelerates and slides.
        rest = [jnp.inf] * (state.expected.shape[0] - 3)
        wide = jnp.asarray([0.0, 0.35, 1.5, *rest]) * jnp.maximum(periods, 1.0)
        wide = put(wide, LATERAL, self._reach(state, periods))
        if self.conditions.state is None:
            return wide
        low, high = map(jnp.asarray, self.conditions.state)
        tight = jnp.minimum(0.5 * self.share * (high - low), wide)
        return jnp.where(state.modelled & on_time, tight, wide)

    def _predict(
        self,
        params: Params,
        states: Float[Array, "2 coordinate"],
        applied: Applied,
        found: Control,
        unseen: Bool[Array, ""],
        test: InnovationState | None,
        clear: Bool[Array, ""],
    ) -> tuple[PathState, Bool[Array, ""], InnovationState | None]:
        """ξ̂ one step later, whether the model says so, and what ξ is compared with."""
        control, road, env = applied
        nearest = self.conditions.nearest(env)
        box = self.conditions.state
        turn = self.law.turn(road[0], road[1], nearest)
        fiber = box and self.model.fiber(fold(self.model, params), nearest)

        def onward(xi: PathState, control: Control, unseen: Bool[Array, ""]) -> Any:
            nu = control - turn.feedback(xi)
            # Beyond what data and planners add to the law, no model was learned.
            usual = jnp.all(jnp.abs(nu) <= 1.01 * self.law.perturbation)
            sideways = self.dt * xi[PATH_SPEED] * jnp.sin(xi[HEADING])
            straight = put(xi, LATERAL, xi[LATERAL] + sideways)
            if box is None:
                # A model that nothing is known of must not overrule a measurement.
                return straight, jnp.asarray(False), usual
            ahead = expected_coordinates(self.model, fiber, xi, nu, road)
            inside = self.conditions.hold(xi, road) & all_finite(ahead)
            # A car that is not seen drives on its model somewhat outside as well: a
            # point that keeps its heading is worse.
            low, high = map(np.asarray, box)
            more = OUTSIDE * (high - low)
            near = jnp.all((low - more <= xi) & (xi <= high + more)) & all_finite(ahead)
            return jnp.where(inside | (unseen & near), ahead, straight), inside, usual

        cases = (
            jnp.stack([control, control + found]),
            jnp.stack([unseen, jnp.asarray(False)]),
        )
        after, inside, usual = jax.vmap(onward)(states, *cases)
        if test is not None:
            xi = states[1]
            turned = self.dt * turning_rate(
                self.law, xi, control + found, road, nearest
            )
            ahead = jnp.append(after[1], xi[HEADING] + turned)
            expected = jnp.where(clear & inside[1] & usual[1], ahead, jnp.nan)
            test = test._replace(expected=expected, level=turn.level)
        return after[0], inside[0], test


def _difference(xi: PathState, other: PathState) -> PathState:
    """ξ − ξ', the heading wrapped."""
    gap = xi - other
    return put(gap, HEADING, wrap_angle(gap[HEADING]))


def _elapsed(state: Any) -> Scalar:
    """Periods since the last call, from the state of the planner inside."""
    while hasattr(state, "inner"):
        state = state.inner
    # Only a planner of this package has a clock; others are called every period.
    elapsed = state.tuning.elapsed if hasattr(state, "tuning") else jnp.ones(())
    return jnp.where(jnp.isnan(elapsed), 1.0, elapsed)
