"""The shield of a system: it keeps a nominal model where its tubes are certified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import FilterResult, Stateful, all_finite, safety_filter, size_of
from sfkd_jax.geometry import without_pose
from sfkd_jax.info import Claim, ControllerInfo, Reason, ShieldInfo, first, reported
from sfkd_jax.ranges import AtLeastOne
from sfkd_jax.rollout import fold
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.systems._law import SteadyState
from sfkd_jax.systems._tracking import Error, Inputs
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    Environment,
    Key,
    Latent,
    Model,
    Params,
)

SIGMAS = 4.0
"""Standard deviations of a sensor within which a measured output is."""


class OutputBound(NamedTuple):
    """What is certified of one output, in its unit.

    Attributes:
        tube: of |y − ŷ|, between system and nominal model.
        nominal: of |ŷ|, which the shield keeps.
    """

    tube: float
    nominal: float


class ShieldState(NamedTuple):
    """The wrapped controller and the nominal model between two control steps.

    Attributes:
        inner: state of the wrapped controller.
        latent: of the nominal model, in the fibre of `env`.
        started: whether the nominal model is running. Otherwise it starts anew at the
            next measurement.
        env: e of the last step, in its box.
        inputs: ρ of the last step.
    """

    inner: Any
    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    inputs: Inputs


class _Compared(NamedTuple):
    """The nominal model beside a measurement.

    Attributes:
        error: ξ, as measured where it is, and of the nominal model elsewhere.
        latent: of the nominal model, which starts anew where it has to.
        fiber: of e.
        running: whether there is a nominal model.
        distance: |y − ŷ| of each output; NaN without a comparison.
        exceeded: whether a distance is larger than what is certified.
        kept: whether |ŷ| is within its bound now.
    """

    error: Error
    latent: Latent
    fiber: Any
    running: Bool[Array, ""]
    distance: Float[Array, " output"]
    exceeded: Bool[Array, ""]
    kept: Bool[Array, ""]


@dataclass(frozen=True, kw_only=True)
class Shield(Stateful):
    """A wrapper around a planner that keeps a nominal model inside its bounds.

        ν = u − law(ξ; ρ_0, e),   ν' = safety_filter(ν)
        u' = clip(law(ξ; ρ_0, e) + ν'),   ẑ⁺ = F(ẑ; (ν', ρ_0), e)
        |ŷ| ≤ nominal,   |y| ≤ nominal + tube

    ẑ is the nominal model. It is driven with the inputs of the system and is not
    corrected by measurements. A control whose request passes unchanged is returned as
    it is.

    - If the planner is not healthy, or its control is not finite, the law acts alone.
    - Outside the boxes of ξ, ρ or e (OUTSIDE_BOX) nothing is certified, and the law
      acts alone.
    - If |y − ŷ| exceeds the tube by more than the noise of the sensors
      (BOUND_EXCEEDED), the bound does not hold for this system.
    - After any of these the nominal model starts anew at the next measurement.
    - Entries of ξ that are not finite are those of the nominal model (NOT_MEASURED). If
      ρ or e is not finite, its last value is used.

    Attributes:
        inner: controller whose `act` takes ξ and ρ in place of observation and
            reference; its control is u.
        loop: the closed loop that the model is of.
        model: that is certified.
        bounds: of each output.
        box: lower and upper ends of ξ inside of which the errors were measured.
        horizon: number of steps over which the law alone is predicted.
    """

    inner: Controller
    loop: ClosedLoop
    model: Model
    bounds: Mapping[str, OutputBound]
    box: tuple[tuple[float, ...], tuple[float, ...]]
    horizon: AtLeastOne = 20

    def init(self, key: Key) -> ShieldState:
        """Return the state before the first control step."""
        tracked = self.loop.tracked
        low, high = map(jnp.asarray, tracked.system.env_box)
        middle = 0.5 * (low + high)

        def encode(params: Params) -> Latent:
            fiber = self.model.fiber(params, middle)
            return self.model.encode(fiber, without_pose(jnp.zeros(len(tracked.names))))

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, jax.eval_shape(self.model.init, key))
        return ShieldState(
            inner=self.inner.init(key),
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent),
            started=jnp.asarray(False),
            env=middle,
            inputs=jnp.mean(jnp.asarray(tracked.frame.input_box), axis=0),
        )

    def act(
        self,
        params: Params,
        state: ShieldState,
        error: Error,
        env: Environment,
        inputs: Float[Array, "horizon inputs"],
    ) -> tuple[Control, ShieldState, ControllerInfo]:
        """Take one control step."""
        known_env = jnp.where(jnp.isfinite(env), env, state.env)
        low, high = map(jnp.asarray, self.loop.tracked.system.env_box)
        inside = jnp.clip(known_env, low, high)
        known = jnp.where(jnp.isfinite(inputs), inputs, state.inputs)
        steady = self.loop.law.at(known[0], inside)
        compared = self._compare(params, state, error, inside, steady)
        planned, inner, info = self.inner.act(
            params, state.inner, compared.error, inside, known
        )
        info = reported(info)
        outside = self._outside(compared.error, known[0]) | jnp.any(inside != known_env)
        law_control = self.loop.limited(steady.feedback(compared.error))
        usable = all_finite(planned) & info.plan.healthy & ~outside
        planned = self.loop.limited(planned)
        request = jnp.where(usable, planned - law_control, 0.0)
        passed = self._passed(compared, request, known)
        changed = jnp.any(passed.nu != request)
        filtered = self.loop.limited(law_control + passed.nu)
        control = jnp.where(usable & ~changed, planned, filtered)
        reason = first(
            Reason.CERTIFIED,
            (~jnp.all(jnp.isfinite(inputs)), Reason.BAD_REFERENCE),
            (~jnp.all(jnp.isfinite(env)), Reason.BAD_ENVIRONMENT),
            (~jnp.all(jnp.isfinite(error)), Reason.NOT_MEASURED),
            (~compared.running, Reason.NOT_STARTED),
            (outside, Reason.OUTSIDE_BOX),
            (compared.exceeded, Reason.BOUND_EXCEEDED),
            (~passed.feasible | ~compared.kept, Reason.INFEASIBLE),
        )
        after = self._after(params, compared, control, steady, known[0], reason)
        latent = self.model.decode(compared.fiber, compared.latent)[BODY]
        info = info._replace(
            plan=info.plan._replace(healthy=usable),
            claim=self._claim(reason),
            env_inside=jnp.all(inside == env),
            shield=ShieldInfo(
                margin=jnp.where(compared.running, passed.margin, jnp.nan),
                intervention=jnp.where(changed, 1.0 - passed.scale, 0.0),
                perturbation=control - law_control,
                nominal_state=jnp.where(compared.running, latent, jnp.nan),
                nominal_distance=compared.distance,
                rolling=jnp.zeros(()),
            ),
        )
        return control, after._replace(inner=inner, env=inside, inputs=known[0]), info

    def _passed(
        self,
        compared: _Compared,
        request: Control,
        inputs: Float[Array, "horizon inputs"],
    ) -> FilterResult:
        """Return what passes of a request."""
        limit = self.loop.law.perturbation
        last = inputs.shape[0] - 1
        return safety_filter(
            self.model,
            compared.fiber,
            compared.latent,
            request,
            inputs[jnp.minimum(jnp.arange(self.horizon), last)],
            limit,
            outputs=[[BODY.start + row for row in rows] for rows in self._rows],
            widths=[bound.nominal for bound in self.bounds.values()],
            backups=jnp.concatenate([jnp.diag(limit), -jnp.diag(limit)]),
        )

    @property
    def _rows(self) -> list[tuple[int, ...]]:
        """Entries of ξ of the outputs, in the order of the bounds."""
        return [self.loop.tracked.rows[name] for name in self.bounds]

    def _compare(
        self,
        params: Params,
        state: ShieldState,
        error: Error,
        env: Environment,
        steady: SteadyState,
    ) -> _Compared:
        """Return the nominal model beside a measurement."""
        model = self.model
        folded = fold(model, params)
        fiber = model.fiber(folded, env)
        before = model.fiber(folded, state.env)
        latent = model.transport(before, fiber, state.latent)
        nominal = model.decode(fiber, latent)[BODY]
        # Before the first measurement the system is taken to follow its reference.
        expected = jnp.where(state.started, nominal, steady.state)
        complete = jnp.where(jnp.isfinite(error), error, expected)
        measured = all_finite(error)
        noise = SIGMAS * jnp.asarray(self.loop.tracked.system.sensor_noise)
        distance = jnp.stack([size_of(complete - nominal, rows) for rows in self._rows])
        allowed = jnp.stack(
            [
                bound.tube + size_of(noise, rows)
                for bound, rows in zip(self.bounds.values(), self._rows, strict=True)
            ]
        )
        compared = state.started & measured
        # Written so that a distance of NaN exceeds the bound.
        exceeded = compared & ~jnp.all(distance <= allowed)
        starts = (~state.started & measured) | exceeded
        anchor = model.encode(fiber, without_pose(complete))
        now = jax.tree.map(partial(jnp.where, starts), anchor, latent)
        state_now = model.decode(fiber, now)[BODY]
        sizes = jnp.stack([size_of(state_now, rows) for rows in self._rows])
        widths = jnp.asarray([bound.nominal for bound in self.bounds.values()])
        return _Compared(
            error=complete,
            latent=now,
            fiber=fiber,
            running=state.started | starts,
            distance=jnp.where(compared, distance, jnp.nan),
            exceeded=exceeded,
            kept=jnp.all(sizes <= (1.0 + ROUNDING) * widths),
        )

    def _outside(self, error: Error, inputs: Inputs) -> Bool[Array, ""]:
        """Return whether ξ or ρ is outside of its box."""
        outside = jnp.asarray(False)
        boxes = ((self.box, error), (self.loop.tracked.frame.input_box, inputs))
        for (low, high), point in boxes:
            lower = jnp.asarray(low)
            upper = jnp.asarray(high)
            room = ROUNDING * (upper - lower)
            inside = (lower - room <= point) & (point <= upper + room)
            outside |= ~jnp.all(inside)
        return outside

    def _after(
        self,
        params: Params,
        compared: _Compared,
        control: Control,
        steady: SteadyState,
        inputs: Inputs,
        reason: Array,
    ) -> ShieldState:
        """Return the nominal model one sampling period later."""
        effective = control - steady.feedback(compared.error)
        given = jnp.concatenate([effective, inputs])
        latent = self.model.step(compared.fiber, compared.latent, given)
        goes_on = (reason == Reason.CERTIFIED) | (reason == Reason.INFEASIBLE)
        # Where a reading or an input is missing, the nominal model goes on with what is
        # known; nothing is claimed meanwhile.
        goes_on |= compared.running & (reason <= Reason.NOT_MEASURED)
        return ShieldState(
            inner=(),
            latent=latent,
            started=goes_on & all_finite(latent),
            env=jnp.zeros(0),
            inputs=inputs,
        )

    def _claim(self, reason: Array) -> Claim:
        """Return what is claimed of this step: a bound of |y| for each output."""
        bounds = [bound.tube + bound.nominal for bound in self.bounds.values()]
        holds = reason == Reason.CERTIFIED
        return Claim(jnp.where(holds, jnp.asarray(bounds), jnp.nan), reason)


ROUNDING = 1e-3
"""Share of a box by which a value may exceed it, since references are differences."""
