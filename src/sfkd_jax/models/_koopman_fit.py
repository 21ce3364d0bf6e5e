"""Regression of the Koopman baseline on driven trajectories."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import between
from sfkd_jax.models._edmd import along_circle
from sfkd_jax.models._identification import ridge_regression
from sfkd_jax.models._koopman_lift import Lift
from sfkd_jax.types import POSE, Control, Environment, Key, Params, Scalar, Trajectory

VALIDATION_SHARE = 0.1
"""Share of the ranges that the validation predictions use: a controller keeps the car
near its path.
"""


def random_centres(lift: Lift, key: Key) -> Float[Array, "function coordinate"]:
    """Draw centres uniformly from the box [-1, 1] of ξ."""
    return jax.random.uniform(key, (lift.functions, lift.size - 1), minval=-1.0)


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
        lift: with random centres, drawn here.
        train: trajectories that the pairs come from.
        validation: trajectories that choose the ridge.
        key: consumed.
        ridges: to choose from.
        transitions: largest number of pairs.
        horizon: of the validation predictions, steps.
    """
    centre_key, pair_key, circle_key = jax.random.split(key, 3)
    centres = random_centres(lift, centre_key)
    fits = ridge_regression(
        *_pairs(lift, train, centres, pair_key, transitions), jnp.asarray(ridges)
    )
    count, steps = validation.controls.shape[:2]
    length = min(horizon, steps)
    states, *inputs = validation
    windows = Trajectory(
        states[:, : length + 1], *(leaf[:, :length] for leaf in inputs)
    )
    drawn = jax.tree.map(
        lambda leaf: VALIDATION_SHARE * leaf, _circles(lift, circle_key, count)
    )

    def error(weights: Float[Array, "regressor rank"]) -> Scalar:
        params = {"centres": centres, "weights": weights}
        return jnp.mean(
            jax.vmap(lambda *each: _prediction_error(lift, params, *each))(
                windows, *drawn
            )
        )

    errors = jax.lax.map(error, fits)
    return {
        "centres": centres,
        "weights": fits[jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))],
    }


def _circles(
    lift: Lift, key: Key, count: int
) -> tuple[Float[Array, "sample 2"], Float[Array, " sample"]]:
    """Draw offsets (e_y, e_ψ) from circles, and their curvatures, uniformly."""
    drawn = jax.random.uniform(key, (count, 3), minval=-1.0)
    return drawn[:, :2] * jnp.asarray(
        [lift.lateral_range, lift.heading_range]
    ), lift.curvature_range * drawn[:, 2]


def _pairs(
    lift: Lift,
    train: Trajectory,
    centres: Float[Array, "function coordinate"],
    key: Key,
    most: int,
) -> tuple[Float[Array, "sample regressor"], Float[Array, "sample rank"]]:
    """Regressors and increments of the lift, one row per transition."""
    choice_key, circle_key = jax.random.split(key)
    ends = jnp.stack([train.states[:, :-1], train.states[:, 1:]], axis=2).reshape(
        -1, 2, lift.size
    )
    chosen = jax.random.permutation(choice_key, ends.shape[0])[:most]
    controls, envs = (
        leaf.reshape(ends.shape[0], -1)[chosen] for leaf in (train.controls, train.envs)
    )
    offsets, curvatures = _circles(lift, circle_key, chosen.shape[0])
    paths = jax.vmap(along_circle)(ends[chosen], offsets, curvatures)
    before, after = (
        jax.vmap(lift, in_axes=(None, 0))(centres, paths[:, k]) for k in (0, 1)
    )
    return jax.vmap(lift.regressors)(before, controls, envs, curvatures), after - before


def _prediction_error(
    lift: Lift,
    params: Params,
    window: Trajectory,
    offset: Float[Array, " 2"],
    change: Scalar,
) -> Scalar:
    """Mean square error of a prediction relative to a circle close to the window."""
    steps = jnp.hypot(*jnp.diff(window.states[:, :2], axis=0).T)
    turned = jax.vmap(between)(window.states[:-1, POSE], window.states[1:, POSE])[:, 2]
    bend = jnp.sum(turned) / jnp.maximum(jnp.sum(steps), 1.0)
    kappa = jnp.clip(bend + change, -lift.curvature_range, lift.curvature_range)
    paths = along_circle(window.states, offset, kappa)

    def advance(z: Array, inputs: tuple[Control, Environment]) -> tuple[Array, Array]:
        z = z + lift.regressors(z, *inputs, kappa) @ params["weights"]
        return z, z[1 : lift.size]

    _, predicted = jax.lax.scan(
        advance, lift(params["centres"], paths[0]), (window.controls, window.envs)
    )
    return jnp.mean((predicted - ((paths - lift.centre) / lift.scale)[1:, 1:]) ** 2)
