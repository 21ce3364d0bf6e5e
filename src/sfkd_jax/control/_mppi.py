"""Model predictive path integral control, sampled around a feedback law."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._costs import Stage, StageCost
from sfkd_jax.control._noise import correlated_noise
from sfkd_jax.control._path_frame import Law, path_errors, reference_curvature
from sfkd_jax.control._smoothing import plan_smoother
from sfkd_jax.types import Control, Controller, Environment, Key, Latent, Model, Params, Reference, Scalar, State


class PlannerState(NamedTuple):
    """What the planner carries from one control step to the next.

    Attributes:
        plan: perturbations ν_0 … ν_{T-1} around the law. controls: what they amounted to at the last clean step.
        previous: the control applied last. started: whether there was one. key: for the next samples.
        past: perturbations applied before the plan, oldest first, as far back as smoothing looks; 0 before the start.
    """

    plan: Float[Array, "horizon control"]
    controls: Float[Array, "horizon control"]
    previous: Control
    started: Bool[Array, ""]
    key: Key
    past: Float[Array, "past control"]


class Rollout(NamedTuple):
    """One sample through the horizon: its cost so far, latent, last errors and last control."""

    cost: Scalar
    latent: Latent
    errors: Any
    control: Control


def mppi(
    model: Model,
    stage_cost: StageCost,
    law: Law,
    *,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    num_samples: int = 1500,
    horizon: int = 20,
    temperature: float = 5.0,
    noise_std: tuple[float, ...] = (0.02, 0.3),
    noise_correlation: float = 0.8,
    terminal_weight: float = 1.0,
    latent_weight: float = 0.0,
    smoothing_window: int = 0,
    smoothing_order: int = 2,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
) -> Controller:
    """Information-theoretic MPPI; each step draws M plans around the shifted one and rolls all out in one scan.

        u_k = clip(u_ff(κ_k) + K ξ_k + ν_k),   ν ← Σ_m w_m ν^m,   w_m ∝ exp(−J^m / λ),
        J = Σ_k ℓ(x_k, u_k) + λ_z |z_k − z_k^ref|² + φ(x_T)

    ξ is the path-frame error of the *predicted* state. ν^m is the perturbation that was effective after clipping,
    so a plan never asks for more than the actuators give. Sample 0 is the shifted plan itself. A smoothed plan is
    rolled out, applied and carried over as smoothed, see `plan_smoother`.

    What is not finite never enters the plan: a bad rollout gets weight zero; if all are bad, or the observation or
    environment is, the last clean plan is continued and `info["healthy"]` is False.

    Args:
        model: rolled out; `fiber` and `encode` are evaluated once a step, outside the scan.
        stage_cost: ℓ. law: u_ff + K ξ; see `path_feedback`, `no_feedback`.
        control_low, control_high: actuator limits, in control units.
        num_samples: M. horizon: T. temperature: λ, in units of cost.
        noise_std: per control channel. noise_correlation: of AR(1) noise, from step to step.
        terminal_weight: φ = terminal_weight · ℓ of the last step, on top of it.
        latent_weight: λ_z, on the distance from the latent of the reference state.
        smoothing_window: steps of a Savitzky-Golay filter on ν, odd, or 0 for none. smoothing_order: its polynomial's.
        env_low, env_high: certified environment box; an environment outside is clamped and flagged.

    Returns:
        A `Controller`; `info` has `cost` (best), `mean_cost`, `effective_samples`, `healthy`, `env_inside`,
        `predicted_states` (horizon, state) of the plan that was chosen.

    Raises:
        ValueError: a filter that does not fit the horizon, or smooths nothing.
    """
    low, high = jnp.asarray(control_low), jnp.asarray(control_high)
    std = jnp.asarray(noise_std)
    weights_by_step = jnp.ones(horizon).at[-1].add(terminal_weight)
    smooth = plan_smoother(horizon=horizon, window=smoothing_window, order=smoothing_order)

    def init(key: Key) -> PlannerState:
        zeros = jnp.zeros((horizon, low.shape[0]))
        return PlannerState(zeros, zeros, zeros[0], jnp.asarray(False), key, zeros[: smoothing_window // 2])

    def advance(fiber: Any, before: Rollout, nu: Control, target: Any) -> tuple[Rollout, Control, State]:
        """One step of one sample: the control, the effective perturbation, the cost of where it leads."""
        point, curvature, reference_latent, weight = target
        state = model.decode(fiber, before.latent)
        lawful = law(path_errors(state, point, curvature), curvature, point[3])
        control = jnp.clip(lawful + nu, low, high)
        latent = model.step(fiber, before.latent, control)
        after = model.decode(fiber, latent)
        errors = path_errors(after, point, curvature)
        cost = stage_cost(Stage(errors, before.errors, control, before.control, point[3]))
        if latent_weight:
            gap = model.vector(latent) - model.vector(reference_latent)
            cost = cost + latent_weight * jnp.sum(gap**2)
        return Rollout(before.cost + weight * cost, latent, errors, control), control - lawful, after

    def rollouts(fiber: Any, start: Rollout, plans: Float[Array, "horizon sample control"], targets: Any) -> Any:
        """All samples in one scan over the horizon; costs (sample,), effective perturbations, states."""
        batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (plans.shape[1], *leaf.shape)), start)

        def body(carry: Rollout, inputs: Any) -> tuple[Rollout, Any]:
            nus, target = inputs
            step = jax.vmap(advance, in_axes=(None, 0, 0, None))
            after, effective, states = step(fiber, carry, nus, target)
            return after, (after.control, effective, states)

        final, tracks = jax.lax.scan(body, batch, (plans, targets))
        return final.cost, tracks

    def act(
        params: Params, state: PlannerState, observation: State, env: Environment, reference: Reference
    ) -> tuple[Control, PlannerState, dict[str, Array]]:
        _check_shapes(observation, env, reference, horizon)
        noise_key, next_key = jax.random.split(state.key)
        clean = _all_finite(observation) & _all_finite(env) & _all_finite(reference)
        inside = env if env_low is None or env_high is None else jnp.clip(env, jnp.array(env_low), jnp.array(env_high))
        fiber = model.fiber(params, inside)
        latent = model.encode(fiber, observation)
        curvature = reference_curvature(reference)
        goals = jax.vmap(lambda point: model.encode(fiber, _reference_state(observation, point)))(reference)
        targets = (reference, curvature, goals, weights_by_step)
        errors = path_errors(observation, reference[0], curvature[0])
        now = law(errors, curvature[0], reference[0, 3])
        previous = jnp.where(state.started, state.previous, jnp.clip(now, low, high))
        start = Rollout(jnp.zeros(()), latent, errors, previous)

        noise = correlated_noise(
            noise_key, num_samples=num_samples, horizon=horizon, std=std, correlation=noise_correlation
        )
        plans = state.plan[:, None] + noise.at[:, 0].set(0.0)
        costs, (_, effective, _) = rollouts(fiber, start, plans, targets)
        weights, usable = _softmin(costs, temperature)
        plan = smooth(state.past, jnp.einsum("m,tmc->tc", weights, _finite_or_zero(effective)))
        best, (controls, effective, states) = rollouts(fiber, start, plan[:, None], targets)
        healthy = clean & usable & jnp.isfinite(best[0])
        if smoothing_window:  # a smoothed plan may have left the limits again
            plan = _finite_or_zero(effective[:, 0])

        held = state._replace(key=next_key)
        fresh = PlannerState(plan, controls[:, 0], previous, jnp.asarray(True), next_key, state.past)
        chosen = jax.tree.map(
            lambda new, old: jnp.where(healthy, new, old), fresh._replace(key=()), held._replace(key=())
        )
        control = jnp.clip(chosen.controls[0], low, high)
        info = {
            "cost": jnp.min(jnp.where(jnp.isfinite(costs), costs, jnp.inf)),
            "mean_cost": best[0],
            "effective_samples": 1.0 / jnp.sum(weights**2),
            "healthy": healthy,
            "env_inside": jnp.all(inside == env),
            "predicted_states": states[:, 0],
        }
        past = jnp.concatenate([chosen.past, chosen.plan[:1]])[1:]
        started = chosen.started | healthy
        shifted = PlannerState(_shift(chosen.plan), _shift(chosen.controls), control, started, next_key, past)
        return control, shifted, info

    return Controller(init, act)


def _check_shapes(observation: State, env: Environment, reference: Reference, horizon: int) -> None:
    """Name the argument that has the wrong shape."""
    if observation.ndim != 1 or observation.shape[0] < 4:
        raise ValueError(f"observation must be (p_x, p_y, yaw, v, …), shape (nx,), got {observation.shape}")
    if env.ndim != 1:
        raise ValueError(f"env must have shape (ne,), got {env.shape}")
    if reference.shape != (horizon, 4):
        raise ValueError(f"reference must have shape ({horizon}, 4): x, y, yaw, speed; got {reference.shape}")


def _softmin(costs: Float[Array, " sample"], temperature: float) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Weights ∝ exp(−J/λ) over the finite costs, and whether there is any."""
    finite = jnp.isfinite(costs)
    usable = jnp.any(finite)
    scores = jnp.where(finite, -costs / temperature, -jnp.inf)
    weights = jax.nn.softmax(jnp.where(usable, scores, 0.0))
    return weights, usable


def _finite_or_zero(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Zero in place of what is not finite."""
    return jnp.where(jnp.isfinite(values), values, 0.0)


def _shift(plan: Float[Array, "horizon control"]) -> Float[Array, "horizon control"]:
    """Drop the first step, repeat the last."""
    return jnp.concatenate([plan[1:], plan[-1:]])


def _reference_state(state: State, point: Float[Array, " 4"]) -> State:
    """The state of driving along the reference: its pose and speed, all else zero."""
    return jnp.zeros_like(state).at[:4].set(point)


def _all_finite(values: Float[Array, "*shape"]) -> Bool[Array, ""]:
    """Whether every entry is finite."""
    return jnp.all(jnp.isfinite(values))
