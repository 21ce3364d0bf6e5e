"""Extended dynamic mode decomposition (EDMD) of cars along circles."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from sfkd_jax.driving.path_coordinates import circle_errors
from sfkd_jax.geometry import between, compose
from sfkd_jax.paper._lift import Lift
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Key,
    Params,
    Scalar,
    State,
    Trajectory,
)

STRAIGHT = 1e-12
"""Smallest curvature [1/m], so that nothing divides by 0."""
VALIDATION_SHARE = 0.1
"""Share of the ranges that the validation predictions use, because a controller keeps
the car near its path.
"""


def identify(
    lift: Lift,
    train: Trajectory,
    validation: Trajectory,
    key: Key,
    *,
    ridges: tuple[float, ...],
    transitions: int,
    horizon: int,
) -> Params:
    """Fit the weights by ridge regression, with the ridge that predicts best.

    Args:
        lift: of states along a path.
        train: runs whose pairs of states are regressed.
        validation: runs whose predictions choose the ridge.
        key: for the centres of the lift and the pairs; it is consumed.
        ridges: to choose from.
        transitions: largest number of pairs.
        horizon: of the predictions that choose the ridge, steps.
    """
    # With a key of their own the centres do not change with the number of pairs.
    centre_key, pair_key, circle_key = jax.random.split(key, 3)
    centres = lift.random_centres(centre_key)
    inputs, targets = _pairs(lift, train, centres, pair_key, transitions)
    # All ridges share the expensive part, a factorisation of the pairs.
    fits = ridge_regression(inputs, targets, jnp.asarray(ridges))
    count, steps = validation.controls.shape[:2]
    length = min(horizon, steps)
    # Windows begin with the first state, which the offset of a circle refers to.
    windows = Trajectory(
        states=validation.states[:, : length + 1],
        controls=validation.controls[:, :length],
        envs=validation.envs[:, :length],
    )
    offsets, curvatures = _circles(lift, circle_key, count)
    offsets = VALIDATION_SHARE * offsets
    curvatures = VALIDATION_SHARE * curvatures

    def error(weights: Float[Array, "regressor rank"]) -> Scalar:
        params = {"centres": centres, "weights": weights}
        errors = jax.vmap(partial(_prediction_error, lift, params))
        return jnp.mean(errors(windows, offsets, curvatures))

    # The error is that of free predictions over a horizon, which a controller uses.
    errors = jax.lax.map(error, fits)
    # A prediction that diverged has a NaN or inf, and argmin would choose a NaN.
    best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))
    return {"centres": centres, "weights": fits[best]}


def _circles(
    lift: Lift, key: Key, count: int
) -> tuple[Float[Array, "sample 2"], Float[Array, " sample"]]:
    """Draw offsets (e_y, e_ψ) from circles, and their curvatures, uniformly."""
    drawn = jax.random.uniform(key, (count, 3), minval=-1.0)
    ranges = jnp.asarray([lift.lateral_range, lift.heading_range])
    return drawn[:, :2] * ranges, lift.curvature_range * drawn[:, 2]


def _pairs(
    lift: Lift,
    train: Trajectory,
    centres: Float[Array, "function coordinate"],
    key: Key,
    transitions: int,
) -> tuple[Float[Array, "sample regressor"], Float[Array, "sample rank"]]:
    """Return regressors and increments of the lift, one row for each transition."""
    choice_key, circle_key = jax.random.split(key)
    # States are paired before the shuffle, so that a pair mixes no runs or times.
    pairs = jnp.stack([train.states[:, :-1], train.states[:, 1:]], axis=2)
    pairs = pairs.reshape(-1, 2, lift.size)
    count = pairs.shape[0]
    # Drawn over all runs, since neighbours in time are nearly the same pair.
    chosen = jax.random.permutation(choice_key, count)[:transitions]
    # The same rows, so that each pair keeps its control and environment.
    controls = train.controls.reshape(count, -1)[chosen]
    envs = train.envs.reshape(count, -1)[chosen]
    offsets, curvatures = _circles(lift, circle_key, chosen.shape[0])
    paths = jax.vmap(along_circle)(pairs[chosen], offsets, curvatures)
    lift_all = jax.vmap(lift, in_axes=(None, 0))
    before = lift_all(centres, paths[:, 0])
    after = lift_all(centres, paths[:, 1])
    regressors = jax.vmap(lift.regressors)(before, controls, envs, curvatures)
    return regressors, after - before


def _prediction_error(
    lift: Lift,
    params: Params,
    window: Trajectory,
    offset: Float[Array, " 2"],
    change: Scalar,
) -> Scalar:
    """Return the mean square error of a prediction relative to a circle.

    The circle is close to the one that the car drove, as the paths of a controller are.

    Args:
        lift: of states along a path.
        params: centres and weights.
        window: of a run.
        offset: e_y [m] and e_ψ [rad] of the first state from the circle.
        change: curvature of the circle, less that of the driven one [1/m].
    """
    dx, dy = jnp.diff(window.states[:, :2], axis=0).T
    steps = jnp.hypot(dx, dy)
    turned = jax.vmap(between)(window.states[:-1, POSE], window.states[1:, POSE])[:, 2]
    # The length counts as at least 1 m, or a car that stands would have an infinite
    # curvature.
    driven = jnp.sum(turned) / jnp.maximum(jnp.sum(steps), 1.0)
    kappa = jnp.clip(driven + change, -lift.curvature_range, lift.curvature_range)
    paths = along_circle(window.states, offset, kappa)

    def advance(z: Array, inputs: tuple[Control, Environment]) -> tuple[Array, Array]:
        control, env = inputs
        # The state is never lifted again: a controller propagates z as well.
        z = z + lift.regressors(z, control, env, kappa) @ params["weights"]
        return z, z[1 : lift.size]

    _, predicted = jax.lax.scan(
        advance, lift(params["centres"], paths[0]), (window.controls, window.envs)
    )
    # The progress, in metres, does not count: no feedback depends on it.
    true = ((paths - lift.centre) / lift.scale)[1:, 1:]
    return jnp.mean((predicted - true) ** 2)


def along_circle(
    states: Float[Array, "time state"], offset: Float[Array, " 2"], curvature: Scalar
) -> Float[Array, "time state"]:
    """Return states relative to a circle from which the first one has a given offset.

        s = atan2(κX, 1 − κY) / κ,   e_y and e_ψ of `circle_errors`,

    (X, Y, Θ) the pose in the frame of the circle's point closest to the first state.
    Returns (s, e_y, e_ψ, body state) at every time.

    Args:
        states: x_0 … x_T.
        offset: e_y [m] and e_ψ [rad] of x_0.
        curvature: κ [1/m].
    """
    # A straight path is a circle so large that float32 sees no difference.
    kappa = jnp.where(jnp.abs(curvature) < STRAIGHT, STRAIGHT, curvature)
    # First the heading of the path, then a step along its normal, on which e_y is
    # measured.
    tangent = states[0, POSE].at[2].add(-offset[1])
    foot = compose(tangent, jnp.stack([jnp.zeros(()), -offset[0], jnp.zeros(())]))

    def relative(state: State) -> State:
        pose = between(foot, state[POSE])
        # The arc of the angle is exact for large turns, where a chord is too short.
        arc = jnp.arctan2(kappa * pose[0], 1.0 - kappa * pose[1]) / kappa
        return jnp.stack([arc, *circle_errors(pose, kappa), *state[BODY]])

    return jax.vmap(relative)(states)


def ridge_regression(
    inputs: Float[Array, "sample p"],
    targets: Float[Array, "sample q"],
    ridges: Float[Array, " ridge"],
) -> Float[Array, "ridge p q"]:
    """Return W = argmin |X W − Y|² + λ N |D W|² for inputs X, targets Y, ridges λ > 0.

    D are the root mean squares of the columns of X. Solved by an orthogonal
    factorisation of [X D⁻¹, Y] instead of X'X, which float32 cannot resolve.
    """
    count = inputs.shape[1]
    spread = jnp.sqrt(jnp.mean(inputs**2, axis=0))
    # A column of zeros has no unit, and any unit will do.
    spread = jnp.where(spread > 0, spread, 1.0)
    columns = jnp.concatenate([inputs / spread, targets], axis=1)
    # Not X'X, whose condition is the square of that of X.
    triangle = jnp.linalg.qr(columns, mode="r")[:count]

    def solve(ridge: Scalar) -> Float[Array, "p q"]:
        # With √ridge as further rows, the penalty needs no X'X.
        penalty = jnp.sqrt(ridge * inputs.shape[0]) * jnp.eye(count)
        orthogonal, upper = jnp.linalg.qr(
            jnp.concatenate([triangle[:, :count], penalty])
        )
        right = orthogonal[: triangle.shape[0]].T @ triangle[:, count:]
        return solve_triangular(upper, right) / spread[:, None]

    # One ridge at a time, because a vmap would hold every factorisation in memory.
    return jax.lax.map(solve, ridges)
