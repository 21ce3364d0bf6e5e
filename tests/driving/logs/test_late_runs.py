"""Recorded runs of a policy with a latency: rows of one time, and commands that act."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composing import run

import sfkd_jax
from sfkd_jax import assembly, collect
from sfkd_jax.certificate import write
from sfkd_jax.driving import simulation
from sfkd_jax.driving.corridor import closed_loop, scores_of_runs
from sfkd_jax.driving.logs import recorded_runs, recorder
from sfkd_jax.driving.logs._logs import Log
from sfkd_jax.driving.logs._recorded import Timing, run_columns
from sfkd_jax.driving.logs._recorded import _check_rows as check_rows
from sfkd_jax.driving.path_coordinates import curvature_ahead, path_coordinates
from sfkd_jax.driving.paths import reference_window
from sfkd_jax.latency import CommandDelay
from sfkd_jax.types import Controller, Trajectory

LATENCY = sfkd_jax.Latency((0.1,), ())
HELD = 4
PRETRAINED = Path(sfkd_jax.__file__).parent / "pretrained"
RUNS = 3
STEPS = 60


@pytest.fixture(scope="module")
def policy():
    return sfkd_jax.load("kinematic_path", latency=LATENCY)


def random_planner(policy):
    """The law, and at every step another ν that the law tolerates."""

    def act(params, state, xi, env, preview):
        key, k = state
        draw = jax.random.uniform(jax.random.fold_in(key, k // HELD), (2,), minval=-1.0)
        road = preview.road[0]
        nu = jnp.sign(draw) * policy.law.perturbation
        return policy.law(xi, road[0], road[1], env) + nu, (key, k + 1), None

    return Controller(lambda key: (key, jnp.zeros((), int)), act)


@pytest.fixture(scope="module")
def driven(policy):
    """Episodes of a car with the latency, and where its path goes at their states."""
    plant = policy.vehicle
    controller = policy.shield(random_planner(policy), along_path=True)
    family = assembly.build_scenario(
        {"name": "s3", "speed": 10.0}, plant, duration=STEPS * plant.dt
    )
    signals = {
        "path": lambda info: info.path._replace(planned=None),
        "nu": lambda info: info.shield.perturbation,
    }

    def drive(key):
        scenario = family(key)
        # One e: else its switches, and not the inputs, decide the scores.
        envs = jnp.tile(jnp.asarray([0.6, 2.0]), (STEPS, 1))
        episode = simulation.simulate(
            plant.step,
            controller,
            policy.params,
            scenario._replace(envs=envs, observed_envs=envs),
            key,
            dt=plant.dt,
            horizon=policy.interface["horizon"],
            # A sensor that repeats its first reading would count as frozen.
            observation_noise=(1e-5,) * 4,
            latency=LATENCY,
            record=signals,
        )
        along = jnp.append(0.0, episode.progress)
        points = jax.vmap(
            lambda s: reference_window(
                scenario.path, s, scenario.speed, dt=plant.dt, horizon=3
            )
        )(along)
        return episode, points, envs

    keys = jax.random.split(jax.random.key(3), RUNS)
    return jax.tree.map(np.asarray, jax.jit(partial(jax.lax.map, drive))(keys))


@pytest.fixture(scope="module")
def folder(policy, driven, tmp_path_factory):
    """The same episodes, as `recorder` writes them."""
    folder = tmp_path_factory.mktemp("late")
    episodes, _, envs = driven
    path = episodes.signals["path"]
    nu = episodes.signals["nu"]
    for number in range(RUNS):
        with recorder(policy, folder / f"{number}.csv") as record:
            for at in zip([number] * STEPS, range(STEPS), strict=True):
                info = SimpleNamespace(
                    shield=SimpleNamespace(perturbation=nu[at]),
                    path=jax.tree.map(lambda leaf, at=at: leaf[at], path),
                    env_inside=True,
                )
                seen = np.append(np.zeros(3), info.path.xi[2:])
                record(seen, envs[at], episodes.controls[at], info)
    return folder


def true_runs(policy, driven, steps):
    """The runs in path coordinates, by true states and the commands that acted.

    Returns:
        The runs, with the ν that acted at the true state; and the ν of the shield.
    """
    episodes, points, envs = driven
    # The command of a call acts at once. At call 1 all that was sent before is known.
    rows = slice(1, steps + 1)
    curvature = jax.vmap(jax.vmap(lambda p: curvature_ahead(p)[0]))(points)
    xi = jax.vmap(jax.vmap(path_coordinates))(
        episodes.states, points[:, :, 0], curvature
    )
    road = jnp.stack([curvature, points[..., 0, 3]], axis=-1)[:, rows]
    law = jax.vmap(jax.vmap(policy.law))(
        xi[:, rows], road[..., 0], road[..., 1], envs[:, rows]
    )
    acting = episodes.controls[:, rows] - law
    states = jnp.concatenate([jnp.zeros((*xi.shape[:2], 3)), xi], axis=-1)
    runs = Trajectory(
        states[:, 1 : steps + 2],
        jnp.concatenate([acting, road], axis=-1),
        jnp.asarray(envs[:, rows]),
    )
    return runs, episodes.signals["nu"][:, rows]


@pytest.fixture(scope="module")
def scores(policy):
    loop = closed_loop(policy.vehicle, policy.model, policy.params, policy.law, ())
    claims = policy.certificate.proof.outputs
    return lambda runs: scores_of_runs(loop, claims, runs)[0]


def shifted(runs, periods):
    """The runs with every ν some periods too late."""
    nu = jnp.roll(runs.controls[..., :2], periods, axis=1)
    return runs._replace(controls=runs.controls.at[..., :2].set(nu))


def test_rows_are_of_the_time_at_which_a_command_acts(policy, driven, folder, scores):
    runs, _ = recorded_runs(str(folder), policy, LATENCY)
    true, nu = true_runs(policy, driven, runs.controls.shape[1])
    # Runs are read in another order.
    order = np.argsort(runs.states[:, 9, 5])
    runs = jax.tree.map(lambda leaf: leaf[order], runs)
    order = np.argsort(true.states[:, 9, 5])
    true = jax.tree.map(lambda leaf: leaf[order], true)
    np.testing.assert_allclose(runs.states, true.states, atol=1e-4)
    road = runs.controls[..., 2:]
    np.testing.assert_allclose(road, true.controls[..., 2:], atol=1e-5)
    np.testing.assert_array_equal(runs.controls[..., :2], nu[order])
    measured = scores(runs)
    # The law reads a prediction, whose error is part of what acts. In a corridor it is
    # a disturbance, since the shield does not know it.
    of_acting = scores(true)
    assert (measured < 1.6 * of_acting).all()
    assert (measured > 0.9 * of_acting).all()
    for periods in (-1, 1):
        assert (scores(shifted(runs, periods))[:, 3:] > 1.25 * measured[:, 3:]).all()
        assert (scores(shifted(runs, periods))[:, 4] > 1.7 * measured[:, 4]).all()


def test_another_latency_is_another_law(policy, folder):
    with pytest.raises(ValueError, match="another law has driven") as refused:
        recorded_runs(str(folder), policy)
    assert "\n" not in str(refused.value)


def test_readings_of_several_ages_and_parts_of_a_period_become_rows_of_one_time():
    """Every entry is its time, so that what is of one time is equal."""
    latency = sfkd_jax.Latency((0.15, 0.15, 0.15, 0.1), (0.1, 0.2))
    plant = SimpleNamespace(states=(0,) * 4, controls=(0,) * 2, dt=0.1)
    timing = Timing.of(latency, SimpleNamespace(vehicle=plant))
    calls = np.arange(12.0)
    oldest = calls - 1.5
    recorded = np.stack([*[oldest] * 3, calls - 1.0, oldest, oldest], axis=1)
    recorded[0, -2:] = np.nan  # a reading is held back, and the first one is missing
    steps = timing.steps(len(calls))
    assert steps == 12 - 4 - 3 - 1
    xi = timing.rows(timing.path_states(recorded[None]), steps + 1, timing.delay.first)
    first_calls = 4.0 + np.arange(steps + 1)
    np.testing.assert_allclose(xi[0], (first_calls + 1.0)[:, None] * np.ones(3))


def test_the_first_readings_may_be_unknown_where_some_are_held_back():
    columns = run_columns(sfkd_jax.load("kinematic_path"))
    states = np.ones((9, 6))
    states[0, 4:] = np.nan
    log = Log(
        source="1.csv",
        rows=np.arange(9),
        row_name="line",
        time=0.1 * np.arange(9),
        states=states,
        controls=np.ones((9, 2)),
        envs=np.ones((9, 6)),
        stretch=np.zeros(9, int),
    )
    delay = CommandDelay((1.0, 1.0))
    check_rows(log, columns, 0.1, Timing(delay, (0.5, 0.5, 0.5, 0.0)))
    with pytest.raises(ValueError, match="line 0: e_y is nan"):
        check_rows(log, columns, 0.1, Timing(delay, (0.0,) * 4))
    with pytest.raises(ValueError, match="a run needs 10 rows"):
        check_rows(log, columns, 0.1, Timing(CommandDelay((4.0, 4.0)), (0.5,) * 4))


def test_collect_calibrates_a_corridor_with_a_latency(policy, folder, tmp_path):
    trained = tmp_path / "car" / "sfkd_path" / "seed=0"
    shutil.copytree(PRETRAINED / "kinematic_path", trained)
    certificate = policy.certificate
    conditions = replace(certificate.corridor.conditions, latency=policy.latency)
    corridor = replace(certificate.corridor, conditions=conditions)
    write(trained / "certificate.json", replace(certificate, corridor=corridor))
    words = ("name=car", f"root={tmp_path}", f"collect.path={folder}")
    made = collect.main(run(*words, "certification.level=0.7"))
    assert made["conditions"]["runs"] == RUNS
    again = sfkd_jax.load(trained)
    assert again.latency == policy.latency
    assert again.certificate.corridor.recorded.corridor_m == made["corridor_m"]
