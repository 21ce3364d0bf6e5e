"""Model predictive control with a predictor that is linear in a lifted state: one box-constrained QP a step."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._path_errors import path_errors, reference_curvature
from sfkd_jax.control.planners._box_qp import box_qp
from sfkd_jax.control.planners._plans import all_finite, shift
from sfkd_jax.control.tasks._path_tracking import check_path
from sfkd_jax.core.se2 import between, compose
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Controller,
    Environment,
    Key,
    LinearPredictor,
    Model,
    Params,
    Reference,
    Scalar,
    State,
)

REGULARISATION = 1e-7
"""Share of the largest diagonal entry that is added to H, so that it is positive
definite in float32.
"""


class KoopmanMpcState(NamedTuple):
    """What the controller carries from one control step to the next.

    Attributes:
        plan: u_0 … u_{T-1}, shifted.
        previous: the control applied last.
        started: whether there was one.
    """

    plan: Float[Array, "horizon control"]
    previous: Control
    started: Bool[Array, ""]


class Condensed(NamedTuple):
    """x_k = free_k + (gain u)_k, k = 1 … T, with u = u_0 … u_{T-1} in a row."""

    free: Float[Array, "horizon state"]
    gain: Float[Array, "horizon state inputs"]


def koopman_mpc(
    model: Model,
    *,
    dt: float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    speed_loop: bool = False,
    horizon: int = 20,
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
    """Condensed linear MPC in the lift, warm-started with the shifted plan; the cost is that of `tracking_cost`.

        min_u Σ_k q_y e_y² + q_c (Δe_y / v dt)² + q_v e_v² + q_δ̇ (Δδ / dt)² + q_a a²   subject to   low ≤ u_k ≤ high,
        z_0 = lift(e_y, e_ψ, s),   z_{k+1} = A(e) z_k + B(e) u_k + d(e) κ_k + c(e),   (e_y, e_ψ, s)_k = C z_k + o

    The path enters through its curvature, previewed; e is held over the horizon. At most 2 T variables are left, and
    `box_qp` solves for them. The states are predictions alone and have no bounds, so every QP is feasible.

    What is not finite never enters the plan: if the observation, environment, reference
    or solution is not, the plan before it is continued and `info["healthy"]` is False.

    Args:
        model: with `linear`.
        dt: [s].
        control_low, control_high: actuator limits, in control units.
        speed_loop: whether the second control is a speed command; effort is then not
            charged.
        horizon: T.
        iterations: of the QP.
        lateral, course, speed, steering_rate, effort: weights as in `tracking_cost`.
        terminal_weight: of the last step, on top of its stage cost.
        env_low, env_high: environment box; an environment outside is clamped and
            flagged.

    Returns:
        A `Controller`; `info` has `cost` and `mean_cost` (both of the plan),
        `effective_samples` (NaN: none are drawn), `healthy`, `env_inside`,
        `predicted_states` (horizon, state), and the QP's `residual`.

    Raises:
        ValueError: the model has no linear predictor.

    Source: Korda and Mezić (2018), section 4.
    """
    linear = model.linear
    if linear is None:
        raise ValueError(
            "koopman_mpc needs a model that is linear in a lift (Model.linear)"
        )
    low, high = jnp.asarray(control_low), jnp.asarray(control_high)
    weights = jnp.asarray(
        [lateral, course, speed, steering_rate, 0.0 if speed_loop else effort]
    )
    by_step = jnp.ones(horizon).at[-1].add(terminal_weight)

    def init(key: Key) -> KoopmanMpcState:
        del key  # nothing is drawn; every controller has this signature
        return KoopmanMpcState(
            jnp.zeros((horizon, low.shape[0])), jnp.zeros_like(low), jnp.asarray(False)
        )

    def charged(
        found: Condensed,
        start: State,
        state: KoopmanMpcState,
        speeds: Float[Array, " horizon"],
    ) -> Any:
        """Rows (term, step) of what is squared, affine in u: gains, offsets, weights."""
        channels = jnp.eye(2 * horizon).reshape(horizon, 2, 2 * horizon)
        steering, drive = channels[:, 0], channels[:, 1]
        side, side_free = found.gain[:, 1], found.free[:, 1]
        travelled = speeds * dt + 1e-3
        gains = (
            side,
            jnp.diff(side, axis=0, prepend=0.0) / travelled[:, None],
            found.gain[:, 3],
            jnp.diff(steering, axis=0, prepend=0.0) / dt,
            drive,
        )
        offsets = (
            side_free,
            jnp.diff(side_free, prepend=start[1]) / travelled,
            found.free[:, 3] - speeds,
            jnp.zeros(horizon).at[0].set(-state.previous[0] / dt),
            jnp.zeros(horizon),
        )
        charges = (weights[:, None] * by_step).at[3, 0].multiply(state.started)
        return jnp.concatenate(gains), jnp.concatenate(offsets), charges.ravel()

    def act(
        params: Params,
        state: KoopmanMpcState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, KoopmanMpcState, dict[str, Array]]:
        check_path(observation, env, reference, horizon)
        clean = all_finite((observation, env, reference))
        inside = (
            env
            if env_low is None or env_high is None
            else jnp.clip(env, jnp.array(env_low), jnp.array(env_high))
        )
        curvature = reference_curvature(reference)
        errors = path_errors(observation, reference[0], curvature[0])
        start = observation.at[POSE].set(
            jnp.stack([jnp.zeros(()), errors.lateral, errors.heading])
        )
        found = _condense(
            linear(model.fiber(params, inside)), start, _between_points(curvature)
        )
        gains, offsets, charges = charged(found, start, state, reference[:, 3])
        H = 2 * gains.T @ (charges[:, None] * gains)
        H = H + REGULARISATION * jnp.max(jnp.diagonal(H)) * jnp.eye(H.shape[0])
        f = 2 * gains.T @ (charges * offsets)
        box = jnp.tile(low, horizon), jnp.tile(high, horizon)
        solution = box_qp(H, f, *box, state.plan.ravel(), iterations=iterations)
        cost = jnp.sum(charges * (gains @ solution.primal + offsets) ** 2)
        healthy = clean & jnp.isfinite(cost)

        plan = jnp.where(healthy, solution.primal.reshape(horizon, -1), state.plan)
        control = jnp.clip(plan[0], low, high)
        info = {
            "cost": cost,
            "mean_cost": cost,
            "effective_samples": jnp.asarray(jnp.nan),
            "healthy": healthy,
            "env_inside": jnp.all(inside == env),
            "predicted_states": _in_world(
                found.free + found.gain @ plan.ravel(),
                observation,
                reference,
                curvature,
            ),
            "residual": solution.residual,
        }
        return (
            control,
            KoopmanMpcState(
                shift(plan, jnp.ones(())), control, state.started | healthy
            ),
            info,
        )

    return Controller(init, act)


def _between_points(curvature: Float[Array, " horizon"]) -> Float[Array, " horizon"]:
    """Curvature driven through in each step; the first is that which `path_errors` reached back over."""
    return jnp.concatenate([curvature[:1], 0.5 * (curvature[1:] + curvature[:-1])])


def _condense(
    predictor: LinearPredictor, start: State, curvature: Float[Array, " horizon"]
) -> Condensed:
    """Eliminate the lift: the free response and the Toeplitz matrix of the impulse responses C Aᵏ B."""
    horizon = curvature.shape[0]

    def respond(
        carry: tuple[Array, Array], kappa: Scalar
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        z, impulse = carry
        z = predictor.A @ z + predictor.d * kappa + predictor.c
        return (z, predictor.A @ impulse), (
            predictor.C @ z + predictor.o,
            predictor.C @ impulse,
        )

    _, (free, impulses) = jax.lax.scan(
        respond, (predictor.lift(start), predictor.B), curvature
    )
    lag = jnp.arange(horizon)[:, None] - jnp.arange(horizon)
    gain = jnp.where((lag >= 0)[:, :, None, None], impulses[jnp.maximum(lag, 0)], 0.0)
    return Condensed(
        free, gain.transpose(0, 2, 1, 3).reshape(horizon, start.shape[0], -1)
    )


def _in_world(
    along_path: Float[Array, "horizon state"],
    observation: State,
    reference: Reference,
    curvature: Float[Array, " horizon"],
) -> Float[Array, "horizon state"]:
    """Predicted states in the world, each from the circle that touches the path at its reference point."""
    behind = between(reference[0, POSE], observation[POSE])[0]
    steps = jnp.hypot(*jnp.diff(reference[:, :2], axis=0).T)
    passed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])

    def place(
        state: State, point: Float[Array, " 4"], kappa: Scalar, travelled: Scalar
    ) -> State:
        ahead = behind + state[0] - travelled
        foot = jnp.stack([ahead, 0.5 * kappa * ahead**2, kappa * ahead])
        aside = jnp.stack([jnp.zeros(()), state[1], state[2]])
        return jnp.concatenate([compose(point[:3], compose(foot, aside)), state[BODY]])

    return jax.vmap(place)(along_path, reference, curvature, passed)
