"""The shield: it lets a planner's control pass as far as the corridor allows.

Everything that decides whether the planner's control may pass is here. In one control
step (`Shield.act`) the measurement, which passed the `Gate`, is compared with the
nominal model (`compare`), the request is scaled down as far as the corridor
needs (`corridor_filter`), and what may be claimed of the step is decided
(`Shield._claim`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control import (
    FilterResult,
    NominalModel,
    NominalState,
    Stateful,
    all_finite,
)
from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_FRAME,
    PATH_SPEED,
    PathState,
)
from sfkd_jax.driving.path_following.laws._feedback import holding
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.tasks._preview import Preview
from sfkd_jax.driving.path_following.wrappers._comparison import (
    Compared,
    ShieldState,
    compare,
)
from sfkd_jax.driving.path_following.wrappers._conditions import (
    ANYWHERE,
    Box,
    Conditions,
    check_box,
)
from sfkd_jax.driving.path_following.wrappers._corridor_filter import corridor_filter
from sfkd_jax.driving.path_following.wrappers._rolling import RollingCorridor
from sfkd_jax.info import Claim, ControllerInfo, Reason, ShieldInfo, first, reported
from sfkd_jax.ranges import AtLeastOne, Fraction, NonNegative, Positive, check_intervals
from sfkd_jax.types import Control, Controller, Environment, Key, Model, Params, Scalar


class Decision(NamedTuple):
    """What the shield lets pass of the planner's control.

    Attributes:
        control: to apply.
        usable: whether the planner is healthy and its control finite.
        passed: what passes of the request, with the nominal model one step later.
        changed: whether that is not the request itself.
        braking: whether the planner brakes harder than the class of the certificate.
    """

    control: Control
    usable: Bool[Array, ""]
    passed: FilterResult
    changed: Bool[Array, ""]
    braking: Bool[Array, ""]


@dataclass(frozen=True, kw_only=True)
class Shield(Stateful):
    """A wrapper around a planner that keeps a nominal model in its corridor.

        ν = u − law(ξ; κ_0, v_0, e),   ν' = corridor_filter(ν)
        u' = clip(law(ξ; κ_0, v_0, e) + ν'),   ẑ⁺ = F(ẑ; (ν', κ_0, v_0), e)
        |ê_y| ≤ width,   |e_y| ≤ width + tube + offset,   offset⁺ = decay · offset

    ẑ is the nominal model. It is driven with the inputs of the vehicle and is not
    corrected by measurements. `tube` is a certified bound of |e_y − ê_y|, and
    `corridor_filter` chooses ν'. A control whose request passes unchanged is returned
    bit for bit. Slew limits of the actuators are not considered. A shield belongs
    behind a `Gate`, which replaces what is not finite.

    - If the planner is not healthy, or its control is not finite, the law drives alone.
    - Outside the conditions (OUTSIDE_BOX) the certificate does not apply, and the law
      drives alone, back to the path.
    - A drive that is below the law's by more than the perturbation (BRAKING) passes
      everywhere, while the steering stays limited. The certificate does not apply.
    - If |e_y − ê_y| > tube + offset + noise_allowance (BOUND_EXCEEDED), the bound does
      not hold for this vehicle.
    - After any of these, and after steps that the gate did not measure or trust, the
      nominal model starts anew at the next measurement, with `offset` = start_error for
      the noise in that measurement.
    - If the car is slower than the conditions, down to rest and up again, the law
      drives alone, as it does outside of them. The corridor then goes on from its last
      value, if it had one, see `RollingCorridor`.
    - Before the first measurement there is no nominal model. The control of the wrapped
      controller passes, clipped to its limits, or is 0 if it is not finite.

    `info` gains `shield`, see `ShieldInfo`, and the `claim` of the step: the bound of
    |e_y|, or the `Reason` why none holds.

    Attributes:
        inner: any controller along a path; its control is u.
        model: of the closed loop, in path coordinates.
        law: around which the model was learned.
        width: of the nominal corridor to each side [m].
        tube: bound of |e_y − ê_y| [m].
        control: box of u.
        horizon: number of steps over which the law alone is predicted. Beyond the
            preview, its last curvature and speed are used.
        noise_allowance: error of a measured e_y that is added to the tube [m].
        start_error: `offset` of a nominal model that starts at a measurement [m].
        decay: of `offset` per step, the certified rate.
        conditions: where the certificate applies.
        dt: sampling period [s].
        rear: distance from the rear axle to the position of the vehicle [m], see
            `RollingCorridor`.
        late: pairs of periods and tube [m], rising: the bounds for vehicles that are
            later than stated by up to so many periods. Nothing is claimed of vehicles
            that are still later, or less late than the first pair (NOT_CALIBRATED).
        claimed: whether `width` and `tube` are known of the vehicle itself. If they are
            known only of a model of it, nothing is claimed (NOT_CALIBRATED).

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
    late: tuple[tuple[float, float], ...] = ()
    claimed: bool = True

    def __post_init__(self) -> None:
        if self.model.frame is not PATH_FRAME:
            raise ValueError(
                "a shield needs a model in path coordinates: model.frame=path"
            )
        check_intervals(self)
        states = self.law.gain.shape[-1]
        environments = len(self.law.low) - 2
        check_box("control", self.control, 2)
        check_box("env", self.conditions.env, environments)
        check_box("state", self.conditions.state, states)
        check_box("road", self.conditions.road, 2)

    def init(self, key: Key) -> ShieldState:
        """Return the state before the first control step."""
        environments = len(self.law.low) - 2
        return ShieldState(
            inner=self.inner.init(key),
            nominal=self._nominal.init(key, self.law.gain.shape[-1], environments),
            offset=jnp.zeros(()),
            rolling=jnp.full((), jnp.nan, dtype=float),
        )

    def act(
        self,
        params: Params,
        state: ShieldState,
        xi: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, ShieldState, ControllerInfo]:
        """Take one control step."""
        planned, inner, info = self.inner.act(params, state.inner, xi, env, preview)
        tube = self._tube(preview.later)
        road = self._road(preview)
        inside = self.conditions.nearest(env)
        turn = self.law.turn(road[0, 0], road[0, 1], inside)
        law_control = turn.feedback(xi)
        compared = compare(
            self._nominal,
            params,
            state,
            xi,
            env,
            preview,
            turn,
            conditions=self.conditions,
            allowed=tube + self.noise_allowance,
            start_error=self.start_error,
        )
        nominal = compared.with_vehicle.nominal
        started = compared.started
        info = reported(info)
        decision = self._decide(
            compared, planned, info.plan.healthy, law_control, xi, road
        )
        reason = self._reason(compared, decision, preview)
        claim = self._claim(reason, state.rolling, compared.offset, xi, preview, tube)
        passed = decision.passed
        removed = jnp.where(compared.outside_box, 1.0, 1.0 - passed.scale)
        rolls = claim.reason == Reason.ROLLING
        added = claim.bound - self.width - tube
        info = info._replace(
            plan=info.plan._replace(healthy=decision.usable),
            claim=claim,
            env_inside=compared.env_inside,
            shield=ShieldInfo(
                margin=jnp.where(started, passed.margin, jnp.nan),
                intervention=jnp.where(started & decision.changed, removed, 0.0),
                perturbation=passed.nu,
                nominal_state=jnp.where(started, nominal.state, jnp.nan),
                nominal_distance=compared.with_vehicle.distance[0],
                rolling=jnp.where(rolls, added, 0.0),
            ),
        )
        growth = self._rolling.growth(xi, road[0], turn.state[HEADING])
        after = ShieldState(
            inner=inner,
            nominal=self._after(compared, passed, inside, reason),
            offset=self.decay * compared.offset,
            rolling=claim.bound + growth,
        )
        return decision.control, after, info

    @staticmethod
    def _after(
        compared: Compared,
        passed: FilterResult,
        env: Environment,
        reason: Int[Array, ""],
    ) -> NominalState:
        """Return the nominal model one sampling period later.

        After a step without the certificate it starts anew, and so it does where its
        latent is not finite, since it would stay so.
        """
        covered = (reason == Reason.CERTIFIED) | (reason == Reason.INFEASIBLE)
        running = covered & all_finite(passed.latent)
        now = compared.with_vehicle.nominal.latent
        latent = jax.tree.map(partial(jnp.where, running), passed.latent, now)
        return NominalState(latent, running, env)

    def _tube(self, later: Scalar) -> Scalar:
        """Return the bound for a vehicle that is later by some periods [m].

        It is infinite if none is known.
        """
        tube = jnp.full_like(later, jnp.inf)
        for periods, bound in reversed(self.late):
            tube = jnp.where(later <= periods, bound, tube)
        tube = jnp.where(later == 0.0, self.tube, tube)
        least = min(0.0, self.late[0][0]) if self.late else 0.0
        return jnp.where(later < least, jnp.inf, tube)

    @property
    def _nominal(self) -> NominalModel:
        """The model that the shield keeps in its corridor."""
        return NominalModel(self.model, ((LATERAL,),))

    @property
    def _rolling(self) -> RollingCorridor:
        """The corridor below the speeds of the conditions."""
        return RollingCorridor(self.law, self.conditions, self.dt, self.rear)

    def _decide(
        self,
        compared: Compared,
        planned: Control,
        healthy: Bool[Array, ""] | bool,
        law_control: Control,
        xi: PathState,
        road: Float[Array, "preview 2"],
    ) -> Decision:
        """Return the control to apply: that of the planner as far as it may pass."""
        started = compared.started
        nominal = compared.with_vehicle.nominal
        # A plan that goes on with an old one is worse than the law, which sees the car.
        usable = all_finite(planned) & healthy
        planned = self._within_limits(jnp.where(all_finite(planned), planned, 0.0))
        request = jnp.where(usable, self._request(planned, law_control), 0.0)
        # Outside the conditions no request is admissible: the law drives alone.
        limit = jnp.where(compared.outside_box, 0.0, self.law.perturbation)
        passed = corridor_filter(
            self.model,
            nominal.fiber,
            nominal.latent,
            request,
            road,
            limit,
            width=self.width,
        )
        changed = jnp.any(passed.nu != request)
        # A request that passes is returned bit for bit, not as law + (u − law).
        limited = self._within_limits(law_control + passed.nu)
        control = jnp.where(started & (~usable | changed), limited, planned)
        # Whoever brakes harder than the class has a reason that no certificate knows.
        gentlest = self._within_limits(law_control) - self.law.perturbation
        braking = usable & started & (planned[1] < gentlest[1] - 1e-3)
        drive = jnp.where(braking, planned[1], control[1])
        drive = self._held(started, drive, xi[PATH_SPEED], road[0, 1])
        control = jnp.stack([control[0], drive])
        return Decision(control, usable, passed, changed, braking)

    def _reason(
        self, compared: Compared, decision: Decision, preview: Preview
    ) -> Int[Array, ""]:
        """Return what speaks against a claim in this step; CERTIFIED if nothing does.

        Whether the nominal model stays inside comes last.
        """
        return first(
            preview.reason,
            (~jnp.all(preview.measured), Reason.NOT_MEASURED),
            (~compared.started, Reason.NOT_STARTED),
            (compared.outside_box | ~compared.env_inside, Reason.OUTSIDE_BOX),
            (compared.with_vehicle.exceeded, Reason.BOUND_EXCEEDED),
            (decision.braking, Reason.BRAKING),
            (~decision.passed.feasible, Reason.INFEASIBLE),
        )

    def _claim(
        self,
        reason: Int[Array, ""],
        rolling: Scalar,
        offset: Scalar,
        xi: PathState,
        preview: Preview,
        tube: Scalar,
    ) -> Claim:
        """Return what is claimed of this step.

        Args:
            reason: from `_reason`.
            rolling: bound of |e_y| at this step, whatever steers [m].
            offset: what the start adds to the bound of |e_y − ê_y| [m].
            xi: measured ξ.
            preview: of the road.
            tube: of a vehicle that is so late [m].
        """
        known = jnp.isfinite(tube) & self.claimed
        reason = first(reason, (~known, Reason.NOT_CALIBRATED))
        holds = reason == Reason.CERTIFIED
        certified = self.width + tube + offset
        measured = (preview.reason == Reason.CERTIFIED) & jnp.all(preview.measured)
        slow = self._rolling.applies(xi, self._road(preview)[0]) & known
        rolls = slow & measured & ~holds & jnp.isfinite(rolling)
        bound = jnp.where(holds, certified, jnp.nan)
        return Claim(
            bound=jnp.where(rolls, rolling, bound),
            reason=jnp.where(rolls, Reason.ROLLING, reason),
        )

    def _within_limits(self, control: Control) -> Control:
        """Return a control, clipped to its box."""
        low, high = map(jnp.asarray, self.control)
        return jnp.clip(control, low, high)

    def _request(self, planned: Control, law_control: Control) -> Control:
        """Return the smallest ν with clip(law + ν) = u.

        It is 0 where both reach the same limit.
        """
        low, high = map(jnp.asarray, self.control)
        above = (planned >= high) & (law_control >= high)
        below = (planned <= low) & (law_control <= low)
        return jnp.where(above | below, 0.0, planned - law_control)

    def _held(
        self, started: Bool[Array, ""], drive: Scalar, speed: Scalar, reference: Scalar
    ) -> Scalar:
        """Return the drive, which holds the car where the reference stands.

        A law would drive by the noise of the measured speed there, and the car creeps.
        """
        lowest = jnp.asarray(self.control[0])[1]
        still = jnp.clip(drive - holding(speed, reference), lowest, 0.0)
        return jnp.where(started & (reference == 0.0), still, drive)

    def _road(self, preview: Preview) -> Float[Array, "preview 2"]:
        """Return κ and v_ref over the horizon of the prediction."""
        last = preview.road.shape[0] - 1
        return preview.road[jnp.minimum(jnp.arange(self.horizon), last)]
