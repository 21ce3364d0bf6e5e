"""Linear model predictive control in a lifted state: one box-constrained QP a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import factory
from sfkd_jax.control.laws._feedback import path_errors
from sfkd_jax.control.planners._plans import all_finite, clip_environment, shift
from sfkd_jax.control.tasks._path_tracking import check_path
from sfkd_jax.control.tasks._task import PlanningStart
from sfkd_jax.geometry import between, compose, reference_curvature
from sfkd_jax.ranges import AtLeastTwo
from sfkd_jax.types import (
    BODY,
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
    Scalar,
    State,
)

HALVINGS = 12
"""Number of step lengths 1, 1/2, … tried along the projected Newton direction."""
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


@dataclass(frozen=True, eq=False)
class KoopmanMpc:
    """The condensed linear MPC of a lifted state, under `tracking_cost`.

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

    Attributes:
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

    Raises:
        ValueError: the model has no linear predictor.

    Source: Korda and Mezić (2018), section 4.
    """

    model: Model
    _: KW_ONLY
    dt: float
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]
    speed_loop: bool = False
    horizon: AtLeastTwo = 20
    iterations: int = 12
    lateral: float = 200.0
    course: float = 20.0
    speed: float = 1.0
    steering_rate: float = 5.0
    effort: float = 0.02
    terminal_weight: float = 1.0
    env_low: tuple[float, ...] | None = None
    env_high: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Raise a ValueError for a model without a linear predictor."""
        _ = self._linear

    @property
    def _linear(self) -> Callable[[Fiber], LinearPredictor]:
        if (linear := self.model.structure.linear) is not None:
            return linear
        raise ValueError(
            "koopman_mpc needs a model that is linear in a lift (Structure.linear)"
        )

    def controller(self) -> Controller:
        """Return the planner as two functions."""
        return Controller(self.init, self.act)

    def init(self, key: Key) -> KoopmanMpcState:
        """Return the state before the first control step: a plan of zeros."""
        del key  # nothing is random
        channels = len(self.control_low)
        return KoopmanMpcState(
            plan=jnp.zeros((self.horizon, channels)),
            previous=jnp.zeros(channels),
            started=jnp.asarray(False),
        )

    def act(
        self,
        params: Params,
        state: KoopmanMpcState,
        observation: State,
        env: Environment,
        reference: Reference,
    ) -> tuple[Control, KoopmanMpcState, ControllerInfo]:
        """Return the control of one step; `info` has the `residual` of the QP too."""
        horizon = self.horizon
        low, high = jnp.asarray(self.control_low), jnp.asarray(self.control_high)
        check_path(observation, env, reference, horizon)
        clean = all_finite((observation, env, reference))
        inside = clip_environment(env, self.env_low, self.env_high)
        curvature = reference_curvature(reference)
        errors = path_errors(observation, reference[0], curvature[0])
        # Progress counts from here: the predictor knows the path by its curvature only.
        start = observation.at[POSE].set(
            jnp.stack([jnp.zeros(()), errors.lateral, errors.heading])
        )
        predictor = self._linear(self.model.fiber(params, inside))
        effort = 0.0 if self.speed_loop else self.effort
        weights = jnp.asarray(
            [self.lateral, self.course, self.speed, self.steering_rate, effort]
        )
        prediction = condense(predictor, start, curvature)
        cost = condensed_cost(
            prediction,
            start,
            reference[:, 3],
            PlanningStart(state.previous, state.started),
            weights=weights,
            step_weights=jnp.ones(horizon).at[-1].add(self.terminal_weight),
            dt=self.dt,
        )
        H = 2 * cost.gains.T @ (cost.weights[:, None] * cost.gains)
        # A predictor that ignores a control leaves a zero row.
        H = H + REGULARISATION * jnp.max(jnp.diagonal(H)) * jnp.eye(H.shape[0])
        f = 2 * cost.gains.T @ (cost.weights * cost.offsets)
        box = jnp.tile(low, horizon), jnp.tile(high, horizon)
        solution = box_qp(H, f, *box, state.plan.ravel(), iterations=self.iterations)
        rows = cost.gains @ solution.primal + cost.offsets
        total = jnp.sum(cost.weights * rows**2)
        # A solution that did not converge is still inside the box, and used.
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
        after = KoopmanMpcState(
            shift(plan, jnp.ones(())), control, state.started | healthy
        )
        return control, after, info


class Prediction(NamedTuple):
    """The condensed prediction x_k = free_k + (gain u)_k, k = 1 … T.

    Attributes:
        free: response without control.
        gain: response to the stacked controls u_0 … u_{T-1}.
    """

    free: Float[Array, "horizon state"]
    gain: Float[Array, "horizon state inputs"]


class LeastSquares(NamedTuple):
    """The cost Σ_i w_i (g_iᵀ u + o_i)² of the stacked controls u.

    Attributes:
        gains: g_i.
        offsets: o_i.
        weights: w_i.
    """

    gains: Float[Array, "row inputs"]
    offsets: Float[Array, " row"]
    weights: Float[Array, " row"]


def condensed_cost(
    prediction: Prediction,
    start: State,
    speeds: Float[Array, " horizon"],
    previous: PlanningStart,
    *,
    weights: Float[Array, " term"],
    step_weights: Float[Array, " horizon"],
    dt: float,
) -> LeastSquares:
    """Return `tracking_cost` as squares of affine functions of the stacked controls.

    Args:
        prediction: of the states along the path.
        start: state along the path now.
        speeds: of the reference [m/s].
        previous: control, from which the first steering rate counts.
        weights: of lateral error, course, speed, steering rate and effort.
        step_weights: factor on all weights of each step.
        dt: sampling period [s].
    """
    horizon = speeds.shape[0]
    channels = jnp.eye(2 * horizon).reshape(horizon, 2, 2 * horizon)
    steering, drive = channels[:, 0], channels[:, 1]
    side, side_free = prediction.gain[:, 1], prediction.free[:, 1]
    # A millimetre more: finite at standstill, as in `tracking_cost`.
    travelled = speeds * dt + 1e-3
    gains = (
        side,
        jnp.diff(side, axis=0, prepend=0.0) / travelled[:, None],
        prediction.gain[:, 3],
        jnp.diff(steering, axis=0, prepend=0.0) / dt,
        drive,
    )
    offsets = (
        side_free,
        jnp.diff(side_free, prepend=start[1]) / travelled,
        prediction.free[:, 3] - speeds,
        jnp.zeros(horizon).at[0].set(-previous.control[0] / dt),
        jnp.zeros(horizon),
    )
    # Before the first control there is no steering rate.
    charged = (weights[:, None] * step_weights).at[3, 0].multiply(previous.known)
    return LeastSquares(
        jnp.concatenate(gains), jnp.concatenate(offsets), charged.ravel()
    )


def _curvature_of_steps(
    curvature: Float[Array, " horizon"],
) -> Float[Array, " horizon"]:
    """Mean curvature of each step; the first step has that of the first point."""
    return jnp.concatenate([curvature[:1], 0.5 * (curvature[1:] + curvature[:-1])])


def condense(
    predictor: LinearPredictor, start: State, curvature: Float[Array, " horizon"]
) -> Prediction:
    """Eliminate the lifted state: free response and Toeplitz matrix of C Aᵏ B.

    Args:
        predictor: of the environment.
        start: state along the path now.
        curvature: of the path at each reference point [1/m].
    """
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
        respond, (predictor.lift(start), predictor.B), _curvature_of_steps(curvature)
    )
    lag = jnp.arange(horizon)[:, None] - jnp.arange(horizon)
    # A control acts on later states only.
    gain = jnp.where((lag >= 0)[:, :, None, None], impulses[jnp.maximum(lag, 0)], 0.0)
    return Prediction(
        free, gain.transpose(0, 2, 1, 3).reshape(horizon, start.shape[0], -1)
    )


def to_world(
    along_path: Float[Array, "horizon state"],
    observation: State,
    reference: Reference,
    curvature: Float[Array, " horizon"],
) -> Float[Array, "horizon state"]:
    """Map predictions to the world by the circle that touches each reference point.

    Args:
        along_path: progress, lateral distance, relative yaw and body state.
        observation: state in the world now.
        reference: x, y, yaw, speed of each step.
        curvature: of the path at each reference point [1/m].
    """
    behind = between(reference[0, POSE], observation[POSE])[0]
    steps = jnp.hypot(*jnp.diff(reference[:, :2], axis=0).T)
    passed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])

    def one_step(
        state: State, point: Float[Array, " 4"], kappa: Scalar, travelled: Scalar
    ) -> State:
        ahead = behind + state[0] - travelled
        foot = jnp.stack([ahead, 0.5 * kappa * ahead**2, kappa * ahead])
        aside = jnp.stack([jnp.zeros(()), state[1], state[2]])
        return jnp.concatenate([compose(point[:3], compose(foot, aside)), state[BODY]])

    return jax.vmap(one_step)(along_path, reference, curvature, passed)


class BoxSolution(NamedTuple):
    """The solution of a box-constrained quadratic program.

    Attributes:
        primal: x, inside the box.
        residual: max_i |x − clip(x − ∇ / diag H)|_i in units of x; 0 at the optimum.
    """

    primal: Float[Array, " n"]
    residual: Scalar


def box_qp(
    H: Float[Array, "n n"],
    f: Float[Array, " n"],
    low: Float[Array, " n"],
    high: Float[Array, " n"],
    start: Float[Array, " n"],
    *,
    iterations: int = 12,
) -> BoxSolution:
    """Minimise ½ xᵀ H x + fᵀ x subject to low ≤ x ≤ high, for H > 0.

        x_f ← clip(x_f − 2⁻ʲ H_ff⁻¹ ∇_f)

    The active set holds the entries at a bound where descent points outward; the free
    entries f take a Newton step of the reduced problem, with the j of the lowest cost.
    The solution is exact one step after the active set is right, so a good warm start
    needs one iteration. The cost never increases, and a step that is not finite is not
    taken.

    Args:
        H: Hessian of the cost, positive definite.
        f: linear term of the cost.
        low: lower bounds.
        high: upper bounds, high ≥ low.
        start: initial guess, clipped to the box.
        iterations: fixed number; each is one Cholesky factorisation.

    Source: Bertsekas (1982); Tassa, Mansard and Todorov (2014), section III.
    """
    # All lengths as one batch: a search that stops early has no fixed duration.
    lengths = 0.5 ** jnp.arange(HALVINGS)[:, None]
    diagonal = jnp.diagonal(H)

    def improve(x: Float[Array, " n"], _: None) -> tuple[Float[Array, " n"], None]:
        slope = H @ x + f
        # At a bound, with descent pointing outward: such an entry stays.
        active = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        # Their rows become diagonal: the factorisation keeps one shape.
        reduced = jnp.where(active[:, None] | active, jnp.diag(diagonal), H)
        newton = -cho_solve(cho_factor(reduced), jnp.where(active, 0.0, slope))
        candidates = jnp.clip(x + lengths * newton, low, high)
        moves = candidates - x
        # Exact for a quadratic: no difference of two large costs.
        change = moves @ slope + 0.5 * jnp.sum((moves @ H) * moves, axis=1)
        # A step that is not finite is the worst of all.
        change = jnp.where(jnp.isfinite(change), change, jnp.inf)
        best = jnp.argmin(change)
        return jnp.where(change[best] < 0, candidates[best], x), None

    x, _ = jax.lax.scan(improve, jnp.clip(start, low, high), length=iterations)
    return BoxSolution(
        x, jnp.max(jnp.abs(x - jnp.clip(x - (H @ x + f) / diagonal, low, high)))
    )


koopman_mpc = factory(KoopmanMpc, KoopmanMpc.controller)
"""(model, settings of `KoopmanMpc`) -> `Controller`."""
