"""Holes in the tables of a law: turns that were not found, and gains of zero."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.path_coordinates import PATH_SPEED, path_step
from sfkd_jax.driving.path_following.laws._derivation import by_differences
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.types import Step

LEAST_STRAIGHT = 0.5
"""Share of speeds and e at which driving straight ahead must be found."""
UNSETTLED = 1e-4
"""Largest entry of a row or a column of F − I that counts as zero."""


def unsettled_coordinates(
    step: Step, *, coordinates: int, speed: float, env: tuple[float, ...]
) -> tuple[int, ...]:
    """Return the coordinates that no steady turn fixes.

    F is the step in path coordinates, driving straight ahead. A row of F − I that is
    zero belongs to a state that stays as it is, such as a charge. A column that is zero
    belongs to one that nothing depends on, not even itself, such as an odometer.

    Args:
        step: of the vehicle, (x, u, e) -> x one sampling period later.
        coordinates: size of ξ.
        speed: at which it drives [m/s].
        env: e.

    Returns:
        Indices into ξ.
    """
    along = path_step(step)

    def moved(turn: Array) -> Array:
        state = turn[:coordinates]
        return along(state, turn[coordinates:], jnp.zeros(()), jnp.asarray(env))

    straight = jnp.zeros(coordinates + 2).at[PATH_SPEED].set(speed)
    _, slopes = by_differences(moved, straight)
    gaps = np.abs(np.asarray(slopes) - np.eye(coordinates, coordinates + 2))
    stays = gaps.max(axis=1) < UNSETTLED
    is_read = gaps.max(axis=0)[:coordinates] >= UNSETTLED
    unsettled = stays | ~is_read
    # e_y, e_ψ and v are what a law controls.
    unsettled[: PATH_SPEED + 1] = False
    return tuple(np.flatnonzero(unsettled).tolist())


class CheckedLaw(NamedTuple):
    """A law without holes.

    Attributes:
        law: with gains at all points.
        findings: a line for every kind of hole that was filled.
    """

    law: PathLaw
    findings: tuple[str, ...]


def checked_law(law: PathLaw, *, tightest: float) -> CheckedLaw:
    """Return a law whose gains of zero are filled, and what was found in its tables.

    A point without a gain takes the gain of the next smaller curvature that has one. A
    point without a steady turn has that of the next smaller curvature already, and
    where driving straight ahead is missing that of the nearest speed and e is used.

    Args:
        law: of `derive_path_law`.
        tightest: curvature that the steering reaches at its limit [1/m].

    Raises:
        ValueError: no driving straight ahead was found at half of the speeds and e or
            more, or no gain at any curvature; gives speed and e.
    """
    has_turn = _found_turns(law)
    middle = len(has_turn) // 2
    findings = []
    is_straight = has_turn[middle]
    if is_straight.mean() <= LEAST_STRAIGHT:
        raise ValueError(
            f"the law finds no steady driving straight ahead, as at "
            f"{_first_place(law, middle, is_straight)}: its model is wrong, or "
            "dataset.law.speed is beyond the vehicle"
        )
    if not is_straight.all():
        place = _first_place(law, middle, is_straight)
        findings.append(
            f"at {(~is_straight).sum()} of {is_straight.size} speeds and e ({place}, "
            "…) the law finds no steady driving straight ahead; that of the nearest "
            "speed and e is used"
        )
        law = _with_nearest_straights(law, is_straight)
    turns = np.delete(has_turn, middle, axis=0)
    if not turns.all():
        curvatures = np.abs(np.delete(_curvatures(law), middle, axis=0))[~turns]
        beyond = int(np.sum(curvatures > tightest))
        has_turn[middle] = True
        findings.append(
            f"{_share(law, ~has_turn)} no steady turn; the turn of the next smaller "
            f"curvature is used. {beyond} of them ask for more than the steering's "
            f"{tightest:.3g} 1/m, the others for more than the tyres give"
        )
    return _with_gains(law, findings)


def _with_gains(law: PathLaw, findings: list[str]) -> CheckedLaw:
    """Return a law with gains at all points.

    Args:
        law: whose gains may be 0 or not finite.
        findings: what was found so far.

    Raises:
        ValueError: at some speed and e there is no gain at any curvature.
    """
    gain = np.array(law.gain)
    finite = np.isfinite(gain).all(axis=(-2, -1))
    has_gain = np.logical_and(finite, gain.any(axis=(-2, -1)))
    has_any = np.asarray(has_gain.any(axis=0))
    if not has_any.all():
        raise ValueError(
            f"the law has no gain at any curvature, as at "
            f"{_first_place(law, len(gain) // 2, has_any)}: its model is wrong there, "
            "or the weights dataset.law.curvature and lateral do not suit the vehicle"
        )
    if not has_gain.all():
        findings.append(
            f"{_share(law, ~has_gain)} no gain; that of the next smaller curvature is "
            "used. Other weights dataset.law.curvature and lateral may have one"
        )
        sources = _inner_sources(has_gain)
        gain = np.take_along_axis(gain, sources[..., None, None], axis=0)
        law = law._replace(gain=jnp.asarray(gain, law.gain.dtype))
    return CheckedLaw(law, tuple(findings))


def _with_nearest_straights(
    law: PathLaw, is_straight: Bool[np.ndarray, "*conditions"]
) -> PathLaw:
    """Return a law with the straight of the nearest speed and e, where it lacks one.

    Args:
        law: of `derive_path_law`.
        is_straight: whether it found one, at each speed and e.
    """
    middle = len(law.control) // 2
    found = np.argwhere(is_straight)
    tables = {
        name: np.array(getattr(law, name)) for name in ("state", "control", "gain")
    }
    speeds = np.linspace(law.low[1], law.high[1], law.control.shape[1])
    for missing in np.argwhere(~is_straight):
        nearest = found[np.argmin(np.abs(found - missing).sum(axis=1))]
        for table in tables.values():
            table[(middle, *missing)] = table[(middle, *nearest)]
        tables["state"][(middle, *missing)][PATH_SPEED] = speeds[missing[0]]
    return law._replace(
        **{name: jnp.asarray(table, law.gain.dtype) for name, table in tables.items()}
    )


def _found_turns(law: PathLaw) -> Bool[np.ndarray, "*axes"]:
    """Return where a steady turn was found.

    Where none was, the tables repeat the turn of the next smaller curvature, and a
    straight that was not found has no speed.
    """
    turns = np.concatenate([law.state, law.control], axis=-1)
    differs = np.any(np.diff(turns, axis=0) != 0.0, axis=-1)
    middle = len(turns) // 2
    straight = turns[middle : middle + 1, ..., PATH_SPEED] > 0.0
    return np.concatenate([differs[:middle], straight, differs[middle:]])


def _inner_sources(has: Bool[np.ndarray, "*axes"]) -> Int[np.ndarray, "*axes"]:
    """Return, for each point, the row of the nearest point that has what it lacks.

    Rows of smaller curvature come first.
    """
    rows = np.arange(len(has))
    middle = len(has) // 2
    distance = np.abs(rows[:, None] - rows).astype(float)
    # An outer row is the source of an inner one only if there is no other.
    outward = np.abs(rows - middle) > np.abs(rows - middle)[:, None]
    cost = distance + len(has) * outward
    shaped = cost.reshape(*cost.shape, *[1] * (has.ndim - 1))
    return np.argmin(np.where(has, shaped, np.inf), axis=1)


def _curvatures(law: PathLaw) -> Float[np.ndarray, "*axes"]:
    """Return the curvature of each point of the tables [1/m]."""
    shape = law.control.shape[:-1]
    low = np.asarray(law.low, float)
    high = np.asarray(law.high, float)
    sideways = np.linspace(low[0], high[0], shape[0])
    speed = np.linspace(low[1], high[1], shape[1])
    curvatures = sideways[:, None] / speed**2
    return np.broadcast_to(
        curvatures.reshape(*curvatures.shape, *[1] * (len(shape) - 2)), shape
    )


def _share(law: PathLaw, chosen: Bool[np.ndarray, "*axes"]) -> str:
    """Return "5 of 90 points of the law, as the one at 3 m/s, …, have" of a mask."""
    first = np.unravel_index(int(np.argmax(chosen)), chosen.shape)
    place = _place(law, tuple(map(int, first)))
    have = "has" if chosen.sum() == 1 else "have"
    return f"{chosen.sum()} of {chosen.size} points of the law ({place}, …) {have}"


def _place(law: PathLaw, point: tuple[int, ...]) -> str:
    """Return speed, curvature and e of a point, in words."""
    low = np.asarray(law.low, float)
    high = np.asarray(law.high, float)
    counts = law.control.shape[:-1]
    shares = np.asarray(point) / (np.asarray(counts) - 1)
    sideways, speed, *env = low + (high - low) * shares
    inside = ", ".join(f"{value:.3g}" for value in env)
    return f"{speed:.3g} m/s, kappa = {sideways / speed**2:.3g} 1/m, e = ({inside})"


def _first_place(law: PathLaw, row: int, holds: Bool[np.ndarray, "*conditions"]) -> str:
    """Return the first speed and e at which something does not hold, in words."""
    first = np.unravel_index(int(np.argmin(holds)), holds.shape)
    return _place(law, (row, *map(int, first)))
