"""Linear model predictive control in a lifted state: one box-constrained QP a step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._path_errors import path_errors, reference_curvature
from sfkd_jax.control.planners._box_qp import box_qp
from sfkd_jax.control.planners._condensed import condense, condensed_cost, to_world
from sfkd_jax.control.planners._plans import all_finite, clip_environment, shift
from sfkd_jax.control.tasks._path_tracking import check_path
from sfkd_jax.control.tasks._task import PlanningStart
from sfkd_jax.ranges import AtLeastTwo
from sfkd_jax.types import (
    POSE,
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Fiber,
    Key,
    LinearPredictor,
    Model,
    Params,
    Reference,
    State,
)

REGULARISATION = 1e-7
"""Fraction of the largest diagonal entry of H that is added to its diagonal, so that H
is positive definite in float32.
"""


class KoopmanMpcState(NamedTuple):
    """What the controller carries from one control step to the next.

    Attributes:
        plan: u_0 … u_{T-1}, shifted.
        previous: the control applied last.
        started: whether a control was planned before.
    """

    plan: Float[Array, "horizon control"]
    previous: Control
    started: Bool[Array, ""]


class _Settings(NamedTuple):
    """Settings of `koopman_mpc` as its functions need them."""

    model: Model
    linear: Callable[[Fiber], LinearPredictor]
    dt: float
    low: Control
    high: Control
    horizon: int
    iterations: int
    weights: Float[Array, " term"]
    step_weights: Float[Array, " horizon"]
    env_low: tuple[float, ...] | None
    env_high: tuple[float, ...] | None


def koopman_mpc(
    model: Model,
    *,
    dt: float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    speed_loop: bool = False,
    horizon: AtLeastTwo = 20,
    iterations: int = 12,
    lateral: float = 200.0,
    course: float = 20.0,
    speed: float = 1.0,
    steering_rate: float = 5.0,
    effort: float = 0.02,
    terminal_weight: float = 1.0,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
) -> Controller:
    """Return the condensed linear MPC of a lifted state, under `tracking_cost`.

        min_u Σ_k q_y e_y² + q_c (Δe_y / v dt)² + q_v e_v² + q_δ̇ (Δδ / dt)² + q_a a²
        subject to   low ≤ u_k ≤ high,   z_0 = lift(e_y, e_ψ, s),
                     z_{k+1} = A(e) z_k + B(e) u_k + d(e) κ_k + c(e),
                     (e_y, e_ψ, s)_k = C z_k + o

    The path enters through its previewed curvature, and e is constant over the horizon.
    Eliminating the states leaves at most 2 T variables; `box_qp` solves for them, warm
    started with the shifted plan. Only controls have bounds, so every QP is feasible.

    Values that are not finite never enter the plan. If the observation, environment,
    reference or solution is not finite, the controller continues the last plan and
    `info["healthy"]` is False.

    Args:
        model: with `structure.linear`.
        dt: sampling period [s].
        control_low: lower control limits.
        control_high: upper control limits.
        speed_loop: whether the second control is a speed command; `effort` is then
            ignored.
        horizon: T, number of steps.
        iterations: of the QP solver.
        lateral: q_y, as in `tracking_cost`.
        course: q_c, as in `tracking_cost`.
        speed: q_v, as in `tracking_cost`.
        steering_rate: q_δ̇, as in `tracking_cost`.
        effort: q_a, as in `tracking_cost`.
        terminal_weight: added to the weight of the last step.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.

    Returns:
        A `Controller`; `info` has `cost` and `mean_cost` (both of the plan),
        `effective_samples` (NaN), `healthy`, `env_inside`, `predicted_states` (horizon,
        state), and the `residual` of the QP.

    Raises:
        ValueError: the model has no linear predictor.

    Source: Korda and Mezić (2018), section 4.
    """
    linear = model.structure.linear
    if linear is None:
        raise ValueError(
            "koopman_mpc needs a model that is linear in a lift (Structure.linear)"
        )
    settings = _Settings(
        model=model,
        linear=linear,
        dt=dt,
        low=jnp.asarray(control_low),
        high=jnp.asarray(control_high),
        horizon=horizon,
        iterations=iterations,
        weights=jnp.asarray(
            [lateral, course, speed, steering_rate, 0.0 if speed_loop else effort]
        ),
        step_weights=jnp.ones(horizon).at[-1].add(terminal_weight),
        env_low=env_low,
        env_high=env_high,
    )
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> KoopmanMpcState:
    """The state before the first control step: a plan of zeros."""
    del key  # nothing is random
    low = settings.low
    return KoopmanMpcState(
        plan=jnp.zeros((settings.horizon, low.shape[0])),
        previous=jnp.zeros_like(low),
        started=jnp.asarray(False),
    )


def _act(
    settings: _Settings,
    params: Params,
    state: KoopmanMpcState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, KoopmanMpcState, ControllerInfo]:
    """One control step."""
    model, horizon = settings.model, settings.horizon
    low, high = settings.low, settings.high
    check_path(observation, env, reference, horizon)
    clean = all_finite((observation, env, reference))
    inside = clip_environment(env, settings.env_low, settings.env_high)
    curvature = reference_curvature(reference)
    errors = path_errors(observation, reference[0], curvature[0])
    start = observation.at[POSE].set(
        jnp.stack([jnp.zeros(()), errors.lateral, errors.heading])
    )
    predictor = settings.linear(model.fiber(params, inside))
    prediction = condense(predictor, start, curvature)
    cost = condensed_cost(
        prediction,
        start,
        reference[:, 3],
        PlanningStart(state.previous, state.started),
        weights=settings.weights,
        step_weights=settings.step_weights,
        dt=settings.dt,
    )
    H = 2 * cost.gains.T @ (cost.weights[:, None] * cost.gains)
    H = H + REGULARISATION * jnp.max(jnp.diagonal(H)) * jnp.eye(H.shape[0])
    f = 2 * cost.gains.T @ (cost.weights * cost.offsets)
    box = jnp.tile(low, horizon), jnp.tile(high, horizon)
    solution = box_qp(H, f, *box, state.plan.ravel(), iterations=settings.iterations)
    rows = cost.gains @ solution.primal + cost.offsets
    total = jnp.sum(cost.weights * rows**2)
    healthy = clean & jnp.isfinite(total)

    plan = jnp.where(healthy, solution.primal.reshape(horizon, -1), state.plan)
    control = jnp.clip(plan[0], low, high)
    predicted = prediction.free + prediction.gain @ plan.ravel()
    info: ControllerInfo = {
        "cost": total,
        "mean_cost": total,
        "effective_samples": jnp.asarray(jnp.nan),
        "healthy": healthy,
        "env_inside": jnp.all(inside == env),
        "predicted_states": to_world(predicted, observation, reference, curvature),
        "residual": solution.residual,
    }
    after = KoopmanMpcState(shift(plan, jnp.ones(())), control, state.started | healthy)
    return control, after, info
