"""Violations counted where the count is known, the theorem under attack, and forces
that nobody measures.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, driven, jit, model_and_params, same

from sfkd_jax import evaluation, models, plants, scenarios
from sfkd_jax.evaluation import (
    ClaimedBounds,
    Predictions,
    predictions,
    theorem_reach,
    theorem_violations,
    threshold_violations,
    tube_violations,
    violations,
)
from sfkd_jax.rollout import fibers_along, sliding_windows, window_errors
from sfkd_jax.types import Controller, Trajectory

DT = 0.1
PLANTS = {"kinematic": plants.kinematic(), "dynamic": plants.dynamic()}


def still(count=2, steps=12):
    """Cars that stand at the origin whatever they observe."""
    return Trajectory(
        jnp.zeros((count, steps + 1, 4)),
        jnp.zeros((count, steps, 2)),
        jnp.ones((count, steps, 2)),
    )


def drifting(*each):
    """A model that adds the same to every state."""
    return models.physics(lambda state, action, env: state + jnp.asarray(each))


def tube(position, yaw=9.0, body=9.0, horizon=4):
    return {
        "position_m": [position] * horizon,
        "yaw_rad": [yaw] * horizon,
        "body": [body] * horizon,
    }


def predicted(model, params, data, **lengths):
    """Predictions as the host sees them."""
    return jax.device_get(jit(partial(predictions, model, **lengths))(params, data))


# --- prediction errors -----------------------------------------------------------------------------------------------


def test_windows_are_the_stretches_that_start_at_every_stride():
    one = at(driven(), 0)
    cut = sliding_windows(one, horizon=5, stride=3)
    assert (
        cut.states.shape[0] == 3
    )  # from 0, 3, 6; the one from 9 does not fit into 12 steps
    for index, start in enumerate((0, 3, 6)):
        np.testing.assert_array_equal(cut.states[index], one.states[start : start + 6])
        np.testing.assert_array_equal(
            cut.controls[index], one.controls[start : start + 5]
        )
        np.testing.assert_array_equal(cut.envs[index], one.envs[start : start + 5])
    with pytest.raises(
        ValueError, match="a horizon of 13 steps does not fit trajectories of 12 steps"
    ):
        sliding_windows(one, horizon=13, stride=1)


def test_errors_of_a_constant_drift_are_its_multiples_and_yaw_is_wrapped():
    errors = window_errors(
        drifting(0.3, 0.4, 1.0, 0.5), {}, at(still(), 0), horizon=4, stride=4
    )
    steps = np.arange(1.0, 5.0)
    expected = np.stack(
        [0.5 * steps, np.minimum(steps, 2 * np.pi - steps), 0.5 * steps], axis=1
    )
    np.testing.assert_allclose(errors, np.broadcast_to(expected, (3, 4, 3)), rtol=1e-5)


# --- counting --------------------------------------------------------------------------------------------------------


def test_a_segment_leaves_its_tube_if_any_window_step_or_kind_does():
    errors = np.zeros((5, 2, 4, 3))
    errors[1, 1, 3, 0], errors[2, 0, 0, 1], errors[3, 1, 2, 2] = 1.01, 0.21, np.nan
    errors[4] = [1.0, 0.2, 3.0]  # on the edge
    assert tube_violations(errors, tube(1.0, 0.2, 3.0)) == (3, 5)
    assert tube_violations(errors, tube(2.0, 0.2, 3.0)) == (2, 5)


def test_a_drift_of_known_size_leaves_tubes_below_it_and_no_others():
    result = predicted(
        drifting(0.0, 0.25, 0, 0), {}, still(steps=20), length=10, horizon=4
    )
    assert tube_violations(result.errors, tube(1.001)) == (0, 4)
    assert tube_violations(result.errors, tube(0.999)) == (4, 4)
    growing = tube(0.0) | {"position_m": [0.2501, 0.5001, 0.7501, 1.0001]}
    assert tube_violations(result.errors, growing) == (0, 4)
    assert tube_violations(
        result.errors, growing | {"position_m": [0.2499, 9.0, 9.0, 9.0]}
    ) == (4, 4)


def test_windows_beyond_the_common_threshold_are_counted_by_window():
    errors = np.zeros((2, 3, 4, 3))
    errors[0, 0, 1, 0], errors[1, 2, 3, 0], errors[1, 1, 0, 1] = 1.1, np.inf, 9.0
    assert threshold_violations(errors, 1.0) == (2, 6)
    assert threshold_violations(errors, 1.2) == (1, 6)


# --- the theorem -----------------------------------------------------------------------------------------------------


def test_the_theorem_is_only_asked_about_steps_up_to_the_first_large_defect():
    defects = np.asarray([[[0.1, 0.1, 0.3, 0.1]]])
    errors = np.asarray([[[0.5, 0.0, 0.5, 0.5]]])
    assert theorem_violations(errors, defects, np.full(4, 0.4), 0.2) == (1, 2)
    assert theorem_violations(errors, defects, np.full(4, 0.6), 0.2) == (0, 2)
    assert theorem_violations(
        np.full((1, 1, 4), np.nan), defects, np.full(4, 0.6), 0.2
    ) == (2, 2)


def radii(alpha, d_bar, horizon):
    return d_bar * (1 - alpha ** np.arange(1, horizon + 1)) / (1 - alpha)


@pytest.mark.parametrize("alpha", [0.5, 0.93])
def test_a_linear_model_whose_defects_all_point_one_way_fills_the_tube_and_no_more(
    alpha,
):
    """s⁺ = α s beside the truth s⁺ = α s + d̄: |e_k| = R_k, so any smaller radius is
    left at every step.
    """
    d_bar, horizon = 0.2, 10
    model = models.physics(lambda state, action, env: state.at[3].multiply(alpha))
    speeds = [1.0]
    for _ in range(20):
        speeds.append(alpha * speeds[-1] + d_bar)
    data = still(count=1, steps=20)
    data = data._replace(states=data.states.at[0, :, 3].set(jnp.asarray(speeds)))
    result = predicted(model, {}, data, length=20, horizon=horizon)
    np.testing.assert_allclose(
        result.latent_errors[0, 0], radii(alpha, d_bar, horizon), rtol=1e-5
    )
    count, total = theorem_violations(
        result.latent_errors, result.defects, radii(alpha, d_bar, horizon), d_bar + 1e-6
    )
    assert (count, total) == (0, 3 * horizon)
    tighter = radii(alpha, d_bar, horizon) * (1 - 1e-3)
    assert theorem_violations(
        result.latent_errors, result.defects, tighter, d_bar + 1e-6
    ) == (total, total)


@cache
def attacked(name, d_bar, horizon=12):
    """Predictions of a tiny SFKD beside a truth that leaves it by d̄ at every step,
    always away from the prediction.
    """
    original, params = model_and_params(name)

    def read(fiber, state):
        return original.encode(fiber, state[:4])._replace(z=state[3:])

    model = original._replace(
        encode=read,
        observe=lambda fiber, latent, state: read(fiber, state),
        decode=lambda fiber, latent: jnp.concatenate([latent.pose, latent.z]),
    )

    def drive(controls, envs, start):
        blank = Trajectory(jnp.zeros((horizon + 1, 11)), controls, envs)
        fibers, later = fibers_along(model, params, blank)

        def step(pair, inputs):
            fiber, after, control = inputs
            true, guess = (
                model.transport(fiber, after, model.step(fiber, z, control))
                for z in pair
            )
            gap = true.z - guess.z + 1e-6 * start
            push = 0.9999 * d_bar * gap / jnp.linalg.norm(gap)
            true = true._replace(z=true.z + push)
            return (true, guess), jnp.concatenate([true.pose, true.z])

        origin = jnp.concatenate([jnp.zeros(3), start])
        both = read(at(fibers, 0), origin)
        _, states = jax.lax.scan(step, (both, both), (fibers, later, controls))
        return Trajectory(jnp.concatenate([origin[None], states]), controls, envs)

    data = driven()
    starts = jax.random.normal(jax.random.key(2), (3, 8))
    truth = jit(jax.vmap(drive))(data.controls, data.envs, starts)
    return predicted(model, params, truth, length=horizon, horizon=horizon)


@pytest.mark.parametrize("name", ["sfkd", "no_transport", "no_fiber"])
def test_no_defect_within_the_bound_takes_the_latent_out_of_its_tube(name):
    """Real weights, environments that switch at every step, defects of full size in the
    worst direction.
    """
    result, d_bar, alpha = attacked(name, 0.1), 0.1, 0.995
    count, total = theorem_violations(
        result.latent_errors, result.defects, radii(alpha, d_bar, 12), d_bar
    )
    assert (count, total) == (0, 3 * 12)


@pytest.mark.parametrize("name", ["sfkd", "no_transport", "no_fiber"])
def test_the_check_notices_a_rate_that_is_wrong(name):
    result, d_bar, alpha = attacked(name, 0.1), 0.1, 0.995 / 4
    count, total = theorem_violations(
        result.latent_errors, result.defects, radii(alpha, d_bar, 12), d_bar
    )
    assert total == 3 * 12
    assert count > total / 2


def test_the_latent_errors_of_the_true_plant_are_nothing_and_those_of_its_segments_are_the_rollouts():
    result = predicted(*model_and_params("oracle"), driven(), length=12, horizon=6)
    assert float(np.max(result.latent_errors)) < 1e-5
    assert float(np.max(result.defects)) < 1e-5
    wrong = predicted(*model_and_params("nominal"), driven(), length=12, horizon=6)
    np.testing.assert_allclose(
        wrong.latent_errors, wrong.errors[..., 2], atol=1e-6
    )  # the latent is the body state


def test_the_reach_is_the_largest_error_in_units_of_its_bound_where_the_hypothesis_holds():
    errors = np.asarray([[[0.1, 0.9, 9.0], [0.2, 0.3, 0.4]]])
    defects = np.asarray([[[0.1, 0.1, 0.5], [0.1, 0.1, 0.1]]])
    assert theorem_reach(
        errors, defects, np.asarray([0.2, 0.3, 0.4]), 0.2
    ) == pytest.approx([1.0, 3.0, 1.0])
    assert theorem_reach(
        errors, defects, np.asarray([0.1, 0.15, 0.2]), 0.2
    ) == pytest.approx([2.0, 6.0, 2.0])
    assert theorem_reach(errors, defects, np.asarray([0.2, 0.3, 0.4]), 0.05) == [
        None,
        None,
        None,
    ]


# --- the record ------------------------------------------------------------------------------------------------------


def test_the_record_names_the_tube_it_speaks_of_and_is_null_where_nothing_is_claimed():
    errors = np.zeros((4, 1, 4, 3))
    errors[0, 0, 3, 0] = 1.5
    result = Predictions(errors, np.full((4, 1, 4), 0.3), np.full((4, 1, 4), 0.1))
    everything = ClaimedBounds(
        tube(2.0), tube(1.0), 0.95, np.asarray([0.2, 0.4, 0.4, 0.4]), 0.1, 1.4
    )
    assert violations(result, everything) == {
        "v0": 0.25, "v0_reach": pytest.approx([1.5, 0.75, 0.75, 0.75]),
        "v1": 0.0, "v1_tube": "certified", "v1_radius_m": 2.0, "v1_conformal": 0.25,
        "v1_conformal_radius_m": 1.0, "v1_level": 0.95, "v2": 0.25, "v2_threshold_m": 1.4, "segments": 4,
        "window_error_m": {"median": 0.0, "p95": pytest.approx(0.85 * 1.5)},
    }  # fmt: skip
    measured = violations(result, ClaimedBounds(conformal=tube(1.0), level=0.95))
    assert (measured["v0"], measured["v1"], measured["v1_tube"], measured["v2"]) == (
        None,
        0.25,
        "conformal",
        None,
    )
    nothing = violations(result, ClaimedBounds())
    assert {name for name, value in nothing.items() if value is not None} == {
        "segments",
        "window_error_m",
    }
    unmeasured = violations(None, everything)
    assert all(
        unmeasured[name] is None
        for name in ("v0", "v1", "v1_conformal", "v2", "segments", "window_error_m")
    )
    assert unmeasured["v1_radius_m"] == 2.0


# --- forces that nobody measures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(
    ("wind", "force"), [(0.0, 250.0), (5.0, -250.0), (-8.0, 1000.0), (3.0, -900.0)]
)
def test_a_push_is_the_wind_that_pushes_as_hard(name, wind, force):
    plant = PLANTS[name]
    felt = plants.equivalent_wind(
        jnp.asarray(wind), jnp.asarray(force), wind_force=plant.wind_force
    )
    expected = plant.wind_force * wind * abs(wind) + force
    np.testing.assert_allclose(
        plant.wind_force * felt * abs(felt), expected, rtol=1e-5, atol=1e-3
    )


def test_a_push_accelerates_the_dynamic_plant_by_force_over_mass_and_turns_it_by_its_lever():
    plant, force = PLANTS["dynamic"], 600.0
    state, control = (
        jnp.asarray([0.0, 0.0, 0.3, 10.0, 0.1, 0.05, 0.02]),
        jnp.asarray([0.03, 0.5]),
    )
    felt = plants.equivalent_wind(
        jnp.asarray(4.0), jnp.asarray(force), wind_force=plant.wind_force
    )
    rates = [
        plant.derivative(state, control, jnp.stack([jnp.asarray(0.5), wind]))
        for wind in (felt, jnp.asarray(4.0))
    ]
    np.testing.assert_allclose(
        rates[0] - rates[1],
        [0, 0, 0, 0, force / 1500, 0.4 * force / 2500, 0],
        atol=2e-5,
    )


@cache
def roads():
    family = scenarios.scenario(name="s3", duration=6.0, state_size=4, dt=DT)
    return jit(jax.vmap(family))(jax.random.split(jax.random.key(0), 2))


def follower():
    """Steers by the first reference point and a random stream, and records the wind
    that it observes.
    """

    def act(params, state, observation, env, reference):
        state, draw = jax.random.split(state)
        info = {"effective_samples": env[1], "healthy": jnp.asarray(True)}
        info["predicted_states"] = jnp.tile(observation, (reference.shape[0], 1))
        steering = 0.3 * (reference[0, 2] - observation[2]) + 0.01 * jax.random.normal(
            draw
        )
        return jnp.stack([steering, jnp.zeros(())]), state, info

    return Controller(lambda key: key, act)


@cache
def episode(largest):
    plant, road, key = PLANTS["kinematic"], at(roads(), 0), jax.random.key(3)
    if largest is not None:
        envs = evaluation.disturbed_environment(plant, road.envs, key, largest=largest)
        road = road._replace(envs=envs)
    drive = partial(
        evaluation.simulate,
        plant.step,
        follower(),
        {},
        dt=DT,
        horizon=3,
        observation_noise=(0.02, 0.02),
    )
    return jit(drive)(road, key)


def test_a_force_of_zero_leaves_every_bit_of_an_episode_as_it_was():
    assert same(episode(None), episode(0.0), rtol=0, atol=0)


def test_a_controller_observes_the_wind_but_not_the_side_force():
    np.testing.assert_array_equal(
        episode(800.0).signals["effective_samples"], at(roads(), 0).envs[:, 1]
    )
    assert (
        float(jnp.max(jnp.abs(episode(800.0).lateral - episode(None).lateral))) > 0.02
    )


def test_pushes_are_redrawn_every_second_evenly_within_their_bound_and_grow_with_it():
    key = jax.random.key(1)
    force = np.asarray(
        scenarios.random_side_forces(key, steps=20005, dt=DT, largest=300.0)
    )
    assert len(force) == 20005
    levels = force[:20000].reshape(-1, 10)
    assert np.all(levels == levels[:, :1])
    assert len(np.unique(levels[:, 0])) == 2000
    assert np.max(np.abs(force)) <= 300.0
    np.testing.assert_allclose(
        np.quantile(force, [0.1, 0.5, 0.9]), [-240.0, 0.0, 240.0], atol=20.0
    )
    np.testing.assert_allclose(
        scenarios.random_side_forces(key, steps=20005, dt=DT, largest=600.0),
        2 * force,
        rtol=1e-6,
    )


def test_pushes_do_not_share_a_stream_with_the_planner_or_the_sensors():
    key = jax.random.key(4)
    streams = [
        jax.random.fold_in(key, evaluation._environment.FORCE_STREAM),
        *jax.random.split(key),
    ]
    assert (
        len({tuple(np.asarray(jax.random.key_data(stream))) for stream in streams}) == 3
    )
    with jax.debug_key_reuse(True):
        road = at(roads(), 0)
        envs = evaluation.disturbed_environment(
            PLANTS["kinematic"], road.envs, key, largest=100.0
        )
        jax.jit(
            partial(
                evaluation.simulate,
                PLANTS["kinematic"].step,
                follower(),
                {},
                dt=DT,
                horizon=3,
            )
        )(road._replace(envs=envs), key)
