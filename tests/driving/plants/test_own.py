"""A user's own vehicle: given by a named function, or by logs alone."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import assembly
from sfkd_jax.driving import plants, simulation

NAMES = ("p_x", "p_y", "yaw", "v", "yaw_rate")
LIMITS = {"control_low": (-1.0, -2.0), "control_high": (1.0, 2.0)}
SETTINGS = {
    "name": "own",
    "inner_loop": "none",
    "speed_gain": 1.0,
    "state_names": list(NAMES),
}
SETTINGS |= {name: list(values) for name, values in LIMITS.items()}
EXAMPLES = Path(__file__).parents[3] / "examples"


def test_a_step_is_named_in_the_settings_and_is_the_function_itself(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    plant = assembly.build_vehicle(SETTINGS | {"step": "own_vehicle:step"})
    plants.check_step(plant)
    from own_vehicle import step

    state = jnp.asarray([1.0, 2.0, 0.3, 4.0, 0.1])
    control, env = jnp.asarray([0.2, 0.5]), jnp.asarray([0.7, 3.0])
    np.testing.assert_array_equal(
        plant.step(state, control, env), step(state, control, env)
    )
    assert plant.simulated
    assert (plant.control_low, plant.control_high) == ((-1.0, -2.0), (1.0, 2.0))


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (
            "nowhere.at_all:step",
            "vehicle.step=nowhere.at_all:step: No module named 'nowhere'; name it as",
        ),
        ("own_vehicle", "name it as package.module:function"),
    ],
)
def test_a_missing_step_is_reported_when_it_is_needed_and_not_before(
    monkeypatch, step, message
):
    monkeypatch.syspath_prepend(EXAMPLES)
    plant = assembly.build_vehicle(SETTINGS | {"step": step})
    with pytest.raises(ValueError, match=r"vehicle\.step") as caught:
        plants.check_step(plant)
    assert message in str(caught.value)


def test_its_nominal_model_is_the_bicycle_and_leaves_further_states_alone():
    plant = plants.own(dt=0.01, wheelbase=1.0, state_names=NAMES)
    state, control = jnp.asarray([0.0, 0.0, 0.0, 2.0, 0.7]), jnp.asarray([0.1, 0.0])
    rate = plant.nominal_derivative(state, control, jnp.zeros(2))
    np.testing.assert_allclose(rate[2], 2.0 * np.tan(0.1) / 1.0, rtol=1e-6)
    after = plant.nominal(state, control, jnp.zeros(2))
    np.testing.assert_allclose(after[2], 0.01 * rate[2], rtol=1e-5)
    assert after[4] == state[4]


def test_side_forces_need_a_plant_that_wind_acts_on(key):
    with pytest.raises(
        ValueError,
        match=r"side_forces act through the wind, but vehicle\.wind_force is 0",
    ):
        simulation.disturbed_environment(
            plants.own(), jnp.zeros((3, 2)), key, largest=10.0
        )
