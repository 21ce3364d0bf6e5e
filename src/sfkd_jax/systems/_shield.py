"""The shield of a system: it keeps a nominal model where its tubes are certified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import (
    Comparison,
    FilterResult,
    NominalModel,
    NominalState,
    Stateful,
    all_finite,
    safety_filter,
    size_of,
)
from sfkd_jax.info import Claim, ControllerInfo, Reason, ShieldInfo, first, reported
from sfkd_jax.ranges import AtLeastOne
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.systems._law import SteadyState
from sfkd_jax.systems._tracking import Error, Inputs
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    Environment,
    Key,
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
        nominal: of the nominal model.
        inputs: ρ of the last step.
    """

    inner: Any
    nominal: NominalState
    inputs: Inputs


class _Compared(NamedTuple):
    """The nominal model beside a measurement.

    Attributes:
        with_system: the comparison of |y − ŷ| of each output.
        error: ξ, as measured where it is, and of the nominal model elsewhere.
        running: whether there is a nominal model.
        kept: whether |ŷ| is within its bound now.
    """

    with_system: Comparison
    error: Error
    running: Bool[Array, ""]
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
      acts alone. A reading may leave that of ξ by the noise of the sensors.
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
        environments = len(tracked.system.environment)
        return ShieldState(
            inner=self.inner.init(key),
            nominal=self._nominal.init(key, len(tracked.names), environments),
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
        low, high = map(jnp.asarray, self.loop.tracked.system.env_box)
        last_env = state.nominal.env
        last_env = jnp.where(jnp.isfinite(last_env), last_env, 0.5 * (low + high))
        known_env = jnp.where(jnp.isfinite(env), env, last_env)
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
            (compared.with_system.exceeded, Reason.BOUND_EXCEEDED),
            (~passed.feasible | ~compared.kept, Reason.INFEASIBLE),
        )
        nominal = compared.with_system.nominal
        info = info._replace(
            plan=info.plan._replace(healthy=usable),
            claim=self._claim(reason),
            env_inside=jnp.all(inside == env),
            shield=ShieldInfo(
                margin=jnp.where(compared.running, passed.margin, jnp.nan),
                intervention=jnp.where(changed, 1.0 - passed.scale, 0.0),
                perturbation=control - law_control,
                nominal_state=jnp.where(compared.running, nominal.state, jnp.nan),
                nominal_distance=compared.with_system.distance,
                rolling=jnp.zeros(()),
            ),
        )
        effective = control - steady.feedback(compared.error)
        after = ShieldState(
            inner=inner,
            nominal=self._after(compared, effective, inside, known[0], reason),
            inputs=known[0],
        )
        return control, after, info

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
            compared.with_system.nominal.fiber,
            compared.with_system.nominal.latent,
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

    @property
    def _nominal(self) -> NominalModel:
        """The model that the shield keeps inside its bounds."""
        return NominalModel(self.model, self._rows)

    def _compare(
        self,
        params: Params,
        state: ShieldState,
        error: Error,
        env: Environment,
        steady: SteadyState,
    ) -> _Compared:
        """Return the nominal model beside a measurement."""
        started = state.nominal.started
        nominal = self._nominal.carried(params, state.nominal, env)
        # Before the first measurement the system is taken to follow its reference.
        expected = jnp.where(started, nominal.state, steady.state)
        complete = jnp.where(jnp.isfinite(error), error, expected)
        measured = all_finite(error)
        noise = SIGMAS * jnp.asarray(self.loop.tracked.system.sensor_noise)
        allowed = [
            bound.tube + size_of(noise, rows)
            for bound, rows in zip(self.bounds.values(), self._rows, strict=True)
        ]
        compared = self._nominal.compare(
            nominal, complete, jnp.stack(allowed), started=started, measured=measured
        )
        sizes = [size_of(compared.nominal.state, rows) for rows in self._rows]
        widths = jnp.asarray([bound.nominal for bound in self.bounds.values()])
        return _Compared(
            with_system=compared,
            error=complete,
            running=started | measured,
            kept=jnp.all(jnp.stack(sizes) <= (1.0 + ROUNDING) * widths),
        )

    def _outside(self, error: Error, inputs: Inputs) -> Bool[Array, ""]:
        """Return whether ξ or ρ is outside of its box."""
        # The box of ξ is that of true states, and a reading has noise.
        noise = SIGMAS * jnp.asarray(self.loop.tracked.system.sensor_noise)
        boxes = (
            (self.box, error, noise),
            (self.loop.tracked.frame.input_box, inputs, 0.0),
        )
        outside = jnp.asarray(False)
        for (low, high), point, inexact in boxes:
            lower = jnp.asarray(low)
            upper = jnp.asarray(high)
            room = ROUNDING * (upper - lower) + inexact
            inside = (lower - room <= point) & (point <= upper + room)
            outside |= ~jnp.all(inside)
        return outside

    def _after(
        self,
        compared: _Compared,
        nu: Control,
        env: Environment,
        inputs: Inputs,
        reason: Array,
    ) -> NominalState:
        """Return the nominal model one sampling period later."""
        nominal = compared.with_system.nominal
        given = jnp.concatenate([nu, inputs])
        latent = self.model.step(nominal.fiber, nominal.latent, given)
        goes_on = (reason == Reason.CERTIFIED) | (reason == Reason.INFEASIBLE)
        # Where a reading or an input is missing, the nominal model goes on with what is
        # known; nothing is claimed meanwhile.
        goes_on |= compared.running & (reason <= Reason.NOT_MEASURED)
        return NominalState(latent, goes_on & all_finite(latent), env)

    def _claim(self, reason: Array) -> Claim:
        """Return what is claimed of this step: a bound of |y| for each output."""
        bounds = [bound.tube + bound.nominal for bound in self.bounds.values()]
        holds = reason == Reason.CERTIFIED
        return Claim(jnp.where(holds, jnp.asarray(bounds), jnp.nan), reason)


ROUNDING = 1e-3
"""Share of a box by which a value may exceed it, since references are differences."""
