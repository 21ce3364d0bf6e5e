"""The gate of the measurements along a path: what one step cannot explain is not used.

There is one gate for all layers behind it. Estimator, shield and planner receive a
state, an environment and a road that are finite, and are told which coordinates were
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control import Stateful, all_finite
from sfkd_jax.driving.path_coordinates import HEADING, LATERAL, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.tasks._preview import (
    Preview,
    check_preview,
    road_from,
    state_beside,
)
from sfkd_jax.driving.path_following.wrappers._estimator import input_error
from sfkd_jax.driving.path_following.wrappers._innovations import turning_rate
from sfkd_jax.driving.path_following.wrappers._measurement_tests import (
    MeasurementTests,
    TestsState,
)
from sfkd_jax.driving.path_following.wrappers._plausibility import (
    LATEST,
    Believed,
    GateState,
    Plausibility,
    difference,
)
from sfkd_jax.driving.path_following.wrappers._prediction import Prediction
from sfkd_jax.info import ControllerInfo, GateInfo, Reason, first, reported
from sfkd_jax.latency import ON_TIME, CommandDelay
from sfkd_jax.ranges import AtLeastOne, Fraction, Positive, check_intervals
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    POSE,
    Control,
    Controller,
    Environment,
    Key,
    Params,
    Scalar,
)

NO_TESTS = MeasurementTests()
"""No test: nothing raises an alarm."""
SETTLING = 1.0
"""Time without a claim after another latency was found [s]."""
SLOWING = 0.8
"""Speed [m/s] by which the reference of a lost vehicle is below the vehicle's speed."""


class Inputs(NamedTuple):
    """The inputs of a step, with what is not finite replaced.

    Attributes:
        xi: observed ξ; NaN where it is not known.
        env: finite e.
        preview: with a finite road.
        periods: sampling periods since the last call.
        env_known: whether e was finite, or is not read.
    """

    xi: PathState
    env: Environment
    preview: Preview
    periods: Scalar
    env_known: Bool[Array, ""]

    @property
    def reason(self) -> Int[Array, ""]:
        """CERTIFIED if nothing was replaced, and the last call was one period ago."""
        return first(
            self.preview.reason,
            (~self.env_known, Reason.BAD_ENVIRONMENT),
            (~self.preview.on_time, Reason.OFF_SCHEDULE),
        )


class Expected(NamedTuple):
    """What is expected of the next step.

    Attributes:
        xi: predicted ξ.
        modelled: whether the model predicted it, inside the conditions.
        place: predicted position in the world [m].
        tests: state of the tests, with what the next measurement is compared with.
    """

    xi: PathState
    modelled: Bool[Array, ""]
    place: Float[Array, " 2"]
    tests: TestsState


@dataclass(frozen=True, kw_only=True)
class Gate(Stateful):
    """A controller along a path that follows plausible measurements only.

        ξ⁻ = F(ξ̂; u − law(ξ̂), κ, v_ref, e),   |ξ_i − ξ⁻_i| ≤ limit_i
        ξ̂ = ξ⁻ + L (ξ − ξ⁻) where ξ_i passes, else ξ⁻

    A coordinate is replaced by ξ⁻ if it does not pass, is not finite, or belongs to an
    observation that repeats the last one bit for bit while the vehicle moves. The
    vehicle then drives on the prediction, with the other coordinates measured. Of the
    yaw of a wrong pose the changes are still used.

    The place along the path is predicted from the speed, in the world, so a position
    that stands still or jumps along the path does not pass either, while a reference
    may begin anywhere. `inner` is shown the road from the believed place on. An
    observation that lies behind on the path, where the vehicle was up to 1.2 s ago, is
    late. It corrects the estimates since then.

    After `patience` a finite measurement is believed, whatever it says, and the
    certificate is not claimed for a `trial`. If there is none, or there have been late
    ones for 6 s, the reference speed falls, and the vehicle stops.

    Outside the conditions the limits are what a vehicle can reach. Far outside them,
    and without a box of ξ, ξ⁻ is that of a steady turn at this speed and steering.

    An environment or reference that is not finite is replaced by the last one, and by
    the middle of the box of e before the first one. The road moves on with every step.

    `info` gains `gate`, see `GateInfo`. What speaks against a claim is the `reason` of
    the preview that `inner` receives, and that of the claim: e or the reference is not
    finite, the last call was not one period ago, a coordinate is not measured, or there
    is an alarm or a trial.

    Attributes:
        inner: controller along a path.
        prediction: of the closed loop, around whose law the model was learned.
        horizon: number of steps of the preview.
        reads_env: whether `inner` reads the environment that it is given.
        tests: that raise alarms.
        delay: of the commands after an observation; `tests` may estimate its error.
        patience: longest time on the prediction [s].
        trial: time without a claim after an implausible measurement was believed [s].
        share: of the half widths of the box of ξ that one step may be off.
        gain: L of the estimate from which the next step is predicted.
        growth: of the limits per step without a measurement.
    """

    inner: Controller
    prediction: Prediction
    horizon: AtLeastOne
    reads_env: bool = True
    tests: MeasurementTests = NO_TESTS
    delay: CommandDelay = ON_TIME
    patience: Positive = 2.0
    trial: Positive = 10.0
    share: Positive = 0.55
    gain: Fraction = 0.8
    growth: Positive = 0.02

    def __post_init__(self) -> None:
        check_intervals(self)

    def init(self, key: Key) -> GateState:
        """Return the state before the first control step."""
        law = self.prediction.law
        size = law.gain.shape[-1]
        box = self.prediction.conditions.env
        if box is None:
            box = (law.low[2:], law.high[2:])
        steps = round(LATEST / self.prediction.dt)
        return GateState(
            inner=self.inner.init(key),
            expected=jnp.full(size, jnp.nan, dtype=float),
            modelled=jnp.asarray(False),
            place=jnp.full(2, jnp.nan, dtype=float),
            missing=jnp.zeros(size, jnp.int32),
            skew=jnp.zeros(()),
            aside=jnp.zeros(()),
            doubt=jnp.zeros((), jnp.int32),
            env=0.5 * jnp.sum(jnp.asarray(box, dtype=float), axis=0),
            road=jnp.zeros((self.horizon, 2)),
            tests=self.tests.init(),
            past=jnp.full((steps, size + 1), jnp.nan, dtype=float),
        )

    def act(
        self,
        params: Params,
        state: GateState,
        xi: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, GateState, ControllerInfo]:
        """Take one control step."""
        check_preview(xi, env, preview, self.horizon)
        inputs = self._replaced(state, xi, env, preview)
        preview = inputs.preview
        believed = self._plausibility.judge(state, inputs.xi, preview, inputs.periods)
        measured = believed.measured
        tests, statistic, alarm = self.tests.update(
            state.tests,
            inputs.xi,
            preview.observation,
            jnp.all(measured) & preview.on_time,
        )
        later = self.tests.later(tests)
        doubt = self._doubt(believed, later != self.tests.later(state.tests))
        reason = first(
            inputs.reason,
            (~jnp.all(measured), Reason.NOT_MEASURED),
            (alarm, Reason.ALARM),
            (doubt > 0, Reason.TRIAL),
        )
        road = self._road(preview, believed)
        shown = preview._replace(
            road=road,
            along=believed.along,
            later=later,
            measured=measured,
            reason=reason,
        )
        control, inner, info = self.inner.act(
            params, state.inner, believed.xi, inputs.env, shown
        )
        info = reported(info)
        expected = self._expect(params, inputs, believed, shown, control, info, tests)
        innovation = difference(inputs.xi, state.expected)
        innovation = jnp.where(measured, innovation, jnp.nan)
        info = info._replace(
            claim=info.claim.under(reason),
            env_inside=info.env_inside & inputs.env_known,
            gate=GateInfo(measured, innovation, statistic, alarm, later),
        )
        after = believed.state._replace(
            inner=inner,
            expected=expected.xi,
            modelled=expected.modelled,
            place=expected.place,
            doubt=jnp.maximum(doubt - 1, 0),
            env=inputs.env,
            road=road,
            tests=expected.tests,
        )
        return control, after, info

    def _doubt(self, believed: Believed, changed: Bool[Array, ""]) -> Int[Array, ""]:
        """Return the number of steps until the certificate may be claimed again.

        Args:
            believed: of the measurement.
            changed: whether another latency was found: what follows is another loop.
        """
        settling = round(SETTLING / self.prediction.dt)
        longer = jnp.maximum(believed.state.doubt, settling)
        return jnp.where(changed, longer, believed.state.doubt)

    @property
    def _plausibility(self) -> Plausibility:
        """The rules by which a measurement is believed."""
        return Plausibility(
            dt=self.prediction.dt,
            box=self.prediction.conditions.state,
            tests=self.tests,
            patience=self.patience,
            trial=self.trial,
            share=self.share,
            gain=self.gain,
            growth=self.growth,
        )

    def _road(self, preview: Preview, believed: Believed) -> Float[Array, "preview 2"]:
        """Return κ and v_ref from the believed place on.

        Of a lost vehicle it has speeds at which it brakes and stops. There is then
        nothing to believe and nothing to rely on.
        """
        road = road_from(preview, believed.along)
        slowing = jnp.maximum(believed.xi[PATH_SPEED] - SLOWING, 0.0)
        slower = jnp.where(believed.lost, jnp.minimum(road[:, 1], slowing), road[:, 1])
        return jnp.stack([road[:, 0], slower], axis=1)

    def _replaced(
        self,
        state: GateState,
        xi: PathState,
        env: Environment,
        preview: Preview,
    ) -> Inputs:
        """Return the inputs with the last finite ones in place of others."""
        readable = all_finite(preview.road)
        moved_on = jnp.concatenate([state.road[1:], state.road[-1:]])
        env_known = all_finite(env) | (not self.reads_env)
        periods = _elapsed(state.inner)
        on_time = jnp.abs(periods - 1.0) < 1e-3
        return Inputs(
            # Without the road a position is beside nothing.
            xi=jnp.where(readable, xi, jnp.nan),
            env=jnp.where(all_finite(env), env, state.env),
            preview=preview._replace(
                road=jnp.where(readable, preview.road, moved_on), on_time=on_time
            ),
            periods=periods,
            env_known=env_known,
        )

    def _expect(
        self,
        params: Params,
        inputs: Inputs,
        believed: Believed,
        shown: Preview,
        control: Control,
        info: ControllerInfo,
        tests: TestsState,
    ) -> Expected:
        """Return what is expected one step later.

        Args:
            params: of the model.
            inputs: of this step.
            believed: of the measurement.
            shown: to the controller.
            control: command of this step.
            info: of the controller; an estimator says in it what it estimates.
            tests: state of the tests after the measurement.
        """
        predict = self.prediction
        here = shown.road[0]
        env = inputs.env
        # What acts is the control and the input error that an estimator counteracts.
        error = jnp.zeros_like(control)
        if info.adaptation is not None:
            env = info.adaptation.env
            error = input_error(info.adaptation.causes, here)

        nearest = predict.conditions.nearest(env)
        turn = predict.law.turn(here[0], here[1], nearest)
        fiber = None
        # A model of which nothing is known must not overrule a measurement.
        if predict.conditions.state is not None:
            fiber = predict.model.fiber(fold(predict.model, params), nearest)
        starts, controls = self._starts(tests, believed, shown, control, error)
        unseen = (jnp.arange(len(starts)) == 0) & ~believed.measured[LATERAL]
        after = jax.vmap(partial(predict.step, fiber, turn, here))(
            starts, controls, unseen
        )
        estimate = starts[0]
        xi = starts[1]
        rate = turning_rate(predict.law, xi, controls[1], here, nearest)
        ahead = jnp.append(after.xi[1], xi[HEADING] + predict.dt * rate)
        clear = inputs.reason == Reason.CERTIFIED
        comparable = clear & jnp.all(believed.measured) & after.inside[1]
        ahead = jnp.where(comparable, ahead, jnp.nan)
        tests = self.tests.expect(tests, ahead, after.xi[2:], turn.level)
        along = believed.along + predict.progress(estimate, here)
        place = state_beside(after.xi[0], shown._replace(along=along))[:2]
        # In its own frame a vehicle does not move.
        moves = jnp.any(shown.observation[POSE] != 0.0)
        place = jnp.where(moves, place, jnp.nan)
        return Expected(after.xi[0], after.inside[0], place, tests)

    def _starts(
        self,
        tests: TestsState,
        believed: Believed,
        shown: Preview,
        control: Control,
        error: Control,
    ) -> tuple[Float[Array, "start coordinate"], Float[Array, "start control"]]:
        """Return the ξ to predict from, and what acts from there.

        These are the estimate, for the next step; ξ as it is, for the test; and the
        estimate of each observer, with the commands that it assumes.
        """

        def acting(later: Scalar | float) -> Control:
            return self.delay.acting(shown.sent, control, later=later)

        acts = acting(shown.later)
        starts = [believed.state.past[0, :-1], believed.xi]
        controls = [acts, acts + error]
        if self.tests.delay is not None and tests.delay is not None:
            starts += list(tests.delay.estimate)
            controls += [acting(later) + error for later in self.tests.delay.later]
        return jnp.stack(starts), jnp.stack(controls)


def _elapsed(state: Any) -> Scalar:
    """Return the periods since the last call, from the state of the planner inside."""
    while hasattr(state, "inner"):
        state = state.inner
    # Only a planner of this package has a clock; others are called every period.
    elapsed = state.tuning.elapsed if hasattr(state, "tuning") else jnp.ones(())
    return jnp.where(jnp.isnan(elapsed), 1.0, elapsed)
