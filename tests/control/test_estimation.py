"""The estimated environment: accuracy, and what must not affect it."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, jit

from sfkd_jax import control, models, plants
from sfkd_jax.types import Controller, Model

PLANT = plants.kinematic()
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH, "states": 4}
NOISE = (0.015, 0.015, 0.002, 0.03)
EXACT = {
    "sensor_noise": (1e-4, 1e-4, 1e-5, 1e-4),
    "model_error": (1e-4, 1e-4, 1e-5, 1e-4),
}
STEPS = 60
TIME = np.arange(STEPS)
CONTROLS = np.stack(
    [0.04 * np.sin(0.7 * TIME), 1.5 * np.cos(0.5 * TIME)], axis=1
).astype(np.float32)
CALM, STORM = (0.9, 0.0), (0.3, 8.0)
SWITCHED = np.where(TIME[:, None] < 30, CALM, STORM)


def scripted(controls=CONTROLS):
    """Play recorded controls and report the inputs in the info."""

    def act(params, count, observation, env, reference):
        return (
            jnp.asarray(controls)[count],
            count + 1,
            {"env": env, "seen": observation},
        )

    return Controller(lambda key: jnp.zeros((), dtype=int), act)


@cache
def estimator(**settings):
    return control.estimated(scripted(), models.physics(PLANT.step), **BOX | settings)


def driven(envs, noise=(0.0,) * 4, start=(0.0, 0.0, 0.0, 10.0), seed=0):
    """Measurements of a drive before every control, with noise."""

    def step(state, inputs):
        return PLANT.step(state, *inputs), state

    _, states = jit(lambda start, inputs: jax.lax.scan(step, start, inputs))(
        jnp.asarray(start), (jnp.asarray(CONTROLS), jnp.asarray(envs, dtype=float))
    )
    return (
        np.asarray(states)
        + np.random.default_rng(seed).normal(size=states.shape) * noise
    )


@cache
def follower(**settings):
    """observations -> infos and states of the estimator, in one scan; the environment
    it is given is NaN.
    """
    planner = estimator(**settings)

    def step(state, observation):
        _, state, info = planner.act(
            {}, state, observation, jnp.full(2, jnp.nan), jnp.zeros((1, 4))
        )
        return state, (info, state)

    return jit(
        lambda seen: jax.lax.scan(step, planner.init(jax.random.key(0)), seen)[1]
    )


def follow(observations, **settings):
    info, state = follower(**settings)(jnp.asarray(observations, dtype=float))
    return jax.tree.map(np.asarray, (info, state))


@pytest.mark.parametrize("env", [CALM, STORM, (0.6, -4.0)])
def test_without_noise_an_environment_of_the_grid_is_found_exactly(env):
    info, _ = follow(
        driven(np.tile(env, (STEPS, 1))), dwell=1e6, drift=(0.0, 0.0), **EXACT
    )
    np.testing.assert_allclose(info["env_estimate"][-1], env, atol=1e-3)
    np.testing.assert_allclose(info["env_spread"][-1], 0.0, atol=1e-2)


def test_between_hypotheses_the_estimate_lies_within_a_cell_of_the_truth():
    """0.55 and 3.3 m/s are between grid points; the grid spacing is 0.1 and 1 m/s."""
    info, _ = follow(driven(np.tile([0.55, 3.3], (STEPS, 1))), **EXACT)
    assert np.all(np.abs(info["env_estimate"][-10:] - [0.55, 3.3]) < [0.1, 1.0])


def test_a_switch_is_seen_within_a_few_noisy_steps():
    """Six steps after a storm of 8 m/s begins, its estimate is within 2 m/s, apart from
    rare false alarms.
    """
    winds = np.stack(
        [
            follow(driven(SWITCHED, NOISE, seed=seed))[0]["env_estimate"][:, 1]
            for seed in range(4)
        ]
    )
    assert np.mean(np.abs(winds[:, 15:30]) < 2.0) > 0.9
    assert np.mean(np.abs(winds[:, 36:] - 8.0) < 2.0) > 0.9
    assert np.mean(np.abs(winds[:, 30] - 8.0) < 2.0) == 0.0  # nothing has moved yet


def test_the_true_environment_lies_inside_the_reported_spread():
    """In at least 90 % of the steps within two standard deviations, off the grid and
    with noise.
    """
    inside = []
    for seed in range(4):
        env = np.random.default_rng(seed).uniform([0.35, -7.0], [0.85, 7.0])
        info, _ = follow(driven(np.tile(env, (STEPS, 1)), NOISE, seed=seed))
        inside.append(
            np.abs(info["env_estimate"] - env)[10:]
            <= 2.0 * info["env_spread"][10:] + 0.02
        )
    assert np.mean(inside) > 0.9


def test_what_the_motion_does_not_show_stays_unknown():
    """If the motion depends on neither entry, mean and deviation stay those of an even
    grid.
    """
    blind = models.physics(PLANT.nominal)
    planner = control.estimated(scripted(), blind, points=(3, 5), **BOX)
    state = planner.init(jax.random.key(0))
    act = jit(planner.act)
    for observation in driven(SWITCHED, NOISE)[:5]:
        _, state, info = act(
            {}, state, jnp.asarray(observation), jnp.zeros(2), jnp.zeros((1, 4))
        )
    np.testing.assert_allclose(info["env_estimate"], [0.6, 0.0], atol=1e-5)
    np.testing.assert_allclose(
        info["env_spread"],
        [np.std([0.3, 0.6, 0.9]), np.std([-8, -4, 0, 4, 8])],
        rtol=1e-5,
    )


def test_where_the_drive_starts_and_heads_does_not_matter():
    """Observations transformed by an element of SE(2), heading across ±π: the same
    estimates.
    """
    here = driven(SWITCHED)
    turn = 3.1
    moved = driven(SWITCHED, start=(250.0, -90.0, turn, 10.0))
    moved[:, 2] = (moved[:, 2] + np.pi) % (2 * np.pi) - np.pi
    first, _ = follow(here)
    second, _ = follow(moved)
    np.testing.assert_allclose(first["env_estimate"], second["env_estimate"], atol=0.05)


def test_probabilities_stay_probabilities():
    _, state = follow(driven(SWITCHED, NOISE))
    np.testing.assert_allclose(state.probabilities.sum(axis=1), 1.0, atol=1e-4)
    assert state.probabilities.min() > 0.0  # or a switch could never be believed


def test_a_lost_observation_changes_no_belief_but_by_the_chain_and_is_passed_on():
    seen = driven(SWITCHED, NOISE)
    seen[40] = np.nan
    info, state = follow(seen, dwell=1e6, drift=(0.0, 0.0))
    np.testing.assert_allclose(
        state.probabilities[40], state.probabilities[39], atol=1e-5
    )
    assert np.isnan(info["seen"][40]).all()
    assert np.isfinite(info["env_estimate"]).all()
    assert np.isfinite(info["seen"][41:]).all()


def test_nothing_is_learnt_before_the_first_observation():
    seen = driven(SWITCHED, NOISE)
    seen[:3] = np.nan
    info, _ = follow(seen)
    np.testing.assert_allclose(
        info["env_estimate"][:4], np.tile([0.6, 0.0], (4, 1)), atol=1e-4
    )
    assert np.abs(info["env_estimate"][25] - CALM)[1] < 2.0


def test_a_jump_that_nothing_explains_moves_the_states_and_not_the_belief():
    seen = driven(np.tile(STORM, (STEPS, 1)), NOISE)
    seen[30:, :2] += 50.0
    info, _ = follow(seen)
    assert (
        abs(info["env_estimate"][30, 1] - info["env_estimate"][29, 1]) < 0.6
    )  # what the chain alone does
    np.testing.assert_allclose(info["seen"][30], seen[30], atol=1e-4)


def test_hypotheses_whose_model_breaks_are_left_out_and_poison_nothing():
    def breaks(state, control, env):
        return jnp.where(env[0] < 0.45, jnp.nan, PLANT.step(state, control, env))

    planner = control.estimated(scripted(), models.physics(breaks), **BOX)
    state, act = planner.init(jax.random.key(0)), jit(planner.act)
    for observation in driven(np.tile([0.7, -6.0], (STEPS, 1)), NOISE)[:25]:
        _, state, info = act(
            {}, state, jnp.asarray(observation), jnp.zeros(2), jnp.zeros((1, 4))
        )
    assert abs(info["env_estimate"][1] + 6.0) < 2.0
    assert info["env_estimate"][0] > 0.5
    assert all(
        bool(jnp.isfinite(leaf).all())
        for leaf in (state.states, state.covariance, state.probabilities)
    )


def test_the_state_that_is_planned_from_is_nearer_to_the_truth_than_the_sensors():
    truth, seen = (
        driven(np.tile(STORM, (STEPS, 1))),
        driven(np.tile(STORM, (STEPS, 1)), NOISE),
    )
    smooth, _ = follow(seen)
    raw, _ = follow(seen, smooth=False)
    np.testing.assert_allclose(raw["seen"], seen, rtol=1e-6)
    error = lambda states: np.sqrt(np.mean((states[15:] - truth[15:]) ** 2, axis=0))
    assert np.all(error(smooth["seen"]) < 0.9 * error(seen))


def test_the_state_keeps_its_types_so_that_act_is_compiled_once():
    before = jax.eval_shape(estimator().init, jax.random.key(0))
    inputs = jnp.zeros(4), jnp.zeros(2), jnp.zeros((1, 4))
    _, after, _ = jax.eval_shape(estimator().act, {}, before, *inputs)
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    assert [
        (a, b)
        for a, b in pairs
        if (a.shape, a.dtype, a.weak_type) != (b.shape, b.dtype, b.weak_type)
    ] == []


def test_it_drives_as_any_controller_under_jit_and_vmap():
    planner = estimator()
    keys = jax.random.split(jax.random.key(1), 3)
    states = jax.vmap(planner.init)(keys)
    seen = jnp.asarray(driven(SWITCHED)[:3])
    controls, _, info = jit(jax.vmap(planner.act, in_axes=({}, 0, 0, 0, None)))(
        {}, states, seen, jnp.zeros((3, 2)), jnp.zeros((1, 4))
    )
    assert controls.shape == (3, 2)
    assert info["env_estimate"].shape == (3, 2)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"points": (1, 5)}, "points"),
        ({"points": (5,)}, "points"),
        ({"dwell": 1.0}, "dwell"),
        ({"drift": (-0.1, 0.1)}, "drift"),
        ({"model_error": (0.0,) * 4}, "model_error"),
        ({"sensor_noise": (0.1,) * 2}, "sensor_noise"),
        ({"env_low": (0.9, -8.0)}, "env_low"),
    ],
)
def test_invalid_settings_are_refused_by_name(change, word):
    with pytest.raises(ValueError, match=word):
        control.estimated(scripted(), Model(*[None] * 8), **BOX | change)
