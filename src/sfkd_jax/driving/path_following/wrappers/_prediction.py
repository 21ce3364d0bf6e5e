"""Prediction from the time of an observation to the time at which a command acts."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import Stateful, all_finite
from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    SMALLEST_SCALE,
    PathState,
    lengths_along,
)
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.driving.path_following.tasks._preview import (
    YAW,
    Preview,
    later,
    state_beside,
)
from sfkd_jax.driving.path_following.wrappers._conditions import ANYWHERE, Conditions
from sfkd_jax.driving.path_following.wrappers._innovations import expected_coordinates
from sfkd_jax.driving.path_following.wrappers._plausibility import difference
from sfkd_jax.geometry import put
from sfkd_jax.latency import CommandDelay
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

OUTSIDE = 0.5
"""Distance outside the box of ξ up to which the model predicts a vehicle that is not
seen, as a share of the width of the box.
"""
BEYOND = 3.0
"""Largest ν of which the model says what it does, in perturbations of the data. It is
more than 1, because a late command is that of another state.
"""


class PredictedStep(NamedTuple):
    """What is predicted of one step.

    Attributes:
        xi: ξ one step later.
        inside: whether the model says so: inside the conditions, and with a control
            that differs from the linear law hardly more than by what data and planners
            add to it. Beyond that no model was learned.
    """

    xi: PathState
    inside: Bool[Array, ""]


class Periods(NamedTuple):
    """What acts over the periods of a prediction.

    Attributes:
        road: κ [1/m] and v_ref [m/s].
        control: u; NaN where it is unknown, as before the first command.
        share: of the period that is predicted; the last period may be a part of one.
    """

    road: Float[Array, "period 2"]
    control: Float[Array, "period control"]
    share: Float[Array, " period"]


def periods_ahead(
    delay: CommandDelay,
    road: Float[Array, "preview 2"],
    sent: Float[Array, "step control"],
    later: Scalar | float = 0.0,
) -> Periods:
    """Return the periods from an observation until the first control acts.

    Args:
        delay: of the commands.
        road: from the observation on; its last row stands for those after it.
        sent: the commands that may still act, newest last.
        later: periods by which the commands act later than stated.
    """
    count = ceil(delay.first + delay.tolerance)
    # A control that acts before the first one is held: its next command is not known.
    controls = [delay.acting(sent, sent[-1], period, later) for period in range(count)]
    share = jnp.clip(delay.first + later - jnp.arange(count), 0.0, 1.0)
    rows = np.minimum(np.arange(count), len(road) - 1)
    return Periods(road[rows], jnp.stack(controls), share)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """The prediction of a closed loop by its model, under given commands.

    Attributes:
        model: of the closed loop, in path coordinates.
        law: around which the model was learned.
        dt: sampling period [s].
        conditions: where the model predicts. Outside, a vehicle turns as its steering
            does on a steady turn of the law, and keeps its speed.
    """

    model: Model
    law: PathLaw
    dt: float
    conditions: Conditions = ANYWHERE

    def ahead(
        self, fiber: Fiber, env: Environment, xi: PathState, periods: Periods
    ) -> tuple[PathState, Scalar]:
        """Return ξ after the periods, and the distance along the path [m].

        Args:
            fiber: of the model.
            env: e, inside its box.
            xi: at the beginning.
            periods: what acts.
        """

        def advance(xi: PathState, period: Periods) -> tuple[PathState, Scalar]:
            turn = self.law.turn(period.road[0], period.road[1], env)
            feedback = turn.feedback(xi)
            control = jnp.where(jnp.isnan(period.control), feedback, period.control)
            after = self.step(fiber, turn, period.road, xi, control).xi
            progress = self.progress(xi, period.road)
            change = difference(after, xi)
            return xi + period.share * change, period.share * progress

        xi, distances = jax.lax.scan(advance, xi, periods)
        return xi, jnp.sum(distances)

    def step(
        self,
        fiber: Fiber,
        turn: SteadyTurn,
        road: Float[Array, " 2"],
        xi: PathState,
        control: Control,
        unseen: Bool[Array, ""] | bool = False,
    ) -> PredictedStep:
        """Predict ξ one step later.

        Args:
            fiber: of the model; None if nothing is known of the model.
            turn: the steady turn on this road.
            road: κ [1/m] and v_ref [m/s].
            xi: now.
            control: that acts.
            unseen: whether ξ is itself predicted.
        """
        nu = control - turn.feedback(xi)
        coasting = self._turning(turn, xi, control, road)
        if fiber is None:
            return PredictedStep(coasting, jnp.asarray(False))
        after = expected_coordinates(self.model, fiber, xi, nu, road)
        finite = all_finite(after)
        usual = jnp.all(jnp.abs(nu) <= BEYOND * self.law.perturbation)
        linear = turn.is_linear(xi)
        covered = self.conditions.hold(xi, road)
        inside = covered & linear & usual & finite
        if self.conditions.state is not None:
            # A vehicle that is not seen drives on its model somewhat outside as well:
            # a steady turn would be worse.
            low, high = map(np.asarray, self.conditions.state)
            more = OUTSIDE * (high - low)
            near = jnp.all((low - more <= xi) & (xi <= high + more))
            covered |= unseen & near
        # The model continues the linear law for larger ν.
        believed = covered & linear & finite
        return PredictedStep(jnp.where(believed, after, coasting), inside)

    def progress(self, xi: PathState, road: Float[Array, " 2"]) -> Scalar:
        """Return the progress of one step [m], Δt v cos e_ψ / (1 − κ e_y)."""
        scale = jnp.maximum(1.0 - road[0] * xi[LATERAL], SMALLEST_SCALE)
        return self.dt * xi[PATH_SPEED] * jnp.cos(xi[HEADING]) / scale

    def _turning(
        self,
        turn: SteadyTurn,
        xi: PathState,
        control: Control,
        road: Float[Array, " 2"],
    ) -> PathState:
        """Return ξ one step later of a vehicle that keeps its speed and curvature."""
        path_turned = road[0] * self.progress(xi, road)
        turned = self.dt * xi[PATH_SPEED] * control[0] / turn.grip[0] - path_turned
        middle = xi[HEADING] + 0.5 * turned
        sideways = self.dt * xi[PATH_SPEED] * jnp.sin(middle)
        after = put(xi, LATERAL, xi[LATERAL] + sideways)
        return put(after, HEADING, xi[HEADING] + turned)


@dataclass(frozen=True, kw_only=True)
class Predictor(Stateful):
    """A controller along a path that acts on the state at which its command will act.

        ξ̂(t + d) = F(… F(ξ(t); u_{-n}) …; u_{-1}),   with the F of `prediction`

    The commands that were sent since the observation are known, so the model predicts
    what they do. The controller inside sees ξ̂ and the road from there on, as if nothing
    were late. It has no state of its own.

    Attributes:
        inner: controller along a path.
        prediction: of the closed loop.
        delay: of the commands after an observation; `Preview.later` is its error.

    Source: Smith (1957); Bekiaris-Liberis and Krstic (2013).
    """

    inner: Controller
    prediction: Prediction
    delay: CommandDelay

    def init(self, key: Key) -> Any:
        """Return the state before the first control step."""
        return self.inner.init(key)

    def act(
        self,
        params: Params,
        state: Any,
        xi: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, Any, Any]:
        """Take one control step."""
        predict = self.prediction
        nearest = predict.conditions.nearest(env)
        fiber = predict.model.fiber(fold(predict.model, params), nearest)
        delay = self.delay
        periods = periods_ahead(delay, preview.road, preview.sent, preview.later)
        ahead, distance = predict.ahead(fiber, nearest, xi, periods)
        passing = delay.first + preview.later
        # The preview is longer by the stated delay.
        count = len(preview.road) - ceil(delay.first)
        rows = jnp.arange(len(preview.reference))
        passed = jnp.interp(passing, rows, lengths_along(preview.reference))
        shown = preview._replace(
            road=later(preview.road, passing, count),
            reference=later(preview.reference, passing, count, angle=YAW),
            along=preview.along + distance - passed,
            # Inside nothing is on its way.
            sent=preview.sent[:0],
        )
        beside = state_beside(ahead, shown)
        # On time a planner in the world sees what the caller does, bit for bit.
        shown = shown._replace(
            observation=jnp.where(passing > 0.0, beside, preview.observation)
        )
        return self.inner.act(params, state, ahead, env, shown)
