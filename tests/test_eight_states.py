"""A car with an eighth state: one function, and nothing else knows how many there are."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composing import settings
from helpers import ENV_HIGH, ENV_LOW, any_law, driver, jit

from sfkd_jax import assembly, models, policy
from sfkd_jax.driving import drives, plants, simulation
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.info import ControllerInfo
from sfkd_jax.latency import Latency
from sfkd_jax.report.run import write_report
from sfkd_jax.settings import schema
from sfkd_jax.types import Controller
from sfkd_jax.variables import StateVariable
from tests.report import pages_of_runs as made

LAW = any_law(7)
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
ERRORS = (1e-3, 3e-4, 3e-3, 3e-3, 1.5e-3, 5e-4, 2e-3)


def electric(*, dt: float = 0.1) -> plants.Vehicle:
    """Return `dynamic` with the charge of its battery, which driving uses up."""
    car = plants.dynamic(dt=dt)

    def drained(step):
        def both(state, command, env):
            used = 1e-3 * dt * jnp.maximum(command[1] * state[3], 0.0)
            return jnp.append(step(state[:7], command, env), state[7] - used)

        return both

    return car._replace(
        name="electric",
        states=(*car.states, StateVariable("charge", "kWh", 0.01)),
        step=drained(car.step),
        nominal=drained(car.nominal),
        nominal_derivative=lambda x, u, e: jnp.append(
            car.nominal_derivative(x[:7], u, e), 0.0
        ),
        derivative=None,
    )


@pytest.fixture
def registered(monkeypatch):
    """The entry of `plants.FACTORIES`, and what is made of it on import."""
    monkeypatch.setitem(assembly.PLANTS, "electric", electric)
    own = schema("Vehicle", assembly.VehicleSettings, electric)
    monkeypatch.setitem(assembly.VEHICLES, "electric", own)
    return {"name": "electric"}


def test_it_is_simulated_through_the_sensor_that_it_states(registered):
    plant = assembly.build_vehicle(registered)
    follow = driver(plant)
    seen = {"charge": lambda info: info.planner}

    def act(params, memory, observation, env, reference):
        info = ControllerInfo(planner=observation[7])
        return follow(observation, reference), memory, info

    scenario = assembly.build_scenario({"name": "s1"}, plant, duration=3.0)
    episode = simulation.simulate(
        plant.step,
        Controller(lambda key: (), act),
        {},
        jit(scenario)(jax.random.key(0)),
        jax.random.key(1),
        dt=plant.dt,
        horizon=4,
        observation_noise=plant.sensor_noise,
        record=seen,
    )
    assert episode.states.shape == (31, 8)
    assert np.all(np.isfinite(episode.states))
    error = np.asarray(episode.signals["charge"] - episode.states[:-1, 7])
    assert 0.005 < error.std() < 0.02


def test_its_data_have_eight_states_and_its_loop_seven_coordinates():
    plant = electric()
    few = {"segments": 8, "steps": 5}
    in_world = jax.eval_shape(
        partial(drives.generate, plant, driver(plant), **few), jax.random.key(0)
    )
    assert in_world.states.shape == (8, 6, 8)
    loop = assembly.build_loop(plant, LAW)
    assert loop.state_names[3:] == (
        "e_y", "e_psi", "v", "v_y", "yaw_rate", "steering", "charge",
    )  # fmt: skip
    along = jax.eval_shape(
        partial(drives.generate_along_path, loop, **few, **BOX), jax.random.key(0)
    )
    assert along.states.shape == (8, 6, 10)
    assert along.controls.shape == (8, 5, 4)


def test_a_policy_of_it_says_its_names_and_units():
    shipped = policy.restore(policy.SHIPPED / "dynamic_path")
    trained = replace(shipped, vehicle=electric())
    latency = Latency().sized(len(trained.vehicle.states), 2)
    text = policy.describe(trained, None, "unsigned", latency)
    assert "steering [rad], charge [kWh]" in text
    assert policy.interface_of(trained, None, latency)["observation"][-1] == "charge"


def test_the_page_of_a_run_names_its_axes(registered, tmp_path):
    box = [[-1.0] * 7, [1.0] * 7]
    document = made.certificate(boxes={"state": box, "env": [[0.3, -8.0], [0.9, 8.0]]})
    config = {"model": {"system": "sfkd_path"}, "vehicle": registered}
    run = made.write_run(
        tmp_path,
        episodes=False,
        certificate=document,
        policy={"config": config},
        results=None,
        open_loop=None,
    )
    write_report(run)
    page = (run / "report/index.html").read_text()
    for axis in ("e_psi [rad]", "charge [kWh]"):
        assert f"state: {axis}" in page


def built(plant, **adaptation):
    """A controller along a path with adaptation, of a model that knows the car."""
    model = models.physics(assembly.build_loop(plant, LAW).step, frame=PATH_FRAME)
    options = {
        "name": "mppi",
        "planner": "mppi",
        "sampling": "law",
        "mppi": {"num_samples": 4, "horizon": 3, "noise_std": [0.01, 0.3]},
        "adaptation": adaptation,
    }
    return assembly.build_controller(
        options, model, plant, law=LAW, adaptive=True, **BOX
    )


def test_adaptation_refuses_what_nobody_knows_of_it_and_works_when_told():
    plant = electric()
    with pytest.raises(ValueError, match="error of the model in charge: pass") as line:
        built(plant)
    assert "\n" not in str(line.value)
    controller = built(plant, model_error=ERRORS)
    state = jax.eval_shape(controller.init, jax.random.key(0))
    inputs = jnp.zeros(8), jnp.asarray([0.7, 0.0]), jnp.zeros((3, 4))
    action, _, info = jax.eval_shape(controller.act, {}, state, *inputs)
    assert action.shape == (2,)
    assert info.plan.states.shape[-1] == 8


def test_adaptation_refuses_an_exact_sensor():
    plant = electric()
    exact = plant.states[7]._replace(deviation=0.0)
    plant = plant._replace(states=(*plant.states[:7], exact))
    with pytest.raises(ValueError, match="deviation of the sensor of charge: state it"):
        built(plant, model_error=ERRORS)
    told = (*plants.dynamic().sensor_noise, 0.01)
    assert built(plant, model_error=ERRORS, sensor_noise=told)


def test_sensors_are_those_of_the_vehicle_unless_the_settings_say_otherwise():
    plant = electric()
    assert settings().evaluation.sensors(plant) == plant.sensor_noise
    coarse = settings("+evaluation.observation_noise.charge=0.5")
    assert coarse.evaluation.sensors(plant)[-2:] == (0.001, 0.5)
    assert plant.sensor_noise == (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001, 0.01)
    assert [one.name for one in plant.states if one.is_angle] == ["yaw", "steering"]
