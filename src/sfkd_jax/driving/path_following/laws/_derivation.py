"""Derivation of a path-following law: steady turns of a vehicle, and their gains."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import LATERAL, PATH_SPEED, path_step
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.ranges import AtLeastTwo, NonNegative, Positive, Span
from sfkd_jax.types import Control, Scalar, Step

NEWTON = 6
"""Newton steps to a steady turn from that of the next smaller curvature."""
RICCATI_STEPS = 100
"""Steps of the Riccati recursion: 10 s at 10 Hz, several times the settling time."""
RESIDUAL_TOLERANCE = 1e-2
"""Largest residual of a valid steady turn: m, rad and m/s over one step."""
DIFFERENCE_STEP = 3e-3
"""Step of the differences in every coordinate and control."""
STEERING_SLOPES = (0.5, 5.0)
"""Limits of d steering / d curvature, relative to straight driving. Near the limit of
the tyres it diverges.
"""

PathStep: TypeAlias = Callable[[Array, Control, Scalar, Array], Array]
"""(ξ, u, κ, e) -> ξ one step later."""


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
    curvature_power: NonNegative = 0.0,
    drive: Positive = 0.5,
    unsettled: tuple[int, ...] = (),
) -> PathLaw:
    """Tabulate steady turns and gains over (v_ref² κ, v_ref, e), from a step alone.

        ξ* = F(ξ*, u*; κ, e),   e_y* = 0,   v* = v_ref

    F is the vehicle's step in path coordinates, see `path_coordinates.path_step`; K
    solves the Riccati equation of F linearised at ξ*. Derivatives are finite
    differences, so the step may be any function, such as a simulator on the host.
    Newton's method starts every turn from that of the next smaller |κ|. If it does not
    converge (too fast for the friction), the turn and gain of the smaller curvature are
    used.

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
            stays as fast. It is the weight at the highest speed. A larger one tolerates
            more latency.
        curvature_power: power of the speed with which that weight grows. With 0 the
            loop has the same shape along the path at every speed, and with 4 the weight
            is one on the lateral acceleration, and the loop is equally fast in time.
        drive: weight, per control unit².
        unsettled: coordinates of ξ that no steady turn fixes; they stay 0 in ξ*.
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

    def gain_of(slopes: Array, steering_slope: Scalar, reference: Scalar) -> Array:
        weight = curvature * (reference / speed[1]) ** curvature_power
        # d steering / d curvature says what the steering is worth on this turn.
        controls = jnp.stack([weight / steering_slope**2, jnp.asarray(drive)])
        return riccati_gain(slopes, (lateral, heading, velocity), controls)

    sizes = _Coordinates(coordinates, unsettled)
    row = partial(_row, path_step(step), gain_of, sizes, axes[0])
    # In batches, because a vmap over the whole grid would hold all Newton iterations.
    tables = jax.lax.map(row, grid.reshape(-1, len(axes) - 1), batch_size=64)
    state, control, gain = (
        jnp.moveaxis(table, 0, 1).reshape(*counts, *table.shape[2:]) for table in tables
    )
    return PathLaw(
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        perturbation=jnp.asarray(perturbation),
        state=state,
        control=control,
        gain=gain,
    )


class _Coordinates(NamedTuple):
    """The size of ξ, and its entries that no steady turn fixes."""

    size: int
    unsettled: tuple[int, ...]


def _row(
    step: PathStep,
    gain_of: Callable[[Array, Scalar, Scalar], Array],
    coordinates: _Coordinates,
    accelerations: Array,
    condition: Array,
) -> tuple[Array, Array, Array]:
    """Return steady states, controls and gains over all v_ref² κ, at one (v_ref, e).

    Args:
        step: of the vehicle in path coordinates.
        gain_of: (slopes of the step, d steering / d curvature, v_ref) -> K.
        coordinates: of ξ.
        accelerations: the v_ref² κ.
        condition: (v_ref, *e).
    """
    size = coordinates.size
    middle = len(accelerations) // 2
    curvatures = accelerations / condition[0] ** 2

    def moved(kappa: Scalar) -> Callable[[Array], Array]:
        def advance(turn: Array) -> Array:
            return step(turn[:size], turn[size:], kappa, condition[1:])

        return advance

    def next_turn(known: Array, kappa: Scalar) -> tuple[Array, Array]:
        # The point of the table determines both entries, so they are set anew for each
        # turn.
        start = known.at[LATERAL].set(0.0).at[PATH_SPEED].set(condition[0])
        turn, steady = steady_turn(moved(kappa), start, coordinates.unsettled)
        # If the car is too fast for the friction, the turn of the next smaller
        # curvature stays.
        turn = jnp.where(steady, turn, known)
        return turn, turn

    def outward(side: Scalar) -> Array:
        """Return the turns to one side, from straight driving on."""
        straight = jnp.zeros(size + 2)
        return jax.lax.scan(next_turn, straight, side * curvatures[middle:])[1]

    left, right = jax.vmap(outward)(jnp.asarray([-1.0, 1.0]))
    # Straight driving is in both halves and counts once.
    turns = jnp.concatenate([left[:0:-1], right])
    slopes = jnp.asarray(jnp.gradient(turns[:, -2], curvatures[1] - curvatures[0]))
    # A slope that diverges would make the weight of the steering vanish.
    lowest, highest = (limit * slopes[middle] for limit in STEERING_SLOPES)
    slopes = jnp.clip(slopes, lowest, highest)

    def gain(kappa: Scalar, turn: Array, slope: Scalar) -> Array:
        slopes_of_step = by_differences(moved(kappa), turn)[1]
        return gain_of(slopes_of_step, slope, condition[0])

    gains = jax.vmap(gain)(curvatures, turns, slopes)
    return turns[:, :-2], turns[:, -2:], gains


def by_differences(
    function: Callable[[Array], Array], at: Array
) -> tuple[Array, Array]:
    """Return value and central differences of a function, one column for each entry.

    All evaluations are one batch. The function need not be differentiable, so it may be
    a simulator on the host.
    """
    # 3e-3 balances the rounding of float32 against the curvature of the step.
    offsets = DIFFERENCE_STEP * jnp.eye(at.shape[0])
    values = jax.vmap(function)(
        at + jnp.concatenate([jnp.zeros((1, at.shape[0])), offsets, -offsets])
    )
    above, below = jnp.split(values[1:], 2)
    return values[0], (above - below).T / (2.0 * DIFFERENCE_STEP)


def steady_turn(
    moved: Callable[[Array], Array],
    start: Float[Array, " turn"],
    unsettled: tuple[int, ...] = (),
) -> tuple[Float[Array, " turn"], Bool[Array, ""]]:
    """Solve ξ* = F(ξ*, u*) by Newton's method.

    The unknowns are the relative yaw, the body state without v, and u. e_y and v stay
    as in `start`.

    Args:
        moved: (ξ, u) -> ξ one step later.
        start: (ξ, u) from which the search starts.
        unsettled: coordinates that stay as in `start` and are not asked to be steady.

    Returns:
        (ξ*, u*), and whether it solves the equation.
    """
    size = start.shape[0] - 2
    # e_y and v are fixed: the car is on its path, at the reference speed.
    free = jnp.asarray([i for i in (1, *range(3, size + 2)) if i not in unsettled])
    steady_rows = jnp.asarray([i for i in range(size) if i not in unsettled])

    def newton(_: Any, carry: _Search) -> _Search:
        turn = start.at[free].set(carry.unknowns)
        after, slopes = by_differences(moved, turn)
        gap = (after - turn[:size])[steady_rows]
        # A square matrix: two controls take the places of the two fixed coordinates.
        matrix = (slopes - jnp.eye(size, size + 2))[steady_rows][:, free]
        better = carry.unknowns - solve(matrix, gap[:, None])[:, 0]
        # A NaN compares as False, so a turn that diverged is never the nearest.
        residual = jnp.where(
            jnp.all(jnp.isfinite(turn)), jnp.max(jnp.abs(gap)), jnp.inf
        )
        is_nearer = residual < carry.nearest_residual
        return _Search(
            unknowns=better,
            turn=turn,
            residual=residual,
            nearest=jnp.where(is_nearer, turn, carry.nearest),
            nearest_residual=jnp.minimum(residual, carry.nearest_residual),
        )

    far = jnp.asarray(jnp.inf)
    search = _Search(start[free], start, far, start, far)
    # The loop holds the only copy of the step and its derivative, which take long to
    # compile. Its last pass evaluates them where the others have led.
    search = jax.lax.fori_loop(0, NEWTON + 1, newton, search)
    converged = search.residual < RESIDUAL_TOLERANCE
    # A learned model is rough, and Newton's method may leave its turn again.
    turn = jnp.where(converged, search.turn, search.nearest)
    return turn, converged | (search.nearest_residual < RESIDUAL_TOLERANCE)


class _Search(NamedTuple):
    """Newton's method on the way to a steady turn.

    Attributes:
        unknowns: of the next turn to try.
        turn: that was tried last.
        residual: of that turn; infinite if it is not finite.
        nearest: the turn with the smallest residual so far.
        nearest_residual: of that turn.
    """

    unknowns: Array
    turn: Array
    residual: Scalar
    nearest: Array
    nearest_residual: Scalar


def riccati_gain(
    slopes: Float[Array, "coordinate both"],
    state_weights: tuple[float, ...],
    control_weights: Float[Array, " 2"],
) -> Float[Array, "2 coordinate"]:
    """Return K of the Riccati recursion; 0 where it is not finite.

    Args:
        slopes: [A B], the derivatives of a step.
        state_weights: of the first coordinates; those of the others are 0.
        control_weights: diagonal of R.
    """
    A, B = jnp.split(slopes, [slopes.shape[0]], axis=1)
    diagonal = jnp.zeros(A.shape[0]).at[: len(state_weights)]
    Q = jnp.diag(diagonal.set(jnp.asarray(state_weights)))
    R = jnp.diag(control_weights)

    def gain_of(value: Array) -> Array:
        # R > 0 keeps the matrix invertible, even where a control has no effect.
        return solve(R + B.T @ value @ B, B.T @ value @ A)

    def value_before(_: Any, value: Array) -> Array:
        return Q + A.T @ value @ (A - B @ gain_of(value))

    gain = gain_of(jax.lax.fori_loop(0, RICCATI_STEPS, value_before, Q))
    # Without a gain the law is its feed-forward alone, which is finite.
    return jnp.where(jnp.isfinite(gain), gain, 0.0)


def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Return matrix⁻¹ right by Gaussian elimination with pivoting.

    It is for few unknowns. `jnp.linalg.solve` calls LAPACK, and XLA takes tens of
    seconds to compile a program with several such calls inside maps.
    """
    size = matrix.shape[0]
    indices = jnp.arange(size)

    def eliminate(column: Array, rows: Array) -> Array:
        # The rows above are done; −1 keeps them from being chosen as pivots.
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
