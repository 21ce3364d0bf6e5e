"""Simulators that are not written in JAX: what they step is what they are asked for,
and what they do wrong ends one run alone.
"""

import warnings
from pathlib import Path

import composing
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving import plants
from sfkd_jax.experiment import evaluating
from tests.driving.plants import simulators

HERE = "tests.driving.plants.simulators"
EXAMPLES = str(Path(__file__).parents[3] / "examples")


@pytest.fixture(scope="module")
def car():
    return plants.simulator(f"{HERE}:Faulty")


def rows(faults):
    """One vehicle for each entry, with the fault that it asks for."""
    count = len(faults)
    states = np.random.default_rng(0).normal(size=(count, 5)).astype(np.float32)
    env = jnp.stack([jnp.asarray(faults, jnp.float32), jnp.zeros(count)], axis=1)
    return jnp.asarray(states), jnp.full((count, 2), 0.25), env


def own_step(state, control, env):
    simulator = simulators.Faulty()
    simulator.reset(np.asarray(state, float))
    return simulator.step(np.asarray(control, float), env).astype(np.float32)


def test_a_simulator_is_a_plant_under_jit_vmap_and_scan(car):
    assert (car.dt, car.control_low, car.control_high) == (0.5, (-1, -2), (1, 2))
    assert car.state_names == simulators.Faulty.state_names
    given = rows([0] * 7)
    expected = np.stack([own_step(*one) for one in zip(*given, strict=True)])
    np.testing.assert_array_equal(jit(jax.vmap(car.step))(*given), expected)
    pairs = jax.tree.map(lambda leaf: leaf[:6].reshape(2, 3, -1), given)
    nested = jit(jax.vmap(jax.vmap(car.step)))(*pairs)
    np.testing.assert_array_equal(nested.reshape(6, -1), expected[:6])
    one = [leaf[0] for leaf in given]
    along = jax.lax.scan(lambda x, _: (car.step(x, *one[1:]),) * 2, one[0], length=3)
    assert along[1][:, 4].tolist() == (one[0][4] + np.arange(1, 4)).tolist()


def test_what_a_simulator_does_wrong_ends_that_run_alone_and_is_said_once(car):
    given = rows([0, *simulators.FAULTS, 0, 1, 0])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        after = np.asarray(jit(jax.vmap(car.step))(*given))
    failed = np.asarray(given[2][:, 0]) > 0
    assert np.isnan(after[failed]).all()
    expected = [own_step(*one) for one in zip(*given, strict=True) if one[2][0] == 0]
    np.testing.assert_array_equal(after[~failed], np.stack(expected))
    said = [str(one.message) for one in said if "simulator" in str(one.message)]
    assert len(said) == len({*simulators.FAULTS.values()})
    for reason in simulators.FAULTS.values():
        assert any(reason in line for line in said), reason
    assert all(line.startswith(f"simulator {HERE}:Faulty: ") for line in said)
    # A run that has ended is not stepped any more: no fault, and no time.
    ended = jnp.where(jnp.asarray(failed)[:, None], jnp.nan, given[0])
    assert np.isnan(
        np.asarray(jit(jax.vmap(car.step))(ended, *given[1:]))[failed]
    ).all()


def test_states_that_a_simulator_does_not_name_are_noticed():
    """Two steps from one reset against two resets."""
    box = {"speed": (0.5, 3.0), "env_low": (0.0,), "env_high": (1.0,)}
    for name in ("Small", "Faulty"):
        make = f"{HERE}:{name}"
        vehicle = plants.simulator(make)
        assert plants.hidden_change(make, vehicle, **box | {"env_high": (0.0,)}) == {}
    make = f"{HERE}:Forgetful"
    found = plants.hidden_change(make, plants.simulator(make), **box)
    # The servo lags by half; x and v do not depend on it.
    assert set(found) == {"p_y", "yaw"}
    assert found["yaw"] > 0.01
    failing = {**box, "env_low": (2.0,), "env_high": (2.0,)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert plants.hidden_change(f"{HERE}:Faulty", vehicle, **failing) == {}


def test_a_range_of_speeds_that_is_none_is_refused():
    with pytest.raises(ValueError, match="its speed must be two rising numbers"):
        plants.simulator(f"{HERE}:Backwards")


def test_an_environment_of_gymnasium_starts_at_every_state():
    plant = plants.simulator(f"{HERE}:wrapped")
    state, control, env = (leaf[0] for leaf in rows([0]))
    state = state.at[3].set(5.0)
    for _ in range(2):  # more steps than an episode of the environment has
        expected = own_step(state, control, env)
        state = plant.step(state, control, env)
        np.testing.assert_array_equal(state, expected)
    with pytest.warns(UserWarning, match="the episode was terminated"):
        assert np.isnan(plant.step(state.at[3].set(-1.0), control, env)).all()


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        ("nowhere.at_all:make", "ModuleNotFoundError: No module named 'nowhere'"),
        (f"{HERE}:missing", "AttributeError: module .* has no attribute 'missing'"),
        ("builtins:dict", "AttributeError: 'dict' object has no attribute"),
        ("os:abort", "its process ended"),
    ],
)
def test_a_simulator_that_cannot_be_made_is_refused_in_one_line(make, reason):
    with pytest.raises(ValueError, match=f"vehicle.env={make}: {reason}") as refusal:
        plants.simulator(make)
    assert "\n" not in str(refusal.value)


def test_the_bicycle_of_highway_env_is_driven_as_any_plant(tmp_path, monkeypatch):
    """Recorded, and evaluated in S3 at the levels of its own box of e."""
    monkeypatch.syspath_prepend(EXAMPLES)
    highway = pytest.importorskip("highway")
    words = f"""+experiment=s3_body vehicle=simulator vehicle.env=highway:make
        environment.low=[0.35,-3] environment.high=[1,3] dataset.segments=20
        dataset.steps=10 dataset.shares=[0.25,0.25,0.25,0.25] root={tmp_path}
        evaluation.systems=[nominal] evaluation.episodes=2 evaluation.episode_s=3
        controller.mppi.num_samples=16"""
    run = composing.run(*words.split())
    chosen = run.settings
    assert (chosen.vehicle.dt, chosen.vehicle.wheelbase) == (0.1, 5.0)
    assert chosen.environment.names == ("grip [-]", "side force [kN]")
    assert chosen.environment.roles == ("friction", "side_force")
    noise = chosen.evaluation.sensors(
        plants.own(state_names=("yaw_rate", "p_x", "load", "v"))
    )
    assert noise == (0.002, 0.015, 0.0, 0.03)  # by name, in any order
    runs = run.source.dataset.train
    car = highway.make()
    for state, control, env, after in zip(
        runs.states[0], runs.controls[0], runs.envs[0], runs.states[0, 1:], strict=False
    ):
        car.reset(np.asarray(state, float))
        expected = car.step(np.asarray(control, float), np.asarray(env, float))
        np.testing.assert_allclose(after, expected, rtol=2e-6, atol=2e-6)
    episodes = evaluating.make_episodes(run)
    envs = np.asarray(episodes.scenarios.envs)
    levels = np.unique(np.abs(envs).reshape(-1, 2), axis=0)
    np.testing.assert_allclose(levels, [[1.0, 0.0]], atol=1e-6)
    (result,) = evaluating.drive(run, evaluating.load_systems(run), episodes)
    assert result.row["departures"] == 0
    assert result.row["rmse_m"]["mean"] < 0.5
