"""What a controller reports of a control step, and what it claims.

`ControllerInfo` is a record with one part for each layer of a controller, see
ARCHITECTURE.md. A layer that is not there leaves its part None.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Scalar = Float[Array, ""] | float
Flag = Bool[Array, ""] | bool


class Reason(IntEnum):
    """Why a bound holds in a control step, or why none does.

    If there are several reasons, a step reports the first of them: those of the inputs,
    then those of the measurement, then those of the certificate.
    """

    CERTIFIED = 0
    NO_CERTIFICATE = 1
    NOT_CALIBRATED = 2
    ROLLING = 3
    BAD_REFERENCE = 4
    IMPRECISE = 5
    BAD_ENVIRONMENT = 6
    OFF_SCHEDULE = 7
    NOT_MEASURED = 8
    ALARM = 9
    TRIAL = 10
    NOT_STARTED = 11
    OUTSIDE_BOX = 12
    BOUND_EXCEEDED = 13
    BRAKING = 14
    INFEASIBLE = 15
    EVADING = 16
    REVERSING = 17

    @property
    def advice(self) -> str:
        """What the reason means, and what to do about it."""
        return _ADVICE[self]


_ADVICE = {
    Reason.CERTIFIED: "The bound of the certificate holds.",
    Reason.NO_CERTIFICATE: "The controller has no certified corridor: certify it.",
    Reason.NOT_CALIBRATED: (
        "The corridor is that of a model of logs, and not of the system itself: record "
        "runs of the system, and collect them. Or it is that of another latency: "
        "certify with the latency of the system."
    ),
    Reason.ROLLING: (
        "The system is slower than the certificate covers; the bound goes on from its "
        "last value."
    ),
    Reason.BAD_REFERENCE: "The reference is not finite, or nothing could follow it.",
    Reason.IMPRECISE: (
        "The type of the positions does not resolve them: pass float64, or positions "
        "relative to a point nearby."
    ),
    Reason.BAD_ENVIRONMENT: "The environment is not finite; its last value is used.",
    Reason.OFF_SCHEDULE: "The last call was not one sampling period ago.",
    Reason.NOT_MEASURED: (
        "A part of the state is missing, implausible or late, and is predicted."
    ),
    Reason.ALARM: (
        "The innovations are not those of the calibration: the system or its sensors "
        "have changed."
    ),
    Reason.TRIAL: (
        "A measurement that nothing explains was believed a short time ago, or another "
        "latency was found; the claim returns if what follows agrees with it."
    ),
    Reason.NOT_STARTED: "No complete measurement has come yet.",
    Reason.OUTSIDE_BOX: (
        "State, reference or environment is outside the boxes of the certificate: "
        "check their units; the law returns alone."
    ),
    Reason.BOUND_EXCEEDED: (
        "The system is farther from its nominal model than the certificate allows: the "
        "bound does not hold for this system."
    ),
    Reason.BRAKING: "The planner brakes harder than the certificate covers.",
    Reason.INFEASIBLE: "The law alone does not keep the nominal model in its corridor.",
    Reason.EVADING: (
        "It evades outside the certified references, or did so a short time ago."
    ),
    Reason.REVERSING: (
        "It backs up before something that is too near to turn away from; no "
        "certificate covers driving backwards."
    ),
}


def first(
    reason: Int[Array, ""] | int, *others: tuple[Flag, Int[Array, ""] | int]
) -> Int[Array, ""]:
    """Return a reason, or the first other one that applies where it is CERTIFIED.

    Args:
        reason: what is known so far.
        others: (whether it applies, reason), in order.
    """
    known = jnp.asarray(reason)
    for applies, other in others:
        known = jnp.where((known == Reason.CERTIFIED) & applies, other, known)
    return known


class Claim(NamedTuple):
    """What a controller claims of a control step.

    Attributes:
        bound: of |e_y|, the distance from the reference [m]; NaN where none holds.
        reason: a `Reason`.
    """

    bound: Scalar = math.nan
    reason: Int[Array, ""] | int = Reason.NO_CERTIFICATE

    @property
    def holds(self) -> Any:
        """Whether there is a bound."""
        return jnp.isfinite(self.bound)

    def under(self, reason: Int[Array, ""]) -> Claim:
        """Return the claim of a layer inside, under what an outer layer knows.

        Args:
            reason: CERTIFIED if the outer layer has nothing against the claim.
        """
        return Claim(
            bound=jnp.where(reason == Reason.CERTIFIED, self.bound, jnp.nan),
            reason=first(reason, (True, self.reason)),
        )

    def unless(self, applies: Flag, reason: Reason) -> Claim:
        """Return the claim, withdrawn for this reason where it applies."""
        return Claim(
            bound=jnp.where(applies, jnp.nan, self.bound),
            reason=jnp.where(applies, reason, self.reason),
        )


class PlanInfo(NamedTuple):
    """The plan of a step, from the planner.

    Attributes:
        cost: the lowest cost of all samples.
        mean_cost: the cost of the chosen plan.
        effective_samples: 1 / Σ w² of the sample weights; NaN if nothing is sampled.
        healthy: whether a working planner gave this plan, and not an earlier step.
        states: predicted along the chosen plan, (horizon, state); in the world where
            the controller sees the world, and ξ where it sees ξ.
        violation: the largest value of a constraint along the chosen plan; None for a
            task without constraints.
    """

    cost: Scalar = math.nan
    mean_cost: Scalar = math.nan
    effective_samples: Scalar = math.nan
    healthy: Flag = True
    states: Any = None
    violation: Scalar | None = None


class PathInfo(NamedTuple):
    """The projection onto the path, from `path_following.along_reference`.

    Attributes:
        xi: measured ξ, (coordinate,); NaN where it is not measured.
        inputs: of this step from the reference, (input,); along a path they are κ [1/m]
            and v_ref [m/s].
        planned: predicted ξ along the chosen plan, (horizon, coordinate).
    """

    xi: Float[Array, " coordinate"]
    inputs: Float[Array, " input"]
    planned: Float[Array, "horizon coordinate"] | None


class GateInfo(NamedTuple):
    """What `path_following.Gate` made of the measurement.

    Attributes:
        measured: which entries of ξ are measured and not predicted, (coordinate,).
        innovation: measured less predicted ξ, (coordinate,); NaN without a comparison.
        statistic: of the test of the innovations, above 1 an alarm; NaN without a test.
        alarm: whether system or sensors are not those of the calibration.
        later: periods by which commands act later than stated, as estimated.
    """

    measured: Bool[Array, " coordinate"]
    innovation: Float[Array, " coordinate"]
    statistic: Scalar
    alarm: Flag
    later: Scalar


class AdaptationInfo(NamedTuple):
    """What `path_following.Adaptation` has estimated.

    Attributes:
        env: the e that the planner reads, (environment,).
        causes: the unmeasured causes in the order of the adaptation, (cause,).
        causes_std: their standard deviations, (cause,).
        rejected: whether nothing was learned from the measurement.
        adapting: whether the causes predict no worse than none; otherwise they are not
            used.
    """

    env: Float[Array, " environment"]
    causes: Float[Array, " cause"]
    causes_std: Float[Array, " cause"]
    rejected: Flag
    adapting: Flag


class ShieldInfo(NamedTuple):
    """What `path_following.Shield` let pass.

    Attributes:
        margin: distance of the nominal model to the edge of its corridor [m]; NaN
            without a nominal model.
        intervention: the removed share of the request; 0 if it passed, 1 outside the
            boxes or if the law returns alone.
        perturbation: ν on top of the law, in control units.
        nominal_state: ξ of the nominal model, (coordinate,).
        nominal_distance: |e_y| between system and nominal model [m]; NaN without a
            comparison.
        rolling: the part of the bound by which it has grown where the system is slower
            than the certificate covers [m].
    """

    margin: Scalar
    intervention: Scalar
    perturbation: Float[Array, " control"]
    nominal_state: Float[Array, " coordinate"]
    nominal_distance: Scalar
    rolling: Scalar


class Candidates(NamedTuple):
    """References like those that a search compares, to be shown.

    Attributes:
        position: of their points [m], (candidate, 2, point).
        admissible: which of them could be committed, (candidate,).
    """

    position: Float[Array, "*candidate 2 point"]
    admissible: Bool[Array, "*candidate"]


class LaneInfo(NamedTuple):
    """The reference that `path_following.InLane` chose.

    Attributes:
        reference: the window that is followed, (horizon, 4).
        offset: of the reference from the centre line [m].
        clearance: distance from all obstacles along the whole committed reference [m],
            except for those who follow; NaN where no bound holds.
        edge: what the edges of the lane leave beyond what is needed, along the whole
            committed reference [m]; negative where the lane is too narrow.
        admissible: whether the committed reference is free, and inside class and lane.
        stopping: whether it ends at rest.
        evading: whether it is outside the class.
        waiting: whether it ends at rest before something that is in the way.
        reversing: whether it goes backwards, away from that, see `Reversing`.
        candidates: that were drawn to be shown; None where none were asked for.
    """

    reference: Float[Array, "horizon 4"]
    offset: Scalar
    clearance: Scalar
    edge: Scalar
    admissible: Flag
    stopping: Flag
    evading: Flag
    waiting: Flag = False
    reversing: Flag = False
    candidates: Candidates | None = None


class ControllerInfo(NamedTuple):
    """Diagnostics of a control step; a part is None without the layer that gives it.

    Attributes:
        plan: of the planner.
        claim: what is claimed of the step, and why.
        env_inside: whether e is finite and in its box.
        path: the projection onto the path.
        gate: the check of the measurement.
        adaptation: the estimates.
        shield: the safety filter.
        lane: the choice of a reference.
        gap: true distance from the nearest obstacle, as a simulation knows it [m].
        planner: what a planner from outside this package reports, see `Policy.shield`.
    """

    plan: PlanInfo = PlanInfo()
    claim: Claim = Claim()
    env_inside: Flag = True
    path: PathInfo | None = None
    gate: GateInfo | None = None
    adaptation: AdaptationInfo | None = None
    shield: ShieldInfo | None = None
    lane: LaneInfo | None = None
    gap: Scalar | None = None
    planner: Any = None

    @property
    def healthy(self) -> Any:
        """Whether the control is the plan of a working planner, as it was planned.

        All inputs are then measured and in time, the step is inside the conditions of
        the certificate if there is one, and the shield changed nothing.
        """
        # The reasons up to this one say what was certified, and not that a step failed.
        healthy = self.plan.healthy & (self.claim.reason <= Reason.NOT_CALIBRATED)
        if self.shield is not None:
            healthy = healthy & (self.shield.intervention == 0.0)
        return healthy


def reported(info: Any) -> ControllerInfo:
    """Return what a controller reports; that of one from outside becomes a part.

    Args:
        info: `ControllerInfo`, or anything else; an entry `healthy` of a dictionary
            counts.
    """
    if isinstance(info, ControllerInfo):
        return info
    healthy = info.get("healthy", True) if isinstance(info, dict) else True
    return ControllerInfo(plan=PlanInfo(healthy=healthy), planner=info)
