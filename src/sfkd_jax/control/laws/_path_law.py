"""A path-following law as tables of steady turns and feedback gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from math import prod
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.laws._feedback import SteadyTurn
from sfkd_jax.geometry import LATERAL, PATH_SPEED, PathState, path_step, put
from sfkd_jax.ranges import AtLeastTwo, Positive, Span
from sfkd_jax.types import Control, Environment, Scalar, Step

NEWTON = 6
"""Newton steps to a steady turn from that of the next smaller curvature."""
RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control."""
STEERING_SLOPES = (0.5, 5.0)
"""Limits of d steering / d curvature relative to straight driving. It diverges near the
limit of the tyres.
"""

TEXTBOOK = {
    "stanley": (0.5, 1.0, 2.0, 4.0, 8.0),
    "pure_pursuit": (0.3, 0.5, 0.8, 1.2, 2.0),
}
"""Values of the one constant of a steering law from a textbook, see `textbook_law`."""

PathStep: TypeAlias = Callable[[Array, Control, Scalar, Array], Array]
"""(ξ, u, κ, e) -> ξ one step later."""


class PathLaw(NamedTuple):
    """Feedback around steady turns, tabulated over a = v² κ, v and e.

        u = u*(a, v, e) − K(a, v, e) (ξ − ξ*(a, v, e))

    Interpolation is linear. The tables are over the lateral acceleration a of a turn,
    not over κ, because the limit of the tyres is then a box. The law is a pytree of
    arrays, so it can be stored beside the weights that were learned around it.

    Attributes:
        low: lower ends of the axes (a [m/s²], v_ref [m/s], e_1, …).
        high: upper ends of the axes; every axis is divided evenly.
        perturbation: largest |ν| that data and planners add to u [rad, control unit],
            (2,).
        state: ξ* of the steady turns, (*axes, coordinate).
        control: u*, (*axes, 2).
        gain: K, (*axes, 2, coordinate).
    """

    low: Float[Array, " axis"]
    high: Float[Array, " axis"]
    perturbation: Float[Array, " 2"]
    state: Float[Array, "*axes coordinate"]
    control: Float[Array, "*axes 2"]
    gain: Float[Array, "*axes 2 coordinate"]

    def turn(self, curvature: Scalar, speed: Scalar, env: Environment) -> SteadyTurn:
        """Interpolate the steady turn; outside the axes, the value at their ends.

        Args:
            curvature: κ [1/m].
            speed: reference speed [m/s], also that of the steady turn; below 0 it
                counts as 0, since the tables are about driving forward.
            env: e.
        """
        speed = jnp.maximum(speed, 0.0)
        sharpest = self.high[0]
        counts = self.control.shape[:-1]
        # Over v² κ: the limit of the tyres is the same at every speed of the table.
        at = jnp.concatenate([jnp.stack([curvature * speed**2, speed]), env])
        rows, weights = _corners(at, self.low, self.high, counts)
        state, control, gain = (
            jnp.tensordot(weights, table.reshape(-1, *table.shape[len(at) :])[rows], 1)
            for table in (self.state, self.control, self.gain)
        )
        # Below the table less drive keeps the speed, and at rest none.
        share = jnp.clip(speed / self.low[1], 0.0, 1.0)
        control = put(control, 1, control[1] * share)
        right, left = self._steerings(slice(None, None, counts[0] - 1), at[1:])
        tabled = jnp.clip(speed, self.low[1], self.high[1])
        slope = 0.5 * (left - right) * tabled**2 / sharpest
        grip = jnp.stack([slope, sharpest])
        return SteadyTurn(put(state, PATH_SPEED, speed), control, gain, grip)

    def curvature(self, steering: Scalar, speed: Scalar, env: Environment) -> Scalar:
        """Return κ of the steady turn with this steering; NaN beyond the table."""
        steerings = self._steerings(slice(None), jnp.concatenate([speed[None], env]))
        beyond = {"left": jnp.nan, "right": jnp.nan}
        turns = jnp.linspace(self.low[0], self.high[0], len(steerings))
        return jnp.interp(steering, steerings, turns, **beyond) / speed**2

    def _steerings(self, turns: slice, at: Array) -> Float[Array, " turn"]:
        """Return the steering of some of the tabled v² κ, at a speed and e."""
        counts = self.control.shape[1:-1]
        table = self.control[turns, ..., 0]
        rows, weights = _corners(at, self.low[1:], self.high[1:], counts)
        return table.reshape(len(table), -1)[:, rows] @ weights

    def __call__(
        self, coordinates: PathState, curvature: Scalar, speed: Scalar, env: Environment
    ) -> Control:
        """Return u, without any limit."""
        return self.turn(curvature, speed, env).feedback(coordinates)


def _corners(
    at: Float[Array, " axis"],
    low: Float[Array, " axis"],
    high: Float[Array, " axis"],
    counts: tuple[int, ...],
) -> tuple[Int[Array, " corner"], Float[Array, " corner"]]:
    """Flat indices and weights of the grid points for multilinear interpolation."""
    last = np.asarray(counts) - 1
    # Clipped: outside the axes the turn at their ends, never an extrapolated gain.
    position = jnp.clip((at - low) / (high - low), 0.0, 1.0) * last
    # At most the last but one, so that an upper neighbour exists at the end.
    index = jnp.minimum(jnp.floor(position).astype(int), last - 1)
    beyond = position - index
    sides = np.asarray(list(product((0, 1), repeat=len(counts))))
    strides = np.asarray([prod(counts[axis + 1 :]) for axis in range(len(counts))])
    weights = jnp.prod(jnp.where(sides == 1, beyond, 1.0 - beyond), axis=1)
    return jnp.sum(index * strides) + sides @ strides, weights


def law_from_arrays(arrays: Mapping[str, Any]) -> PathLaw:
    """Return the law from a dictionary of arrays, such as `law._asdict()`."""
    return PathLaw(*jax.device_put([arrays[name] for name in PathLaw._fields]))


def textbook_law(
    law: PathLaw, name: str, constant: float, *, wheelbase: Positive
) -> PathLaw:
    """Return a law with the steering of a textbook in place of its gains.

        "stanley":       δ = δ* − ψ − k (e_y + ½ L ψ) / v
        "pure_pursuit":  δ = δ* − 2 L (e_y + T v ψ) / (T v)²

    ψ = e_ψ − e_ψ*; both are linear in the errors here, which are small along a path.
    Stanley's law steers the front axle, half a wheelbase ahead of the position.

    Args:
        law: whose steady turns and drive are used.
        name: of `TEXTBOOK`.
        constant: k [1/s], or the time T [s] of the point that is pursued.
        wheelbase: L [m].

    Source: Hoffmann et al. (2007); Coulter (1992).
    """
    axes = law.gain.ndim - 2
    speed = jnp.linspace(law.low[1], law.high[1], law.gain.shape[1])
    if name == "stanley":
        lateral = constant / speed
        heading = 1.0 + 0.5 * wheelbase * lateral
    else:
        lateral = 2.0 * wheelbase / (constant * speed) ** 2
        heading = constant * speed * lateral
    gain = law.gain
    zero = jnp.zeros_like(speed)
    steering = [lateral, heading, *[zero] * (gain.shape[-1] - 2)]
    rows = jnp.stack(steering, -1).reshape(1, -1, *[1] * (axes - 2), gain.shape[-1])
    return law._replace(gain=gain.at[..., 0, :].set(rows))


def derive_path_law(
    step: Step,
    *,
    coordinates: int,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    lateral_acceleration: Positive = 2.2,
    speed: Span = (3.0, 12.0),
    points: tuple[AtLeastTwo, AtLeastTwo, AtLeastTwo] = (13, 13, 7),
    perturbation: tuple[Positive, Positive] = (0.03, 1.0),
    lateral: float = 20.0,
    heading: float = 240.0,
    velocity: float = 5.0,
    curvature: Positive = 100.0,
    drive: Positive = 0.5,
) -> PathLaw:
    """Tabulate steady turns and gains over (v_ref² κ, v_ref, e), from a step alone.

        ξ* = F(ξ*, u*; κ, e),   e_y* = 0,   v* = v_ref

    F is the vehicle's step in path coordinates, see `geometry.path_step`; K solves
    the Riccati equation of F linearised at ξ*. Derivatives are finite differences, so
    the step may be any function, such as a simulator on the host. Newton's method
    starts every turn from that of the next smaller |κ|. If it does not converge (too
    fast for the friction), the turn and gain of the smaller curvature are used.

    Args:
        step: (x, u, e) -> x one sampling period later.
        coordinates: size of ξ.
        env_low: lower ends of the axes of e.
        env_high: upper ends of the axes of e.
        lateral_acceleration: end of the axis of v_ref² κ, to both sides [m/s²].
        speed: ends of the axis of v_ref [m/s].
        points: on the axes of v_ref² κ (odd), of v_ref, and of every entry of e.
        perturbation: largest |ν|, stored with the law.
        lateral: weight in the Riccati equation [1/m²].
        heading: weight [1/rad²].
        velocity: weight [s²/m²]; the weights of further coordinates are zero.
        curvature: weight of the steering [m²], on the curvature that it produces on the
            steady turns. Where the tyres give less, the law steers more, and the loop
            stays as fast. Not on the lateral acceleration: along the path the loop has
            the same shape at every speed, so that one metric serves all of them.
        drive: weight, per control unit².
    """
    low = (-lateral_acceleration, speed[0], *env_low)
    high = (lateral_acceleration, speed[1], *env_high)
    counts = (*points[:2], *points[2:] * len(env_low))
    if (
        len(points) != 3
        or points[0] % 2 == 0
        or min(counts) < 2
        or not all(a < b for a, b in zip(low, high, strict=True))
    ):
        raise ValueError(
            "a law needs rising axes and an odd number of accelerations, "
            f"got {low}, {high}, {counts}"
        )
    axes = [jnp.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    grid = jnp.stack(jnp.meshgrid(*axes[1:], indexing="ij"), axis=-1)

    def gain_of(slopes: Array, bend: Scalar) -> Array:
        # `bend` is d steering / d curvature: what the steering is worth on this turn.
        controls = jnp.stack([curvature / bend**2, jnp.asarray(drive)])
        return riccati_gain(slopes, (lateral, heading, velocity), controls)

    row = partial(_row, path_step(step), gain_of, coordinates, axes[0])
    # In batches: a vmap over the whole grid would hold all its Newton iterations.
    tables = jax.lax.map(row, grid.reshape(-1, len(axes) - 1), batch_size=64)
    state, control, gain = (
        jnp.moveaxis(table, 0, 1).reshape(*counts, *table.shape[2:]) for table in tables
    )
    ends = jnp.asarray(low), jnp.asarray(high)
    return PathLaw(*ends, jnp.asarray(perturbation), state, control, gain)


def _row(
    step: PathStep,
    gain_of: Callable[[Array, Scalar], Array],
    size: int,
    accelerations: Array,
    condition: Array,
) -> tuple[Array, Array, Array]:
    """Steady states, controls and gains over all v_ref² κ, at one (v_ref, e)."""
    middle = len(accelerations) // 2
    curvatures = accelerations / condition[0] ** 2

    def moved(kappa: Scalar) -> Callable[[Array], Array]:
        return lambda both: step(both[:size], both[size:], kappa, condition[1:])

    def next_turn(known: Array, kappa: Scalar) -> tuple[Array, Array]:
        # Both are given by the point of the table, hence set anew for each turn.
        start = known.at[LATERAL].set(0.0).at[PATH_SPEED].set(condition[0])
        both, steady = steady_turn(moved(kappa), start)
        # Too fast for the friction: the turn of the next smaller curvature stays.
        turn = jnp.where(steady, both, known)
        return turn, turn

    def outward(side: Scalar) -> Array:
        """Turns to one side, from straight driving on."""
        straight = jnp.zeros(size + 2)
        return jax.lax.scan(next_turn, straight, side * curvatures[middle:])[1]

    left, right = jax.vmap(outward)(jnp.asarray([-1.0, 1.0]))
    # Driving straight is in both halves and counts once.
    turns = jnp.concatenate([left[:0:-1], right])
    bends = jnp.asarray(jnp.gradient(turns[:, -2], curvatures[1] - curvatures[0]))
    # A diverging slope would make the weight of the steering vanish.
    bends = jnp.clip(bends, *(limit * bends[middle] for limit in STEERING_SLOPES))

    def gain(kappa: Scalar, turn: Array, bend: Scalar) -> Array:
        return gain_of(by_differences(moved(kappa), turn)[1], bend)

    gains = jax.vmap(gain)(curvatures, turns, bends)
    return turns[:, :-2], turns[:, -2:], gains


def by_differences(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """Return value and central differences, one column per entry, in a single batch.

    The function need not be differentiable: a simulator on the host will do.
    """
    # 3e-3 balances the rounding of float32 against the curvature of the step.
    offsets = DIFFERENCE_STEP * jnp.eye(at.shape[0])
    values = jax.vmap(function)(
        at + jnp.concatenate([jnp.zeros((1, at.shape[0])), offsets, -offsets])
    )
    above, below = jnp.split(values[1:], 2)
    return values[0], (above - below).T / (2.0 * DIFFERENCE_STEP)


def steady_turn(
    moved: Callable[[Array], Array], start: Float[Array, " both"]
) -> tuple[Float[Array, " both"], Bool[Array, ""]]:
    """Solve ξ* = F(ξ*, u*) by Newton's method; return (ξ*, u*), and if it was found.

    The unknowns are the relative yaw, the body state without v, and u; e_y and v stay
    as in `start`.
    """
    size = start.shape[0] - 2
    # e_y and v are given: the car is on its path, at the reference speed.
    free = jnp.asarray([1, *range(3, size + 2)])

    def newton(_: Any, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        both = start.at[free].set(carry[0])
        after, slopes = by_differences(moved, both)
        gap = after - both[:size]
        # Square: two unknown controls take the places of the two fixed coordinates.
        matrix = (slopes - jnp.eye(size, size + 2))[:, free]
        better = carry[0] - solve(matrix, gap[:, None])[:, 0]
        # A NaN compares as False, so that a diverged turn is never steady.
        steady = jnp.max(jnp.abs(gap)) < RESIDUAL_TOLERANCE
        return better, both, steady & jnp.all(jnp.isfinite(both))

    nothing = start[free], start, jnp.asarray(False)
    # The loop holds the only copy of the step and its derivative, which take long to
    # compile; its last pass evaluates them where the others have led.
    return jax.lax.fori_loop(0, NEWTON + 1, newton, nothing)[1:]


def riccati_gain(
    slopes: Float[Array, "coordinate both"],
    state_weights: tuple[float, ...],
    control_weights: Float[Array, " 2"],
) -> Float[Array, "2 coordinate"]:
    """Return K of the Riccati recursion; 0 where it is not finite."""
    A, B = jnp.split(slopes, [slopes.shape[0]], axis=1)
    diagonal = jnp.zeros(A.shape[0]).at[: len(state_weights)]
    Q = jnp.diag(diagonal.set(jnp.asarray(state_weights)))
    R = jnp.diag(control_weights)

    def best(value: Array) -> Array:
        # R > 0 keeps the matrix invertible, also where a control has no effect.
        return solve(R + B.T @ value @ B, B.T @ value @ A)

    def before(_: Any, value: Array) -> Array:
        return Q + A.T @ value @ (A - B @ best(value))

    gain = best(jax.lax.fori_loop(0, RICCATI_STEPS, before, Q))
    # Without a gain the law is its feed-forward alone, which is finite.
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Return matrix⁻¹ right by Gaussian elimination with pivoting; for few unknowns.

    `jnp.linalg.solve` calls LAPACK, and XLA takes tens of seconds to compile a program
    with several such calls inside maps.
    """
    size = matrix.shape[0]
    indices = jnp.arange(size)

    def eliminate(column: Array, rows: Array) -> Array:
        # Rows above the column are done; −1 keeps them from being chosen as pivots.
        candidates = jnp.where(indices < column, -1.0, jnp.abs(rows[:, column]))
        pivot = jnp.argmax(candidates)
        order = indices.at[column].set(pivot).at[pivot].set(column)
        rows = rows[order]
        lead = rows[column] / rows[column, column]
        return (rows - rows[:, column, None] * lead).at[column].set(lead)

    # A loop that is not unrolled: half of the instructions of a law are in here.
    rows = jax.lax.fori_loop(
        0, size, eliminate, jnp.concatenate([matrix, right], axis=1)
    )
    return rows[:, size:]
