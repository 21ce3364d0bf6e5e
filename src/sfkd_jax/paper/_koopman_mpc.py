"""Linear model predictive control in a lifted state: one box-constrained QP a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import (
    Evaluate,
    Plan,
    Planner,
    PlanningStart,
    RolloutSetup,
    SearchResult,
    StepIndex,
    StepResult,
    Task,
    Tuning,
)
from sfkd_jax.driving.path_coordinates import beside, followable, reference_curvature
from sfkd_jax.driving.path_following import (
    Cost,
    PathErrors,
    PathTarget,
    StageInputs,
    check_path,
    path_errors,
)
from sfkd_jax.paper._lift import LinearPredictor
from sfkd_jax.ranges import AtLeastTwo
from sfkd_jax.types import (
    BODY,
    Control,
    Controller,
    Environment,
    Key,
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


def koopman_mpc(
    model: Model,
    cost: Cost,
    *,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    horizon: AtLeastTwo = 20,
    iterations: int = 12,
    terminal_weight: float = 1.0,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
) -> Controller:
    """Return the linear MPC of a lifted state, under `tracking_cost`.

        min_u Σ_k ℓ(x_k, u_k) + w_T ℓ(x_T, u_T)
        subject to   low ≤ u_k ≤ high,   z_0 = lift(e_y, e_ψ, s),
                     z_{k+1} = A(e) z_k + B(e) u_k + d(e) κ_k + c(e),
                     (e_y, e_ψ, s)_k = C z_k + o

    The path enters through its previewed curvature, and e is constant over the horizon.
    The variables are the controls of all steps; `box_qp` solves for them, warm started
    with the shifted plan. Only controls have bounds, so every QP is feasible.

    Args:
        model: with `structure.linear`.
        cost: ℓ, quadratic.
        control_low: lower control limits.
        control_high: upper control limits.
        horizon: T, number of steps.
        iterations: of the QP solver.
        terminal_weight: w_T, added to the weight of the last step.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.

    Source: Korda and Mezić (2018), section 4.
    """
    if model.structure.linear is None:
        raise ValueError(
            "koopman_mpc needs a model that is linear in a lift (Structure.linear)"
        )
    lifted = _LiftedTracking(model, cost, terminal_weight)
    task = Task(
        low=jnp.asarray(control_low, dtype=float),
        high=jnp.asarray(control_high, dtype=float),
        weights=cost.weights,
        prepare=lifted.prepare,
        step=lifted.step,
        check=check_path,
    )
    return _QuadraticProgram(
        task,
        horizon=horizon,
        noise_std=(1.0,) * len(control_low),
        iterations=iterations,
        env_low=env_low,
        env_high=env_high,
    ).controller()


class _LiftedSample(NamedTuple):
    """One rollout of the lifted state.

    Attributes:
        z: lifted state.
        errors: path errors after the last step.
        control: of the last step.
        known: whether there was a last step.
    """

    z: Float[Array, " rank"]
    errors: PathErrors
    control: Control
    known: Bool[Array, ""]


@dataclass(frozen=True, eq=False)
class _LiftedTracking:
    """The task of tracking a path with a linear predictor, without limits."""

    model: Model
    cost: Cost
    terminal_weight: float

    def prepare(
        self,
        params: Params,
        observation: State,
        env: Environment,
        reference: Reference,
        start: PlanningStart,
    ) -> RolloutSetup:
        """Return the matrices of e, the lifted observation and the path ahead."""
        assert self.model.structure.linear is not None
        predictor = self.model.structure.linear(self.model.fiber(params, env))
        reference, is_followable = followable(reference)
        curvature = reference_curvature(reference)
        errors = path_errors(observation, reference[0], curvature[0])
        # Progress counts from here: the predictor knows the path by its curvature only.
        place = jnp.stack([jnp.zeros(()), errors.lateral, errors.heading])
        state = jnp.concatenate([place, observation[BODY]])
        # The first step has the curvature of the first point, the others the mean of
        # that at both ends.
        mean = 0.5 * (curvature[1:] + curvature[:-1])
        step_curvature = jnp.concatenate([curvature[:1], mean])
        return RolloutSetup(
            context=predictor._replace(lift=None),
            start=_LiftedSample(
                z=predictor.lift(state),
                errors=errors,
                control=start.control,
                known=start.known,
            ),
            targets=PathTarget(reference, step_curvature),
            followable=is_followable,
        )

    def step(
        self,
        weights: object,
        predictor: LinearPredictor,
        before: _LiftedSample,
        u: Control,
        target: PathTarget,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of the prediction and its cost."""
        z = predictor.A @ before.z + predictor.B @ u
        z = z + predictor.d * target.curvature + predictor.c
        x = predictor.C @ z + predictor.o
        speed = target.point[3]
        errors = PathErrors(x[1], x[2], x[3] - speed)
        # Before the first control there is no steering rate.
        last = jnp.where(before.known, before.control, u)
        stage = StageInputs(errors, before.errors, u, last, speed)
        cost = self.cost.stage(weights, stage) * (1.0 + self.terminal_weight * at.last)
        return StepResult(
            sample=_LiftedSample(z, errors, u, jnp.ones_like(before.known)),
            control=u,
            perturbation=u,
            # All planners report states beside the reference, without the progress.
            state=beside(x[1:], target.point),
            cost=cost,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _QuadraticProgram(Planner):
    """A planner of tasks whose cost is quadratic in the plan, and convex."""

    iterations: int = 12

    def search(
        self, key: Key, plan: Plan, tuning: Tuning, evaluate: Evaluate
    ) -> SearchResult:
        """Return the minimum within the limits; nothing is random."""
        size = plan.size

        def cost_of(u: Float[Array, " n"]) -> Scalar:
            return evaluate(u.reshape(plan.shape)[:, None]).costs[0]

        def slope_of(u: Float[Array, " n"]) -> tuple[Array, Array]:
            slope = jax.grad(cost_of)(u)
            return slope, slope

        # The cost is quadratic, so its derivatives at 0 determine it.
        H, f = jax.jacfwd(slope_of, has_aux=True)(jnp.zeros(size))
        # A predictor that ignores a control leaves a zero row.
        H = H + REGULARISATION * jnp.max(jnp.diagonal(H)) * jnp.eye(size)
        low = jnp.broadcast_to(self.task.low, plan.shape).ravel()
        high = jnp.broadcast_to(self.task.high, plan.shape).ravel()
        # A solution that did not converge is still inside the box, and is used.
        solution = box_qp(H, f, low, high, plan.ravel(), iterations=self.iterations)
        cost = cost_of(solution)
        return SearchResult(
            plan=solution.reshape(plan.shape),
            usable=jnp.isfinite(cost),
            cost=cost,
            effective_samples=jnp.full((), jnp.nan),
        )


def box_qp(
    H: Float[Array, "n n"],
    f: Float[Array, " n"],
    low: Float[Array, " n"],
    high: Float[Array, " n"],
    start: Float[Array, " n"],
    *,
    iterations: int = 12,
) -> Float[Array, " n"]:
    """Minimise ½ xᵀ H x + fᵀ x subject to low ≤ x ≤ high, for H > 0.

        x_f ← clip(x_f − 2⁻ʲ H_ff⁻¹ ∇_f)

    The active set holds the entries at a bound where descent points outward; the free
    entries f take a Newton step of the reduced problem, with the j of the lowest cost.
    The solution is exact one step after the active set is right, so a good warm start
    needs one iteration, a Cholesky factorisation. The cost never increases, and a step
    that is not finite is not taken. `start` is clipped to the box.

    Source: Bertsekas (1982); Tassa, Mansard and Todorov (2014), section III.
    """
    # All step lengths are one batch: a search that stops early has no fixed duration.
    lengths = 0.5 ** jnp.arange(HALVINGS)[:, None]
    diagonal = jnp.diagonal(H)

    def improve(x: Float[Array, " n"], _: None) -> tuple[Float[Array, " n"], None]:
        slope = H @ x + f
        # An entry stays at a bound where descent points outward.
        active = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        # The rows of such entries become diagonal, so the factorisation keeps its
        # shape.
        reduced = jnp.where(active[:, None] | active, jnp.diag(diagonal), H)
        newton = -cho_solve(cho_factor(reduced), jnp.where(active, 0.0, slope))
        candidates = jnp.clip(x + lengths * newton, low, high)
        moves = candidates - x
        # Exact for a quadratic cost, without the difference of two large costs.
        change = moves @ slope + 0.5 * jnp.sum((moves @ H) * moves, axis=1)
        # A step that is not finite counts as the worst one.
        change = jnp.where(jnp.isfinite(change), change, jnp.inf)
        best = jnp.argmin(change)
        return jnp.where(change[best] < 0, candidates[best], x), None

    return jax.lax.scan(improve, jnp.clip(start, low, high), length=iterations)[0]
