"""What a control step reports besides its control."""

from __future__ import annotations

from typing import Required, TypeAlias, TypedDict

from jaxtyping import Array, Bool, Float, Int

Scalar: TypeAlias = Float[Array, ""]


class ControllerInfo(TypedDict, total=False):
    """Diagnostics of a control step: planners give the first six, wrappers add keys."""

    cost: Required[Scalar]  # lowest cost of all samples
    mean_cost: Required[Scalar]  # cost of the chosen plan
    effective_samples: Required[Scalar]  # 1 / Σ w²; NaN if nothing is sampled
    healthy: Required[Bool[Array, ""]]  # False: the last finite plan is continued
    env_inside: Required[Bool[Array, ""]]  # whether e is in its box
    predicted_states: Required[Float[Array, "horizon state"]]  # of the chosen plan
    # planners with info_level="samples", of all candidates
    sample_costs: Float[Array, " sample"]
    sample_weights: Float[Array, " sample"]  # in the chosen plan
    sample_plans: Float[Array, "horizon sample control"]  # allowed perturbations
    sample_states: Float[Array, "horizon sample state"]  # predicted
    # planners of a constrained task
    violation: Scalar  # the largest of a constraint along the chosen plan, not below 0
    constraints_kept: Bool[Array, ""]  # it is 0
    # planners with gain_samples
    gains: Float[Array, "control state"]  # du/dx of the plan, see `between_plans`
    # koopman_mpc
    residual: Scalar  # of the quadratic program, in control units
    # monitored
    breach: Bool[Array, ""]  # a disturbance exceeds its bound
    box_exit: Bool[Array, ""]  # (s, u, e) is outside its box
    breaches: Int[Array, ""]  # number of steps with a breach so far
    box_exits: Int[Array, ""]  # number of steps with a box exit so far
    disturbance: Float[Array, " 4"]  # latent [-], position [m], yaw [rad], body state
    fallback_active: Bool[Array, ""]
    # estimated
    env_estimate: Float[Array, " environment"]  # mean over the hypotheses
    env_spread: Float[Array, " environment"]  # standard deviation over the hypotheses
    # adaptive, with env_estimate
    causes: Float[Array, " 5"]  # force, steering, drive; steering and force in turns
    causes_std: Float[Array, " 5"]  # standard deviations of the estimates
    rejected: Bool[Array, ""]  # nothing was learned from the measurement
    adapting: Bool[Array, ""]  # the causes do not predict worse than none
    weights_changed: Bool[Array, ""]  # since the first step
    # online_tube
    tube: Float[Array, " horizon"]  # radius around the plan [m]
    tube_errors: Float[Array, " horizon"]  # of the plans of 1 … horizon steps ago [m]
    tube_missed: Bool[Array, " horizon"]  # an error exceeds the radius it had
    online_corridor: Scalar  # largest |e_y| of the plan with its tube [m]
    speed_factor: Scalar  # of the reference speed at the next step
    grip: Scalar  # lateral acceleration that was shown [m/s²]; 0: not limited
    # delay_compensated
    arrival_state: Float[
        Array, " state"
    ]  # predicted state at which the control arrives
    # shielded
    margin: Scalar  # distance of the nominal copy to the edge of its corridor [m]
    intervention: Scalar  # share of the request that was removed, in [0, 1]
    perturbation: Float[
        Array, " control"
    ]  # ν applied on top of the law, in control units
    copy: Float[Array, " coordinate"]  # path coordinates of the nominal copy
    copy_distance: Scalar  # |e_y| between vehicle and copy [m]
    corridor: Scalar  # certified half width [m]
    feasible: Bool[Array, ""]  # margin is not negative
    broken: Bool[Array, ""]  # copy_distance exceeds the certified bound
    void: Bool[Array, ""]  # outside the boxes of the certificate
    dead_reckoning: Bool[Array, ""]  # observation or reference is not finite
    request_finite: Bool[Array, ""]  # the filtered controller gave a finite control
    interventions: Int[Array, ""]  # number of steps with an intervention so far
    broken_steps: Int[Array, ""]  # number of broken steps so far
    shield_healthy: Bool[Array, ""]  # feasible, and the certificate applies
