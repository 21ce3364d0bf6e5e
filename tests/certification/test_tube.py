"""Tubes from α and d̄: the formula, the paper's erratum, and simulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, at, certified, driven, jit, model_and_params

from sfkd_jax.certification import certify, latent_tube
from sfkd_jax.certification._measured import KINDS, residuals
from sfkd_jax.certification._tubes import tubes
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.rollout import rollout


@pytest.mark.parametrize(
    ("alpha", "d_bar"), [(0.9, 0.3), (0.5, 1.0), (0.0, 0.7), (0.995, 1e-3)]
)
def test_the_latent_tube_is_the_closed_formula(alpha, d_bar):
    exact = d_bar * (1 - alpha ** np.arange(1, 41)) / (1 - alpha)
    np.testing.assert_allclose(latent_tube(alpha, d_bar, 40), exact, rtol=1e-12)


def scaled_to_the_limit(params):
    """Operators that are multiples of the identity: ρ acts in every direction, so the
    tube is nearly reached.
    """
    limit = 10.0 * np.tile(np.eye(8, dtype=np.float32), (3, 1, 1))
    return params | {"networks": params["networks"] | {"operators": limit}}


@pytest.mark.parametrize(("aligned", "limit"), [(False, False), (True, True)])
def test_with_bounded_disturbances_the_tube_is_violated_exactly_never(aligned, limit):
    """Latents under the same u, switching e and transport; one of them is disturbed
    by |d| ≤ d̄ at every step.
    """
    model, params = model_and_params("sfkd")
    params = scaled_to_the_limit(params) if limit else params
    alpha = certify(model, params, (ENV_LOW, ENV_HIGH), attack_starts=0).alpha
    d_bar, steps, episodes = 0.05, 120, 16

    def episode(params, key):
        start_key, push_key, env_key, control_key = jax.random.split(key, 4)
        envs = jnp.asarray([0.6, 0.0]) + jnp.asarray([0.3, 8.0]) * jax.random.uniform(
            env_key, (steps, 2), minval=-1.0
        )
        controls = jnp.asarray([0.3, 3.0]) * jax.random.normal(control_key, (steps, 2))
        fibers = jax.vmap(model.fiber, in_axes=(None, 0))(params, envs)
        later = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0), fibers)
        start = model.encode(at(fibers, 0), jnp.asarray([0.0, 0.0, 0.0, 10.0]))
        start = start._replace(z=jax.random.normal(start_key, (8,)))

        def step(pair, inputs):
            here, there, control, push = inputs
            truth, model_latent = (
                model.transport(here, there, model.step(here, latent, control))
                for latent in pair
            )
            gap = truth.z - model_latent.z
            direction = gap + 1e-6 * push if aligned else push
            # |d| stays below d̄ by 1e-4 of it, more than float32 rounds in adding it
            truth = truth._replace(
                z=truth.z + d_bar * (1 - 1e-4) * direction / jnp.linalg.norm(direction)
            )
            return (truth, model_latent), jnp.linalg.norm(truth.z - model_latent.z)

        pushes = jax.random.normal(push_key, (steps, 8))
        return jax.lax.scan(step, (start, start), (fibers, later, controls, pushes))[1]

    keys = jax.random.split(jax.random.key(4), episodes)
    errors = jit(jax.vmap(episode, in_axes=(None, 0)))(params, keys)
    errors = np.asarray(errors, dtype=np.float64)
    tube = latent_tube(alpha, d_bar, steps)
    assert int(np.sum(errors > tube)) == 0
    if aligned and limit:
        assert errors.max() > 0.15 * tube[-1]  # the check is not about nothing
        assert errors[:, :5].max() > 0.7 * tube[4]


def test_the_physical_tube_is_its_finite_sums():
    """R = 0, 2, 3: with increments, and the limits along a path."""
    given = {
        "alpha": 0.5,
        "lipschitz": {"position": 2.0, "yaw": 0.5, "body": 3.0},
        "one_step": {"latent": 2.0, "position": 0.1, "yaw": 0.01, "body": 0.2},
        "horizon": 3,
    }
    tube = tubes(**given, largest_increment=10.0)["physical"]
    yaw = [0.01, 0.02 + 1.0, 0.03 + 2.5]
    np.testing.assert_allclose(tube["yaw_rad"], yaw)
    position = [0.1, 0.2 + 4.0 + 10 * yaw[0], 0.3 + 10.0 + 10 * (yaw[0] + yaw[1])]
    np.testing.assert_allclose(tube["position_m"], position)
    np.testing.assert_allclose(tube["body"], [0.2, 0.2 + 3.0, 0.2 + 4.5])
    along = tubes(**given, largest_increment=None)
    np.testing.assert_allclose(along["physical"]["position_m"], [0.1, 2.1, 3.1])
    assert along["ultimate"] == 4.0
    assert along["asymptotic"] == pytest.approx(
        {"position_m": 4.1, "yaw_rad": 1.01, "body": 6.2}
    )


def test_free_running_predictions_stay_inside_the_physical_tube():
    """Trajectories whose one-step disturbances are bounded as measured: position, yaw
    and body state for 12 steps, with a switch of the environment at every one of them.
    The theorem leaves no exception.
    """
    model, params = model_and_params("sfkd")
    data, proved = driven(24), certified("sfkd")
    measured = dict(zip(KINDS, residuals(model, params, data).largest().T, strict=True))
    each = jit(jax.vmap(lambda one: rollout(model, params, one)[0]))
    predicted = np.asarray(each(data))
    true = np.asarray(data.states)[:, 1:]
    position = np.linalg.norm(predicted[..., :2] - true[..., :2], axis=-1)
    yaw = np.abs(wrap_angle(jnp.asarray(predicted[..., 2] - true[..., 2])))
    body = np.linalg.norm(predicted[..., 3:] - true[..., 3:], axis=-1)
    moves = np.linalg.norm(np.diff(np.asarray(data.states)[..., :2], axis=1), axis=-1)
    for k in range(len(predicted)):
        tube = tubes(
            alpha=proved.alpha,
            lipschitz=proved.lipschitz,
            one_step={kind: float(measured[kind][k]) for kind in KINDS},
            horizon=12,
            largest_increment=float(moves[k].max()),
        )["physical"]
        for radii, error in zip(tube.values(), (position, yaw, body), strict=True):
            assert np.all(error[k] <= np.asarray(radii) + 2e-5)
