"""The gate of the measurements along a path: what one step cannot explain is not used.

One gate for all layers behind it: estimator, shield and planner receive a state, an
environment and a road that are finite, and which coordinates were measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._planner import all_finite
from sfkd_jax.control.tasks._along_path import Preview, check_preview
from sfkd_jax.control.wrappers._estimator import Applied, input_error
from sfkd_jax.control.wrappers._innovations import (
    InnovationState,
    InnovationTest,
    expected_coordinates,
    steering_level,
    turning_rate,
)
from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    is_valid,
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
"""Longest time without an observation from another place of the path [s]."""
SLOWING = 0.8
"""Speed [m/s] by which a lost vehicle's reference is below its speed: braking."""


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
    """What the gate carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        expected: ξ predicted for this step; NaN before the first measurement.
        modelled: whether the model predicted it, inside the conditions.
        along: distance along the path of the last measured position, see `Preview`.
        missing: number of steps since a coordinate was last used.
        skew: what a wrong pose adds to the relative yaw [rad]; 0 for a right one.
        doubt: number of steps until the certificate may be claimed again, after a
            measurement was believed that nothing explains.
        env: the last finite environment.
        road: κ [1/m] and v_ref [m/s] over the next steps of the last finite reference;
            NaN before the first one.
        test: of the innovations, or None.
    """

    inner: Any
    expected: PathState
    modelled: Bool[Array, ""]
    along: Scalar
    missing: Int[Array, " coordinate"]
    skew: Scalar
    doubt: Int[Array, ""]
    env: Environment
    road: Float[Array, "preview 2"]
    test: InnovationState | None


class Believed(NamedTuple):
    """What the gate makes of one measurement.

    Attributes:
        xi: ξ, measured where it is believed.
        measured: where it is.
        compared: whether there was a prediction.
        innovation: ξ − ξ⁻.
        plausible: where the step explains it.
        forced: whether something is believed that the step does not explain.
        lost: whether there has been nothing to believe for too long.
        skew: see `GateState`.
    """

    xi: PathState
    measured: Bool[Array, " coordinate"]
    compared: Bool[Array, ""]
    innovation: PathState
    plausible: Bool[Array, " coordinate"]
    forced: Bool[Array, ""]
    lost: Bool[Array, ""]
    skew: Scalar


@dataclass(frozen=True, kw_only=True)
class Gate:
    """A controller along a path that follows plausible measurements only.

        ξ⁻ = F(ξ̂; u − law(ξ̂), κ, v_ref, e),   |ξ_i − ξ⁻_i| ≤ limit_i
        ξ̂ = ξ⁻ + L (ξ − ξ⁻) where ξ_i passes, else ξ⁻

    A coordinate that does not pass, is not finite, or belongs to an observation that
    repeats the last one bit for bit while the vehicle moves, is replaced by ξ⁻: the
    vehicle drives on its nominal model, with the other coordinates measured; of the yaw
    of a wrong pose the changes are. After
    `patience` a finite measurement is believed, whatever it says, and the certificate
    is not claimed for a `trial`; without one the reference speed falls, and the vehicle
    stops. Outside the conditions ξ⁻ is a point that keeps its heading and speed, and
    the limits are what a vehicle can reach.

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

    def controller(self) -> Controller:
        """Return the controller along a path."""
        return Controller(self.init, self.act)

    def init(self, key: Key) -> GateState:
        """Return the state before the first control step."""
        size, box = self.law.gain.shape[-1], self.conditions.env
        unknown = jnp.full(self.law.low.shape[0] - 2, jnp.nan, dtype=float)
        middle = unknown if box is None else 0.5 * jnp.sum(jnp.asarray(box), axis=0)
        return GateState(
            inner=self.inner.init(key),
            expected=jnp.full(size, jnp.nan, dtype=float),
            modelled=jnp.asarray(False),
            along=jnp.full((), jnp.nan, dtype=float),
            missing=jnp.zeros(size, jnp.int32),
            skew=jnp.zeros(()),
            doubt=jnp.zeros((), jnp.int32),
            env=middle,
            road=jnp.full((self.horizon, 2), jnp.nan, dtype=float),
            test=self.test and self.test.init(),
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
        env_known = all_finite(env) | (not self.reads_env)
        known = jnp.where(all_finite(env), env, state.env)
        periods = _elapsed(state.inner)
        on_time = jnp.abs(periods - 1.0) < 1e-3

        found = self._believed(state, coordinates, preview, periods)
        xi, measured, compared = found.xi, found.measured, found.compared
        doubt = jnp.where(found.forced, round(self.trial / self.dt), state.doubt)
        clean = jnp.all(measured)
        tested, verdict = self._tested(state, coordinates, measured & clean & on_time)
        clear = on_time & readable & env_known
        trusted = preview.trusted & clear & (doubt == 0) & ~verdict["innovation_alarm"]
        # Nothing to believe and nothing to rely on: stop.
        slower = jnp.minimum(road[:, 1], jnp.maximum(xi[PATH_SPEED] - SLOWING, 0.0))
        road = jnp.where(found.lost, road.at[:, 1].set(slower), road)

        seen = preview._replace(
            road=road, measured=measured, on_time=on_time, trusted=trusted
        )
        control, inner, info = self.inner.act(params, state.inner, xi, known, seen)

        # A believed outlier starts anew; noise is averaged.
        estimate = state.expected + self.gain * _difference(xi, state.expected)
        estimate = jnp.where(compared & (found.plausible | ~measured), estimate, xi)
        applied = Applied(control, road[0], info.get("env_estimate", known))
        ahead, modelled = self._predict(params, estimate, applied)
        tested = self._expect(tested, params, xi, applied, info, clear & clean)
        report: Any = {
            **info,
            "healthy": info.get("healthy", True) & clean & trusted,
            "measured": measured,
            "dead_reckoning": compared & ~clean,
            "innovation": jnp.where(measured, found.innovation, jnp.nan),
            "path_state": jnp.where(measured, coordinates, jnp.nan),
            **verdict,
            "trusted": trusted,
            "env_inside": info.get("env_inside", True) & env_known,
        }
        after = GateState(
            inner=inner,
            expected=ahead,
            modelled=modelled,
            along=jnp.where(clean, preview.along, state.along),
            missing=jnp.where(measured, 0, state.missing + 1),
            skew=found.skew,
            doubt=jnp.maximum(doubt - 1, 0),
            env=known,
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
    ) -> Believed:
        """What of a measurement is used, and what stands for the rest."""
        readable = all_finite(preview.road)
        expected, compared = state.expected, all_finite(state.expected)
        innovation = _difference(coordinates, expected)
        limit = self._limit(state, expected, periods)
        # The path goes on under the vehicle: an observation that is suddenly ahead or
        # behind is late, or of another place, in all of its entries.
        shifted = jnp.abs(preview.along - state.along) > self._reach(state, periods)
        # Not for ever: the reference may have moved, and the car has stopped by then.
        shifted &= jnp.max(state.missing) < round(PATIENCE_AHEAD / self.dt)
        moving = jnp.abs(expected[PATH_SPEED]) > MOVING
        stale = (preview.repeated | shifted) & moving
        usable = jnp.isfinite(coordinates) & readable & ~stale
        grown = limit * (1.0 + self.growth * state.missing)
        plausible = jnp.abs(innovation) <= grown
        # What stays implausible for so long is true: the prediction was wrong.
        late = state.missing >= round(self.patience / self.dt)
        # But a yaw alone: the position would show it.
        late = late.at[HEADING].set(late[HEADING] & ~plausible[LATERAL])
        measured = usable & (plausible | late | ~compared)
        # Either it or all that was believed before is wrong, and nothing says which.
        forced = compared & jnp.any(measured & ~(jnp.abs(innovation) <= limit))
        missing = jnp.where(measured, 0, state.missing + 1)
        xi = jnp.where(measured, coordinates, expected)
        pose_wrong = compared & ~(measured[LATERAL] & measured[HEADING])
        skewed = pose_wrong & usable[HEADING]
        heading, skew = _heading(state, coordinates, innovation, grown[HEADING])
        xi = xi.at[HEADING].set(jnp.where(skewed, heading, xi[HEADING]))
        lost = (missing > round(self.patience / self.dt)) & ~usable
        return Believed(
            xi=xi,
            measured=measured,
            compared=compared,
            innovation=innovation,
            plausible=plausible,
            forced=forced,
            lost=jnp.any(lost),
            skew=jnp.where(skewed, skew, 0.0),
        )

    def _reach(self, state: GateState, periods: Scalar) -> Scalar:
        """How far the vehicle gets in a step, and somewhat more [m]."""
        speed = jnp.abs(state.expected[PATH_SPEED])
        return (1.3 * speed * self.dt + 0.2) * jnp.maximum(periods, 1.0)

    def _tested(
        self, state: GateState, xi: PathState, measured: Bool[Array, " coordinate"]
    ) -> tuple[InnovationState | None, dict[str, Array]]:
        """The test after this measurement, and its entries of `info`."""
        tested, statistic, alarm = None, jnp.asarray(jnp.nan), jnp.asarray(False)
        if self.test is not None and state.test is not None:
            tested, statistic = self.test.update(state.test, xi, measured)
            alarm = tested.alarm
        return tested, {"innovation_statistic": statistic, "innovation_alarm": alarm}

    def _expect(
        self,
        state: InnovationState | None,
        params: Params,
        xi: PathState,
        applied: Applied,
        info: ControllerInfo,
        clear: Bool[Array, ""],
    ) -> InnovationState | None:
        """The test with what the next measurement is compared with."""
        if state is None:
            return None
        control, road, env = applied
        # What an estimator has found and counteracts is not found again.
        if "causes" in info:
            control = control + input_error(info["causes"], road)
        nearest = self.conditions.nearest(env)
        fiber = self.model.fiber(fold(self.model, params), nearest)
        nu = control - self.law(xi, road[0], road[1], nearest)
        expected = expected_coordinates(self.model, fiber, xi, nu, road)
        turned = self.dt * turning_rate(self.law, xi, control, road, nearest)
        expected = jnp.append(expected, xi[HEADING] + turned)
        # Beyond what data and planners add to the law, the model was not learned.
        usual = jnp.all(jnp.abs(nu) <= 1.01 * self.law.perturbation)
        clear &= usual & self.conditions.hold(xi, road)
        return state._replace(
            expected=jnp.where(clear, expected, jnp.nan),
            level=steering_level(self.law, road, nearest),
        )

    def _limit(
        self, state: GateState, expected: PathState, periods: Scalar
    ) -> Float[Array, " coordinate"]:
        """The largest difference that one step explains, entry by entry."""
        # What a vehicle can reach in a step without knowing its model: sideways what
        # it drives, and more than any tyre turns, accelerates and slides.
        wide = jnp.full(expected.shape, jnp.inf, dtype=float)
        wide = wide.at[HEADING].set(0.35).at[PATH_SPEED].set(1.5)
        wide = wide * jnp.maximum(periods, 1.0)
        wide = wide.at[LATERAL].set(self._reach(state, periods))
        limit = wide
        if self.conditions.state is not None:
            low, high = map(jnp.asarray, self.conditions.state)
            tight = 0.5 * self.share * (high - low)
            inside = state.modelled & (jnp.abs(periods - 1.0) < 1e-3)
            limit = jnp.where(inside, jnp.minimum(tight, wide), limit)
        return limit

    def _predict(
        self, params: Params, xi: PathState, applied: Applied
    ) -> tuple[PathState, Bool[Array, ""]]:
        """ξ one step later, and whether it is the model that says so."""
        control, road, env = applied
        model = self.model
        nearest = self.conditions.nearest(env)
        fiber = model.fiber(fold(model, params), nearest)
        nu = control - self.law(xi, road[0], road[1], nearest)
        ahead = expected_coordinates(model, fiber, xi, nu, road)
        inside = self.conditions.hold(xi, road) & all_finite(ahead)
        sideways = self.dt * xi[PATH_SPEED] * jnp.sin(xi[HEADING])
        return jnp.where(inside, ahead, xi.at[LATERAL].add(sideways)), inside


def _heading(
    state: GateState, xi: PathState, innovation: PathState, limit: Scalar
) -> tuple[Scalar, Scalar]:
    """The yaw of a wrong pose, less what is wrong with it, and that.

    A yaw that is off stays off by the same angle, and so does one relative to the
    wrong place of a bend: its changes are still measured.
    """
    off = innovation[HEADING]
    follows = (state.skew != 0.0) & (jnp.abs(wrap_angle(off - state.skew)) <= limit)
    skew = jnp.where(follows, state.skew, off)
    return xi[HEADING] - skew, skew


def _difference(xi: PathState, other: PathState) -> PathState:
    """ξ − ξ', the heading wrapped."""
    gap = xi - other
    return gap.at[HEADING].set(wrap_angle(gap[HEADING]))


def _elapsed(state: Any) -> Scalar:
    """Periods since the last call, from the state of the planner inside."""
    while hasattr(state, "inner"):
        state = state.inner
    # Only a planner of this package has a clock; others are called every period.
    elapsed = state.tuning.elapsed if hasattr(state, "tuning") else jnp.ones(())
    return jnp.where(jnp.isnan(elapsed), 1.0, elapsed)
