"""EDMD: coordinates along circles, the regression, and plants that it recovers exactly."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, dataset, jit, space

from sfkd_jax import data as datasets
from sfkd_jax import paper
from sfkd_jax.geometry import compose
from sfkd_jax.paper._edmd import along_circle, ridge_regression
from sfkd_jax.rollout import rollout
from sfkd_jax.types import POSE, Trajectory

F = np.float32([[0.9, 0.1], [-0.2, 0.7]])
G = np.float32([[0.5, 0.0], [0.3, 0.2]])
BIAS = np.float32([0.4, -0.1])
KEY = jax.random.key(3)


def two_body_space():
    return space(4)._replace(
        body_mean=jnp.asarray([1.0, 0.0]), body_scale=jnp.asarray([2.0, 1.0])
    )


def parked(change, count=60, steps=12):
    """Trajectories of a plant that stands still while its two body states change."""
    keys = jax.random.split(jax.random.key(8), 3)
    controls = jax.random.uniform(keys[0], (count, steps, 2), minval=-0.4, maxval=0.4)
    envs = jnp.asarray([0.6, 0.0]) + jnp.asarray([0.3, 8.0]) * jax.random.uniform(
        keys[1], (count, steps, 2), minval=-1
    )
    start = jax.random.uniform(keys[2], (count, 5), minval=-1.0)

    def step(state, inputs):
        after = state.at[3:].set(change(state[3:], *inputs))
        return after, after

    def drive(start, *inputs):
        return jnp.concatenate([start[None], jax.lax.scan(step, start, inputs)[1]])

    return Trajectory(jax.jit(jax.vmap(drive))(start, controls, envs), controls, envs)


def switching_change(body, control, env):
    """Affine in friction, linear in state and control for each."""
    return F @ body + (env[0] - 0.5) * (body[::-1] + G @ control) + env[0] * BIAS


def identified(model, trajectories):
    half = len(trajectories.states) // 2
    train, validation = (
        jax.tree.map(lambda leaf, s=part: leaf[s], trajectories)
        for part in (np.s_[:half], np.s_[half:])
    )
    return jit(model.fitting.identify)(train, validation, KEY)


def physical(model, params, env):
    """x⁺ = A x + B u + d κ + c in physical units, for a lift of the state alone."""
    linear = model.structure.linear(model.fiber(params, jnp.asarray(env)))
    A = linear.C @ linear.A @ jnp.linalg.inv(linear.C)
    return (
        A,
        linear.C @ linear.B,
        linear.C @ linear.d,
        linear.C @ linear.c + linear.o - A @ linear.o,
    )


@pytest.mark.parametrize("curvature", [-0.03, 0.0, 1e-4, 0.02])
def test_states_along_a_circle_have_the_coordinates_they_were_made_with(curvature):
    """Poses built from progress, offset and heading give these back, for any radius."""
    progress, left, heading = np.float32(
        [[0.0, 1.0, 12.0], [0.5, -0.8, 2.0], [0.1, 0.0, -0.3]]
    )
    origin = jnp.asarray([12.0, -7.0, 2.5])

    def state_at(s, y, psi):
        turn = curvature * s
        foot = jnp.stack(
            [
                s * jnp.sinc(turn / jnp.pi),
                s * jnp.sinc(turn / 2 / jnp.pi) * jnp.sin(turn / 2),
                turn,
            ]
        )
        return jnp.append(
            compose(compose(origin, foot), jnp.stack([jnp.zeros(()), y, psi])), 9.0
        )

    states = jax.vmap(state_at)(progress, left, heading)
    seen = along_circle(
        states, jnp.asarray([left[0], heading[0]]), jnp.asarray(curvature)
    )
    np.testing.assert_allclose(
        seen, np.stack([progress, left, heading, np.full(3, 9.0)], axis=1), atol=2e-5
    )


def test_a_plant_that_varies_with_the_environment_is_recovered():
    friction = 0.8
    model = paper.koopman(two_body_space(), functions=0, ridges=(1e-10,))
    A, B, _, c = physical(
        model, identified(model, parked(switching_change)), [friction, -3.0]
    )
    np.testing.assert_allclose(
        A[3:, 3:], F + (friction - 0.5) * np.eye(2)[::-1], atol=2e-4
    )
    np.testing.assert_allclose(B[3:], (friction - 0.5) * G, atol=2e-4)
    np.testing.assert_allclose(c[3:], friction * BIAS, atol=2e-4)


def test_ridge_regression_minimises_its_objective():
    random = np.random.default_rng(0)
    X = random.standard_normal((200, 6)) * np.float64([1, 10, 0.1, 1, 1, 0])
    Y, ridges = random.standard_normal((200, 3)), np.float32([1e-6, 0.1])
    fits = ridge_regression(
        jnp.asarray(X, jnp.float32), jnp.asarray(Y, jnp.float32), jnp.asarray(ridges)
    )
    D = np.sqrt(np.mean(X**2, axis=0)) + np.float64([0, 0, 0, 0, 0, 1])
    for ridge, W in zip(ridges, fits, strict=True):
        expected = np.linalg.solve(X.T @ X + ridge * 200 * np.diag(D**2), X.T @ Y)
        np.testing.assert_allclose(W, expected, rtol=1e-4, atol=1e-5)


def test_regression_survives_columns_that_normal_equations_do_not():
    """Nearly parallel columns: in float32, X'X is singular."""
    random = np.random.default_rng(1)
    base = random.standard_normal(1000)
    X = np.stack([base, base + 3e-4 * random.standard_normal(1000)], axis=1)
    fits = ridge_regression(
        *(jnp.asarray(part, jnp.float32) for part in (X, X @ np.ones((2, 1)), [1e-12]))
    )
    np.testing.assert_allclose(fits[0, :, 0], [1.0, 1.0], atol=1e-2)


@cache
def driving():
    """A model of the kinematic car and its parameters, from a few segments of driving."""
    model = paper.koopman(datasets.measure_space(dataset()), functions=30)
    return model, jit(model.fitting.identify)(
        dataset().train, dataset().validation, KEY
    )


def test_driving_is_predicted_far_better_than_by_no_change():
    """Initial parameters predict no change; the drives are neither for fitting nor
    selection.
    """
    model, params = driving()
    each = jax.vmap(partial(rollout, model), in_axes=(None, 0))
    miss = jit(lambda params, drives: each(params, drives).defects)
    errors, zero = (
        np.sqrt(np.mean(np.square(miss(p, dataset().test)), axis=(0, 1)))
        for p in (params, model.init(KEY))
    )
    assert np.all(errors < 0.25 * zero)  # e_y, e_ψ, v


def test_the_model_and_its_linear_predictor_are_one_on_a_straight_path():
    model, params = driving()
    drive = at(dataset().test, 0)

    @jit
    def both(params, state, control, env):
        fiber = model.fiber(params, env)
        linear = model.structure.linear(fiber)
        latent = model.step(fiber, model.encode(fiber, state), control)
        start = linear.lift(state.at[POSE].set(0.0))
        path = linear.C @ (linear.A @ start + linear.B @ control + linear.c) + linear.o
        return model.decode(fiber, latent), path.at[POSE].set(
            compose(state[POSE], path[POSE])
        )

    one, other = both(params, drive.states[5], drive.controls[5], drive.envs[5])
    np.testing.assert_allclose(one, other, atol=1e-5)
