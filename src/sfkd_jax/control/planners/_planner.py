"""The receding-horizon controller of a task and a search."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from sfkd_jax.control.planners._control_step import (
    StepSettings,
    control_step,
    initial_state,
)
from sfkd_jax.control.planners._plans import INFO_LEVELS, Search, Tuning
from sfkd_jax.control.planners._risk import risk_measure
from sfkd_jax.control.planners._smoothing import plan_smoother
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, Positive, PositiveFraction
from sfkd_jax.types import Controller


def planner(
    task: Task,
    search: Search,
    *,
    horizon: AtLeastTwo = 20,
    temperature: Positive = 5.0,
    effective_samples: float = 0.0,
    noise_std: tuple[Positive, ...] = (0.02, 0.3),
    num_proposals: NonNegativeInt = 0,
    smoothing_window: NonNegativeInt = 0,
    smoothing_order: NonNegativeInt = 2,
    risk: str = "mean",
    risk_level: PositiveFraction = 0.25,
    chunk: NonNegativeInt = 0,
    unroll: int = 2,
    sharding: jax.sharding.Sharding | None = None,
    env_low: tuple[float, ...] | None = None,
    env_high: tuple[float, ...] | None = None,
    several: bool | None = None,
    info_level: str = "plan",
    gain_samples: NonNegativeInt = 0,
) -> Controller:
    """Return the receding-horizon controller of a task and a search for its best plan.

    Each control step shifts the plan, searches around it, smooths the result, rolls it
    out within the limits, and keeps the perturbations that the limits allowed. The
    stored plan therefore never exceeds the actuators.

    Values that are not finite never enter the plan. If all rollouts are not finite, or
    the observation, environment or reference is not, the controller continues the last
    healthy plan and `info["healthy"]` is False.

    An environment of shape (particle, ne) holds equally likely environments. The cost
    of a plan is then the `risk` of its trajectories over them, and `info` describes
    the chosen plan in the first one.

    Args:
        task: the planning problem.
        search: the algorithm; see `mppi`, `cem` and `gradient_planner`, which call
            this function.
        horizon: T, number of steps.
        temperature: initial value in `Tuning`.
        effective_samples: initial value in `Tuning`.
        noise_std: initial value in `Tuning`.
        num_proposals: number of user-defined plans in the state; they are zeros (the
            law alone) until replaced.
        smoothing_window: of the Savitzky-Golay filter, see `plan_smoother`; 0 for none.
        smoothing_order: of the filter's polynomial.
        risk: "mean", "worst" or "cvar", over the environments.
        risk_level: fraction of the largest costs that "cvar" averages.
        chunk: number of samples rolled out at a time, to bound the memory; 0 for all
            at once.
        unroll: number of steps of a rollout that are compiled as one, which saves time
            where steps are short; the plan is the same up to rounding.
        sharding: of the samples over devices, for plans of shape (horizon, sample,
            control). Up to the order of sums, the plan does not depend on the number
            of devices, which must divide the number of samples.
        env_low: lower end of the environment box; an environment outside is clipped.
        env_high: upper end of the environment box.
        several: whether the leading axis of every leaf of an environment runs over
            equally likely ones; None if it does for a matrix alone.
        info_level: "plan", or "samples" to report every candidate as well.
        gain_samples: number of samples, those with the largest weights, from which the
            feedback gains of the plan are computed, see `between_plans`; 0 for none.

    Returns:
        A `Controller`; `info` has `cost` (lowest), `mean_cost` (of the chosen plan),
        `effective_samples`, `healthy`, `env_inside` and `predicted_states` (horizon,
        state) of the chosen plan. With `info_level="samples"` it has `sample_costs`,
        `sample_weights`, `sample_plans` (perturbations) and `sample_states` too, with
        `gain_samples` `gains` (control, state), zero where `healthy` is False, for a
        `constrained` task `violation` of the chosen plan and `constraints_kept`.

    Raises:
        ValueError: `noise_std` does not fit the task, the horizon or the temperature
            is not positive, the risk is unknown, the filter does not fit the horizon,
            `unroll` is not positive, `gain_samples` is negative, or gains are wanted of
            a smoothed plan.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    if info_level not in INFO_LEVELS:
        raise ValueError(
            f"info_level must be one of {', '.join(INFO_LEVELS)}, got {info_level!r}"
        )
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, got {temperature}")
    if len(noise_std) != task.low.shape[0] or not all(std > 0 for std in noise_std):
        raise ValueError(
            f"noise_std needs {task.low.shape[0]} positive numbers, got {noise_std}"
        )
    if unroll < 1:
        raise ValueError(f"unroll must be at least 1, got {unroll}")
    if gain_samples < 0:
        raise ValueError(f"gain_samples must not be negative, got {gain_samples}")
    if gain_samples and smoothing_window:
        raise ValueError("gain_samples and smoothing_window exclude each other")
    settings = StepSettings(
        task=task,
        search=search,
        horizon=horizon,
        num_proposals=num_proposals,
        smooth=plan_smoother(
            horizon=horizon, window=smoothing_window, order=smoothing_order
        ),
        smoothing_window=smoothing_window,
        risk=risk_measure(risk, risk_level),
        chunk=chunk,
        unroll=unroll,
        sharding=sharding,
        env_low=env_low,
        env_high=env_high,
        several=several,
        reports_samples=info_level == "samples",
        gain_samples=gain_samples,
        tuning=Tuning(
            temperature=jnp.asarray(temperature, dtype=float),
            effective_samples=jnp.asarray(effective_samples, dtype=float),
            noise_std=jnp.asarray(noise_std, dtype=float),
            elapsed=jnp.ones(()),
            cost=jax.tree.map(
                lambda weight: jnp.asarray(weight, dtype=float), task.weights
            ),
            constraints=jax.tree.map(
                lambda value: jnp.asarray(value, dtype=float), task.constraint_data
            ),
        ),
    )
    return Controller(partial(initial_state, settings), partial(control_step, settings))
