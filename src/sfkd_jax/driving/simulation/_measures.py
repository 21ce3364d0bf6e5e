"""What metrics measure: one value per episode, from what its steps recorded.

The functions of an `info` at the end say what `simulate` records of every step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.driving.sizes import CAR_LENGTH
from sfkd_jax.info import ControllerInfo

PerEpisode: TypeAlias = Float[np.ndarray, " episode"] | Bool[np.ndarray, " episode"]
"""One value per episode. NaN stands for an episode that has no such value."""

SETTLING = 2.0
"""Time at the start of an episode that is not scored, since it is the same for every
system [s].
"""
LANE_HALF_WIDTH = 1.75
"""Half width of the lane that a car has to stay in [m]. That of a small vehicle is as
much narrower as the vehicle is shorter.
"""
MIRROR = 0.1
"""Width of a mirror [m]. The body without mirrors has to stay in the lane, and this is
how committed departures were counted; the whole width has to keep clear of obstacles.
"""
SWITCH = (0.05, 6.0)
"""Change of friction [-] and of wind [m/s] in a step from which on it is a switch. The
ramps of gusts reach 5 m/s in a step.
"""


class Recording(NamedTuple):
    """A batch of episodes as metrics read it: fields of `Episode` as numpy arrays.

    Attributes:
        dt: sampling period [s].
        size: length and width of the car [m].
        lateral: signed distance from the path [m].
        states: x_0 … x_T.
        controls: u_0 … u_{T-1}.
        signals: by name, each (episode, time, …).
    """

    dt: float
    size: tuple[float, float]
    lateral: Float[np.ndarray, "episode time"]
    states: Float[np.ndarray, "episode time_plus_1 state"]
    controls: Float[np.ndarray, "episode time control"]
    signals: dict[str, np.ndarray]


def _scored(run: Recording) -> np.ndarray:
    """Return the lateral deviation after the start of the episode [m]."""
    return run.lateral[:, round(SETTLING / run.dt) :]


def rmse(run: Recording) -> np.ndarray:
    """Return the root mean square of the lateral deviation [m]."""
    return np.sqrt(np.mean(_scored(run) ** 2, axis=1))


def max_deviation(run: Recording) -> np.ndarray:
    """Return the largest lateral deviation [m]."""
    return np.max(np.abs(_scored(run)), axis=1)


def switches(
    envs: Float[np.ndarray, "*batch time environment"],
) -> Bool[np.ndarray, "*batch time"]:
    """Return whether friction or wind has switched at each step; never at the first."""
    jumps = np.any(np.abs(np.diff(envs, axis=-2)) > np.asarray(SWITCH), axis=-1)
    return np.concatenate([np.zeros_like(jumps[..., :1]), jumps], axis=-1)


def steering_rate(run: Recording) -> np.ndarray:
    """Return the mean |steering rate| of the applied controls [rad/s]."""
    return np.mean(np.abs(np.diff(run.controls[..., 0], axis=1)), axis=1) / run.dt


def room_in_lane(size: tuple[float, float]) -> float:
    """Return the deviation up to which a car stays in its lane [m].

    Args:
        size: length and width of the car [m].
    """
    # Roads are no wider for long vehicles.
    scale = min(size[0] / CAR_LENGTH, 1.0)
    # The side of the car has to stay in the lane, and not only its centre.
    return scale * LANE_HALF_WIDTH - (0.5 * size[1] - scale * MIRROR)


def departed(run: Recording) -> np.ndarray:
    """Return whether the car left its lane, or a state is not finite."""
    # All states count here, also those of the part that is not scored.
    finite = np.all(np.isfinite(run.states), axis=(1, 2))
    # For a deviation of NaN the comparison is false.
    stays = max_deviation(run) <= room_in_lane(run.size)
    return ~finite | ~stays


def unhealthy_share(run: Recording) -> np.ndarray:
    """Return the share of steps at which the controller was not healthy."""
    return 1.0 - np.mean(run.signals["healthy"], axis=1)


def median_effective_samples(run: Recording) -> np.ndarray:
    """Return the median number of effective samples."""
    return np.median(run.signals["effective_samples"], axis=1)


def nearest(run: Recording) -> np.ndarray:
    """Return the smallest true distance from an obstacle [m]; NaN without obstacles."""
    smallest = np.min(run.signals["gap"], axis=1)
    return np.where(np.isfinite(smallest), smallest, np.nan)


def _among_obstacles(run: Recording, values: np.ndarray) -> np.ndarray:
    """Return values of episodes with obstacles, and NaN for the others."""
    return np.where(np.isnan(nearest(run)), np.nan, values)


def collided(run: Recording) -> np.ndarray:
    """Return 1 for a collision with an obstacle, else 0; NaN without obstacles."""
    return _among_obstacles(run, nearest(run) < 0.0)


def mean_speed(run: Recording) -> np.ndarray:
    """Return the mean speed [m/s]; NaN without obstacles."""
    return _among_obstacles(run, np.mean(run.states[:, 1:, 3], axis=1))


def below_claim(run: Recording) -> np.ndarray:
    """Return the number of steps nearer to an obstacle than the controller claimed.

    It is NaN if the controller claimed nothing at any step.
    """
    gap = run.signals["gap"]
    claim = run.signals["clearance"]
    below = np.sum(gap < claim, axis=1)
    return np.where(np.all(np.isnan(claim), axis=1), np.nan, below)


def healthy(info: ControllerInfo) -> Any:
    """Return whether the control is the plan of a working planner."""
    return info.healthy


def effective_samples(info: ControllerInfo) -> Any:
    """Return the effective number of samples; NaN if nothing is sampled."""
    return info.plan.effective_samples


def gap(info: ControllerInfo) -> Any:
    """Return the true distance from the nearest obstacle [m]; NaN without obstacles."""
    return math.nan if info.gap is None else info.gap


def claimed_clearance(info: ControllerInfo) -> Any:
    """Return the distance that the controller claims [m]; NaN where it claims none."""
    return math.nan if info.lane is None else info.lane.clearance
