"""What the gate believes of a measurement along a path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control import all_finite
from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    curvature_ahead,
    place_on,
)
from sfkd_jax.driving.path_following.tasks._preview import Preview
from sfkd_jax.driving.path_following.wrappers._conditions import Box
from sfkd_jax.driving.path_following.wrappers._measurement_tests import (
    MeasurementTests,
    TestsState,
)
from sfkd_jax.geometry import put, wrap_angle
from sfkd_jax.types import Environment, Scalar

MOVING = 0.3
"""Speed [m/s] above which a repeated observation is that of a sensor that froze."""
PATIENCE_AHEAD = 6.0
"""Longest time on observations from another place of the path, or without them [s]."""
LATEST = 1.2
"""Largest delay of an observation that is recognised [s]."""
SLIP = 0.3
"""Share of the way of a step by which a position may be ahead or behind."""
ALONG_NOISE = 0.2
"""Distance along the path by which it may be so besides [m]."""
ALONG_GAIN = 0.2
"""Gain of the place along the path. It is small, so that small contradictions between
position and speed add up.
"""
AS_LATE = 0.5
"""Share of the limits by which a late observation may differ from the estimate of its
time. A wrong position is behind on the path as well, and rarely that close.
"""
SAME_TURN = 0.5
"""Share of the largest innovation of the heading by which a wrong yaw may change."""
COURSE_WEIGHT = 0.1
"""Weight of the newest lateral innovation in their mean while a yaw is refused."""
COURSE_NOISE = 0.01
"""Mean lateral innovation [m] that noise explains."""


class GateState(NamedTuple):
    """What the gate carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        expected: ξ predicted for this step; NaN before the first measurement.
        modelled: whether the model predicted it, inside the conditions.
        place: position in the world predicted for this step [m]; NaN before the first
            measurement, and in the frame of the vehicle.
        missing: number of steps since each coordinate was last used.
        skew: what a wrong pose adds to the relative yaw [rad]; 0 for a right one.
        aside: mean lateral innovation since a yaw is refused [m].
        doubt: number of steps until the certificate may be claimed again, after a
            measurement was believed that nothing explains.
        env: the last finite environment.
        road: κ [1/m] and v_ref [m/s] over the next steps of the last finite reference;
            0 before the first one.
        tests: state of the tests that raise alarms.
        past: estimates of ξ at the last steps, newest first, and κ there [1/m].
    """

    inner: Any
    expected: PathState
    modelled: Bool[Array, ""]
    place: Float[Array, " 2"]
    missing: Int[Array, " coordinate"]
    skew: Scalar
    aside: Scalar
    doubt: Int[Array, ""]
    env: Environment
    road: Float[Array, "preview 2"]
    tests: TestsState
    past: Float[Array, "step coordinate+1"]


class Believed(NamedTuple):
    """What is believed of a measurement.

    Attributes:
        xi: ξ, measured where that is believed, and elsewhere predicted.
        measured: which entries of ξ are measured.
        along: place on the path, see `Preview`.
        lost: whether there has been nothing to believe for too long.
        state: of the gate, with what follows from the measurement.
    """

    xi: PathState
    measured: Bool[Array, " coordinate"]
    along: Scalar
    lost: Bool[Array, ""]
    state: GateState


class Yaw(NamedTuple):
    """What is believed of a measured yaw.

    Attributes:
        plausible: whether it may be right.
        explained: whether noise explains how it differs from what was expected; True
            for the other coordinates.
        skew: by which angle it is wrong if it is not [rad].
        aside: mean lateral innovation while a yaw is refused [m].
    """

    plausible: Bool[Array, ""]
    explained: Bool[Array, " coordinate"]
    skew: Scalar
    aside: Scalar


class Earlier(NamedTuple):
    """A measurement that lies behind on the path, as one of an earlier step.

    Attributes:
        difference: from the estimate of that step; NaN if the vehicle was not there.
        difference_now: what the estimate of now therefore differs by.
        past: the estimates since then, corrected by the measurement.
    """

    difference: PathState
    difference_now: PathState
    past: Float[Array, "step coordinate+1"]


@dataclass(frozen=True, kw_only=True)
class Plausibility:
    """The rules by which a measurement is right, late, or wrong in position or yaw.

    Attributes:
        dt: sampling period [s].
        box: of ξ, in which the model predicts; None without one.
        tests: of the innovations, whose noise they know.
        patience: longest time on the prediction [s].
        trial: time without a claim after an implausible measurement was believed [s].
        share: of the half widths of the box of ξ that one step may be off.
        gain: of the estimate that is kept of each step.
        growth: of the limits per step without a measurement.
    """

    dt: float
    box: Box | None
    tests: MeasurementTests
    patience: float
    trial: float
    share: float
    gain: float
    growth: float

    def judge(
        self,
        state: GateState,
        observed: PathState,
        preview: Preview,
        periods: Scalar,
    ) -> Believed:
        """Return what is believed of a measurement.

        Args:
            state: of the gate after the last step.
            observed: observed ξ.
            preview: of the road, with the place of the observation along the path.
            periods: sampling periods since the last call.
        """
        expected = state.expected
        compared = all_finite(expected)
        innovation = difference(observed, expected)
        limit = self._limit(state, periods, preview.on_time)
        grown = limit * (1.0 + self.growth * state.missing)
        yaw = self._yaw(state, innovation, grown[HEADING], preview.on_time)
        plausible = put(jnp.abs(innovation) <= grown, HEADING, yaw.plausible)
        moving = jnp.abs(expected[PATH_SPEED]) > MOVING
        seen = jnp.isfinite(observed) & ~(preview.repeated & moving)

        # An observation that is ahead of where the vehicle has driven, or behind, is of
        # another time or place, in all of its entries.
        along = self._expected_along(state, preview)
        gap = preview.along - along
        slack = self._slack(state, periods, preview.on_time)
        shifted = moving & (jnp.abs(gap) > slack)
        earlier = self._earlier(state, observed, preview.road[0, 0], gap)
        late = jnp.all(seen & (jnp.abs(earlier.difference) <= AS_LATE * grown))
        late &= preview.on_time & shifted
        usable = seen & ~(late | (shifted & self._refuses(state)))

        longest = jnp.where(late, PATIENCE_AHEAD, self.patience) / self.dt
        overdue = _overdue(state.missing >= jnp.round(longest), plausible)
        measured = usable & (plausible | overdue | ~compared)
        # Either this measurement or all that was believed before is wrong, and nothing
        # says which.
        explained = (jnp.abs(innovation) <= limit) & ~shifted & yaw.explained
        forced = compared & jnp.any(measured & ~explained)
        missing = jnp.where(measured, 0, state.missing + 1)

        xi = jnp.where(measured, observed, expected)
        xi = jnp.where(late, expected + earlier.difference_now, xi)

        skewed = compared & usable[HEADING] & ~(measured[LATERAL] & measured[HEADING])
        turned = observed[HEADING] - yaw.skew
        xi = put(xi, HEADING, jnp.where(skewed, turned, xi[HEADING]))
        # A believed outlier starts anew; noise is averaged.
        estimate = expected + self.gain * difference(xi, expected)
        estimate = jnp.where(compared & (plausible | ~measured), estimate, xi)
        here = jnp.append(estimate, preview.road[0, 0])[None]
        past = jnp.where(late, earlier.past, state.past)
        # What is believed although it is far off starts anew.
        gain = jnp.where(shifted, 1.0, ALONG_GAIN)
        along = along + jnp.where(jnp.all(measured), gain * gap, 0.0)
        after = state._replace(
            missing=missing,
            skew=jnp.where(skewed, yaw.skew, 0.0),
            aside=jnp.where(skewed & measured[LATERAL], yaw.aside, 0.0),
            doubt=jnp.where(forced, round(self.trial / self.dt), state.doubt),
            past=jnp.concatenate([here, past[:-1]]),
        )
        lost = (missing > jnp.round(longest)) & ~usable
        return Believed(xi, measured, along, jnp.any(lost), after)

    def _refuses(self, state: GateState) -> Bool[Array, ""]:
        """Return whether a position from another place of the path is refused.

        It is not for ever: the vehicle may have slid, and has stopped by then. Nor is
        it before it is known where the vehicle was: the first positions may be old.
        """
        longest = round(PATIENCE_AHEAD / self.dt)
        return (jnp.max(state.missing) < longest) & all_finite(state.past)

    def _expected_along(self, state: GateState, preview: Preview) -> Scalar:
        """Return the expected place on the path [m]; as observed where none is."""
        points = preview.reference
        _, along = place_on(state.place, points, curvature_ahead(points))
        return jnp.where(jnp.isfinite(along), along, preview.along)

    def _yaw(
        self,
        state: GateState,
        innovation: PathState,
        limit: Scalar,
        on_time: Bool[Array, ""],
    ) -> Yaw:
        """Return whether a yaw is believed, and by which angle it else is wrong.

        A yaw that is wrong stays wrong by the same angle, and so does a yaw relative to
        the wrong place of a bend. Its changes are therefore still measured. One that
        goes on changing is that of a vehicle that turns, as on ice. If the yaw was
        right and what was believed before it is wrong, the vehicle comes aside of its
        prediction by that angle.

        Args:
            state: of the gate after the last step.
            innovation: of ξ.
            limit: of the heading [rad].
            on_time: whether the last call was one period ago.
        """
        # Where no model predicted, the noise of its innovations says nothing.
        largest_turn = self.tests.largest_turn(state.tests)
        largest_turn = jnp.where(state.modelled & on_time, largest_turn, jnp.inf)
        turned = innovation[HEADING]
        skewed = state.skew != 0.0
        gap = jnp.abs(wrap_angle(turned - state.skew))
        stays = skewed & (gap <= jnp.minimum(limit, SAME_TURN * largest_turn))
        skew = jnp.where(stays, state.skew, turned)
        # Otherwise it was the position that was refused.
        refused = skewed & (state.missing[HEADING] > 0)
        # It is believed again once it is nearer to right than wrong.
        largest = jnp.where(refused & stays, 0.5 * jnp.abs(skew), largest_turn)
        jumped = (jnp.abs(turned) > largest) & (stays | ~refused)
        aside = state.aside + COURSE_WEIGHT * (innovation[LATERAL] - state.aside)
        way = jnp.abs(state.expected[PATH_SPEED]) * self.dt
        half = jnp.maximum(0.5 * jnp.abs(skew) * way, COURSE_NOISE)
        confirmed = refused & stays & (aside * jnp.sign(skew) > half)
        plausible = (jnp.abs(turned) <= limit) & ~jumped
        usual = jnp.ones(innovation.shape, bool)
        return Yaw(
            plausible=plausible | confirmed,
            explained=put(usual, HEADING, jnp.abs(turned) <= largest_turn),
            skew=skew,
            aside=aside,
        )

    def _earlier(
        self, state: GateState, xi: PathState, curvature: Scalar, gap: Scalar
    ) -> Earlier:
        """Return the measurement as one of the earlier step at its place.

        Args:
            state: of the gate after the last step.
            xi: observed ξ.
            curvature: of the path here [1/m].
            gap: from the predicted position to the observed one, along the path [m].
        """
        past = state.past[:, :-1]
        curvatures = state.past[:, -1]
        steps = self.dt * past[:, PATH_SPEED]
        behind = jnp.cumsum(steps)
        miss = jnp.nan_to_num(jnp.abs(behind + gap), nan=jnp.inf)
        which = jnp.argmin(miss)
        # ξ is relative to the circle of the road here, which was another one there.
        turned = jnp.cumsum((curvatures - curvature) * steps)
        then = past[which]
        then = put(then, HEADING, then[HEADING] - turned[which])
        then = put(then, LATERAL, then[LATERAL] + jnp.cumsum(turned * steps)[which])
        off = difference(xi, then)
        near = miss[which] <= 0.6 * jnp.abs(steps[which]) + 0.1
        off = jnp.where(near, off, jnp.nan)
        # Rates of the body decay. An error of the heading stays, and moves the vehicle
        # sideways on its way from there.
        lasting = jnp.where(np.arange(len(off)) > PATH_SPEED, 0.0, off)

        def after(distance: Scalar) -> PathState:
            return put(lasting, LATERAL, lasting[LATERAL] + distance * off[HEADING])

        later = jnp.arange(len(behind)) <= which
        change = self.gain * jax.vmap(after)(behind[which] - behind)
        corrected = past + jnp.where(later[:, None], change, 0.0)
        return Earlier(
            difference=off,
            difference_now=after(behind[which]),
            past=jnp.concatenate([corrected, curvatures[:, None]], axis=1),
        )

    def _slack(
        self, state: GateState, periods: Scalar, on_time: Bool[Array, ""]
    ) -> Scalar:
        """Return how far a position may be ahead or behind along the path [m]."""
        way = jnp.abs(state.expected[PATH_SPEED]) * self.dt
        # Between calls that are not one period apart the way is not known.
        share = jnp.where(on_time, SLIP, 1.0 + SLIP) * jnp.maximum(periods, 1.0)
        unseen = 1.0 + self.growth * jnp.max(state.missing)
        return (share * way + ALONG_NOISE) * unseen

    def _reach(self, state: GateState, periods: Scalar) -> Scalar:
        """Return how far the vehicle gets in a step, and somewhat more [m]."""
        speed = jnp.abs(state.expected[PATH_SPEED])
        way = (1.0 + SLIP) * speed * self.dt + ALONG_NOISE
        return way * jnp.maximum(periods, 1.0)

    def _limit(
        self, state: GateState, periods: Scalar, on_time: Bool[Array, ""]
    ) -> Float[Array, " coordinate"]:
        """Return the largest difference that one step explains, entry by entry."""
        # What a vehicle can reach in a step without knowing its model: sideways what
        # it drives, and more than any tyre turns, accelerates and slides.
        rest = [jnp.inf] * (state.expected.shape[0] - 3)
        wide = jnp.asarray([0.0, 0.35, 1.5, *rest]) * jnp.maximum(periods, 1.0)
        wide = put(wide, LATERAL, self._reach(state, periods))
        if self.box is None:
            return wide
        low, high = map(jnp.asarray, self.box)
        tight = jnp.minimum(0.5 * self.share * (high - low), wide)
        return jnp.where(state.modelled & on_time, tight, wide)


def _overdue(
    long_missing: Bool[Array, " coordinate"], plausible: Bool[Array, " coordinate"]
) -> Bool[Array, " coordinate"]:
    """Return what is believed because it has been implausible for so long.

    It is then true, and the prediction was wrong. A yaw alone is never believed for
    that reason: the position would show it.
    """
    heading = long_missing[HEADING] & ~plausible[LATERAL]
    return put(long_missing, HEADING, heading)


def difference(xi: PathState, other: PathState) -> PathState:
    """Return ξ − ξ', with the heading wrapped."""
    gap = xi - other
    return put(gap, HEADING, wrap_angle(gap[HEADING]))
