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
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control import Stateful, all_finite
from sfkd_jax.driving.path_coordinates import HEADING, LATERAL, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.driving.path_following.tasks._along_path import Preview, check_preview
from sfkd_jax.driving.path_following.wrappers._conditions import ANYWHERE, Conditions
from sfkd_jax.driving.path_following.wrappers._estimator import input_error
from sfkd_jax.driving.path_following.wrappers._innovations import (
    InnovationState,
    InnovationTest,
    expected_coordinates,
    turning_rate,
)
from sfkd_jax.driving.path_following.wrappers._plausibility import (
    LATEST,
    Believed,
    GateState,
    Plausibility,
    difference,
)
from sfkd_jax.geometry import put
from sfkd_jax.info import ControllerInfo, GateInfo, Reason, first, reported
from sfkd_jax.latency import ON_TIME, CommandDelay
from sfkd_jax.ranges import AtLeastOne, Fraction, Positive, check_intervals
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    Control,
    Controller,
    Environment,
    Fiber,
    Key,
    Model,
    Params,
    Scalar,
)

SLOWING = 0.8
"""Speed [m/s] by which the reference of a lost vehicle is below the vehicle's speed."""
OUTSIDE = 0.5
"""Distance outside the box of ξ up to which the model predicts a car that is not seen,
as a share of the width of the box.
"""


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


class Tested(NamedTuple):
    """The outcome of the test of the innovations, see `InnovationTest`."""

    state: InnovationState | None  # None without a test
    statistic: Scalar  # NaN without a test
    alarm: Bool[Array, ""]


class Expected(NamedTuple):
    """What is expected of the next step.

    Attributes:
        xi: predicted ξ.
        modelled: whether the model predicted it, inside the conditions.
        test: state of the test, with what the next measurement is compared with.
    """

    xi: PathState
    modelled: Bool[Array, ""]
    test: InnovationState | None


@dataclass(frozen=True, kw_only=True)
class Gate(Stateful):
    """A controller along a path that follows plausible measurements only.

        ξ⁻ = F(ξ̂; u − law(ξ̂), κ, v_ref, e),   |ξ_i − ξ⁻_i| ≤ limit_i
        ξ̂ = ξ⁻ + L (ξ − ξ⁻) where ξ_i passes, else ξ⁻

    A coordinate is replaced by ξ⁻ if it does not pass, is not finite, or belongs to an
    observation that repeats the last one bit for bit while the vehicle moves. The
    vehicle then drives on its nominal model, with the other coordinates measured. Of
    the yaw of a wrong pose the changes are still used. An observation that lies behind
    on the path, where the vehicle was up to 1.2 s ago, is late. It corrects the
    estimates since then.

    After `patience` a finite measurement is believed, whatever it says, and the
    certificate is not claimed for a `trial`. If there is none, or there have been late
    ones for 6 s, the reference speed falls, and the vehicle stops.

    Outside the conditions the limits are what a vehicle can reach. Far outside them,
    and without a box of ξ, ξ⁻ is that of a point that keeps its heading and speed.

    An environment or reference that is not finite is replaced by the last one, and by
    the middle of the box of e before the first one. The road moves on with every step.

    `info` gains `gate`, see `GateInfo`. What speaks against a claim is the `reason` of
    the preview that `inner` receives, and that of the claim: e or the reference is not
    finite, the last call was not one period ago, a coordinate is not measured, or there
    is an alarm or a trial.

    Attributes:
        inner: controller along a path.
        model: of the closed loop, in path coordinates.
        law: around which the model was learned.
        dt: sampling period [s].
        conditions: where the model predicts.
        horizon: number of steps of the preview.
        reads_env: whether `inner` reads the environment that it is given.
        test: of the innovations; it takes into account what `inner` estimates.
        delay: of the commands after an observation.
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
        size = self.law.gain.shape[-1]
        box = self.conditions.env
        if box is None:
            box = (self.law.low[2:], self.law.high[2:])
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
            test=None if self.test is None else self.test.init(),
            past=jnp.full((round(LATEST / self.dt), size + 1), jnp.nan, dtype=float),
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
        tested = self._tested(state, inputs, measured)
        reason = first(
            inputs.reason,
            (~jnp.all(measured), Reason.NOT_MEASURED),
            (tested.alarm, Reason.ALARM),
            (believed.state.doubt > 0, Reason.TRIAL),
        )
        road = self._slowed(preview.road, believed.xi[PATH_SPEED], believed.lost)
        shown = preview._replace(
            road=road, along=believed.state.along, measured=measured, reason=reason
        )
        control, inner, info = self.inner.act(
            params, state.inner, believed.xi, inputs.env, shown
        )
        info = reported(info)
        acting = self.delay.acting(preview.sent, control)
        expected = self._expect(
            params, inputs, believed, road, acting, info, tested.state
        )
        innovation = difference(inputs.xi, state.expected)
        info = info._replace(
            claim=info.claim.under(reason),
            env_inside=info.env_inside & inputs.env_known,
            gate=GateInfo(
                measured=measured,
                innovation=jnp.where(measured, innovation, jnp.nan),
                statistic=tested.statistic,
                alarm=tested.alarm,
            ),
        )
        after = believed.state._replace(
            inner=inner,
            expected=expected.xi,
            modelled=expected.modelled,
            doubt=jnp.maximum(believed.state.doubt - 1, 0),
            env=inputs.env,
            road=road,
            test=expected.test,
        )
        return control, after, info

    @property
    def _plausibility(self) -> Plausibility:
        """The rules by which a measurement is believed."""
        return Plausibility(
            dt=self.dt,
            box=self.conditions.state,
            patience=self.patience,
            trial=self.trial,
            share=self.share,
            gain=self.gain,
            growth=self.growth,
        )

    def _slowed(
        self, road: Float[Array, "preview 2"], speed: Scalar, lost: Bool[Array, ""]
    ) -> Float[Array, "preview 2"]:
        """Return the road; of a lost vehicle, with speeds at which it brakes and stops.

        There is then nothing to believe and nothing to rely on.
        """
        slower = jnp.minimum(road[:, 1], jnp.maximum(speed - SLOWING, 0.0))
        return jnp.stack([road[:, 0], jnp.where(lost, slower, road[:, 1])], axis=1)

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

    def _tested(
        self, state: GateState, inputs: Inputs, measured: Bool[Array, " coordinate"]
    ) -> Tested:
        """Return the outcome of the test, which reads complete measurements alone."""
        if self.test is None or state.test is None:
            return Tested(None, jnp.asarray(jnp.nan), jnp.asarray(False))
        used = measured & jnp.all(measured) & inputs.preview.on_time
        after, statistic = self.test.update(state.test, inputs.xi, used)
        return Tested(after, statistic, after.alarm)

    def _expect(
        self,
        params: Params,
        inputs: Inputs,
        believed: Believed,
        road: Float[Array, "preview 2"],
        control: Control,
        info: ControllerInfo,
        test: InnovationState | None,
    ) -> Expected:
        """Return what is expected one step later.

        Args:
            params: of the model.
            inputs: of this step.
            believed: of the measurement.
            road: that the controller was shown.
            control: that acts over the period after the measurement.
            info: of the controller; an estimator says in it what it estimates.
            test: state of the test of the innovations; None without one.
        """
        here = road[0]
        env = inputs.env
        # What acts is the control and the input error that an estimator counteracts.
        acting = control
        if info.adaptation is not None:
            env = info.adaptation.env
            acting = control + input_error(info.adaptation.causes, here)
        nearest = self.conditions.nearest(env)
        turn = self.law.turn(here[0], here[1], nearest)
        fiber = None
        if self.conditions.state is not None:
            fiber = self.model.fiber(fold(self.model, params), nearest)
        # From the estimate, for the next step; and from ξ as it is, for the test.
        xi = believed.xi
        unseen = ~believed.measured[LATERAL]
        after, inside, usual = jax.vmap(partial(self._onward, fiber, turn, here))(
            jnp.stack([believed.state.past[0, :-1], xi]),
            jnp.stack([control, acting]),
            jnp.stack([unseen, jnp.asarray(False)]),
        )
        if test is not None:
            rate = turning_rate(self.law, xi, acting, here, nearest)
            ahead = jnp.append(after[1], xi[HEADING] + self.dt * rate)
            clear = inputs.reason == Reason.CERTIFIED
            clear = clear & jnp.all(believed.measured)
            comparable = clear & inside[1] & usual[1]
            test = test._replace(
                expected=jnp.where(comparable, ahead, jnp.nan), level=turn.level
            )
        return Expected(after[0], inside[0], test)

    def _onward(
        self,
        fiber: Fiber,
        turn: SteadyTurn,
        road: Float[Array, " 2"],
        xi: PathState,
        control: Control,
        unseen: Bool[Array, ""],
    ) -> tuple[PathState, Bool[Array, ""], Bool[Array, ""]]:
        """Predict ξ one step later.

        Returns:
            ξ; whether the model says so, inside the conditions; whether the control
            differs from the law by no more than data and planners add to it. Beyond
            that no model was learned.
        """
        nu = control - turn.feedback(xi)
        usual = jnp.all(jnp.abs(nu) <= 1.01 * self.law.perturbation)
        sideways = self.dt * xi[PATH_SPEED] * jnp.sin(xi[HEADING])
        straight = put(xi, LATERAL, xi[LATERAL] + sideways)
        if self.conditions.state is None:
            # A model that nothing is known of must not overrule a measurement.
            return straight, jnp.asarray(False), usual
        ahead = expected_coordinates(self.model, fiber, xi, nu, road)
        inside = self.conditions.hold(xi, road) & all_finite(ahead)
        # A car that is not seen drives on its model somewhat outside as well: a point
        # that keeps its heading would be worse.
        low, high = map(np.asarray, self.conditions.state)
        more = OUTSIDE * (high - low)
        near = jnp.all((low - more <= xi) & (xi <= high + more)) & all_finite(ahead)
        return jnp.where(inside | (unseen & near), ahead, straight), inside, usual


def _elapsed(state: Any) -> Scalar:
    """Return the periods since the last call, from the state of the planner inside."""
    while hasattr(state, "inner"):
        state = state.inner
    # Only a planner of this package has a clock; others are called every period.
    elapsed = state.tuning.elapsed if hasattr(state, "tuning") else jnp.ones(())
    return jnp.where(jnp.isnan(elapsed), 1.0, elapsed)
