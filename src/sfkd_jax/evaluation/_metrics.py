"""What an episode is worth: tracking, smoothness, safety."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.evaluation._closed_loop import Episode

SETTLING = 2.0  # s, not counted: the start is the same for everyone
AFTER_SWITCH = 3.0  # s
LANE_HALF_WIDTH = 1.75  # m
VEHICLE_HALF_WIDTH = 0.9  # m
SWITCH = (0.05, 6.0)
"""A step of friction [-] or wind [m/s] larger than this is a switch; the ramps of gusts
reach 5 m/s a step.
"""


class Scores(NamedTuple):
    """One number per episode, each (episode,).

    Attributes:
        rmse: of the lateral deviation [m].
        rmse_after_switch: within 3 s of a switch [m], NaN if there is none.
        max_deviation: [m].
        smoothness: mean |steering rate| of the applied control [rad/s].
        departed: whether the car left its lane or a state is not finite.
        ess: median effective sample size.
        unhealthy: share of steps at which the planner held its last plan.
        breach, box_exit: share of steps that a monitor flagged.
    """

    rmse: Float[np.ndarray, " episode"]
    rmse_after_switch: Float[np.ndarray, " episode"]
    max_deviation: Float[np.ndarray, " episode"]
    smoothness: Float[np.ndarray, " episode"]
    departed: np.ndarray
    ess: Float[np.ndarray, " episode"]
    unhealthy: Float[np.ndarray, " episode"]
    breach: Float[np.ndarray, " episode"]
    box_exit: Float[np.ndarray, " episode"]


def score(
    episodes: Episode, envs: Float[np.ndarray, "episode time 2"], *, dt: float
) -> Scores:
    """Score a batch of episodes, leading axis first.

    Args:
        episodes: from `simulate`, batched.
        envs: the schedules they were driven under.
        dt: [s].
    """
    lateral = np.asarray(episodes.lateral, dtype=np.float64)
    skip = round(SETTLING / dt)
    after = _after_switch(np.asarray(envs), round(AFTER_SWITCH / dt))
    after[:, :skip] = False
    squares = np.where(after, lateral**2, 0.0).sum(axis=1)
    counts = after.sum(axis=1)
    steering = np.asarray(episodes.controls)[..., 0]
    finite = np.all(np.isfinite(np.asarray(episodes.states)), axis=(1, 2))
    worst = np.max(np.abs(lateral[:, skip:]), axis=1)
    return Scores(
        rmse=np.sqrt(np.mean(lateral[:, skip:] ** 2, axis=1)),
        rmse_after_switch=np.where(
            counts > 0, np.sqrt(squares / np.maximum(counts, 1)), np.nan
        ),
        max_deviation=worst,
        smoothness=np.mean(np.abs(np.diff(steering, axis=1)), axis=1) / dt,
        departed=~finite | ~(worst + VEHICLE_HALF_WIDTH <= LANE_HALF_WIDTH),
        ess=np.median(np.asarray(episodes.effective_samples), axis=1),
        unhealthy=1.0 - np.mean(np.asarray(episodes.healthy), axis=1),
        breach=np.mean(np.asarray(episodes.breach), axis=1),
        box_exit=np.mean(np.asarray(episodes.box_exit), axis=1),
    )


def _after_switch(envs: Float[np.ndarray, "episode time 2"], steps: int) -> np.ndarray:
    """Which steps lie within `steps` of a switch of e, (episode, time)."""
    jumps = np.any(np.abs(np.diff(envs, axis=1)) > np.asarray(SWITCH), axis=2)
    jumps = np.concatenate([np.zeros((len(envs), 1), bool), jumps], axis=1)
    mask = np.zeros_like(jumps)
    for lag in range(min(steps, jumps.shape[1])):
        mask[:, lag:] |= jumps[:, : jumps.shape[1] - lag]
    return mask
