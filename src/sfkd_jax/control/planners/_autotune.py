"""Search for the settings of a planner that are data, over a batch of tasks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import PlannerState, Tuning, tuned
from sfkd_jax.types import Controller, Key, Scalar


class Autotuned(NamedTuple):
    """The result of `autotune`.

    Attributes:
        tuning: the best settings.
        cost: their mean cost over the batch.
        factors: that were tried, relative to the initial settings, (trial, entry).
        costs: mean cost of every trial, infinite where one was not finite, (trial,).
    """

    tuning: Tuning
    cost: Scalar
    factors: Float[Array, "trial entry"]
    costs: Float[Array, " trial"]


def autotune(
    controller: Controller,
    drive: Callable[[PlannerState, Any], Scalar],
    batch: Any,
    *,
    key: Key,
    entries: tuple[str, ...] = ("temperature", "noise_std"),
    rounds: int = 3,
    span: float = 4.0,
) -> Autotuned:
    """Return the settings of a planner with the lowest mean cost over a batch of tasks.

    Each round tries every combination of the best factors so far times (1/s, 1, s), one
    factor an entry, and s becomes √s. All trials of a round are driven at once, with
    equal keys, so their costs are paired. The initial settings are among them: the
    result is never worse than these on the batch.

    Args:
        controller: a planner; one built with `effective_samples` takes this as an entry
            in place of the temperature.
        drive: (initial state of the planner, task) -> cost of driving the task with
            `controller.act`; traceable by jax.
        batch: tasks, stacked along the leading axis of every leaf.
        key: of the planners' states, one a task.
        entries: of `Tuning` that are scaled.
        rounds: of the search; a round has 3^(number of entries) trials.
        span: s of the first round, larger than 1.

    Raises:
        ValueError: an unknown entry, no round, or a span that is not larger than 1.
    """
    if not set(entries) <= set(Tuning._fields) or rounds < 1 or not span > 1:
        raise ValueError(
            f"entries must be of {', '.join(Tuning._fields)}, rounds at least 1 and "
            f"span larger than 1, got {', '.join(entries)}, {rounds} and {span}"
        )
    count = jax.tree.leaves(batch)[0].shape[0]
    # The same keys for every trial: differences are of the settings, not of luck.
    keys = jax.random.split(key, count)
    initial = controller.init(keys[0]).tuning._asdict()

    def scaled(state: PlannerState, factors: Array) -> PlannerState:
        changes = {
            name: jax.tree.map(lambda leaf, factor=factor: leaf * factor, initial[name])
            for name, factor in zip(entries, factors, strict=True)
        }
        return tuned(state, **changes)

    def cost_of(factors: Array) -> Scalar:
        def one(key: Key, task: Any) -> Scalar:
            return drive(scaled(controller.init(key), factors), task)

        mean = jnp.mean(jax.vmap(one)(keys, batch))
        # Settings that break an episode never win.
        return jnp.where(jnp.isfinite(mean), mean, jnp.inf)

    evaluate = jax.vmap(cost_of)
    # The unchanged settings come first, so ties keep them.
    steps = itertools.product((0.0, -1.0, 1.0), repeat=len(entries))
    directions = jnp.asarray(list(steps))
    best, tried, costs = jnp.ones(len(entries)), [], []
    for number in range(rounds):
        # The logarithm of the span halves with every round: coarse first, then fine.
        trials = best[None] * span ** (directions / 2.0**number)
        tried.append(trials)
        costs.append(evaluate(trials))
        best = trials[jnp.argmin(costs[-1])]
    final = scaled(controller.init(keys[0]), best).tuning
    lowest = jnp.min(costs[-1])
    return Autotuned(final, lowest, jnp.concatenate(tried), jnp.concatenate(costs))
