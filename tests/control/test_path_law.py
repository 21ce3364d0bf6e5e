"""A law derived from a plant's step: it stabilises the car and can be stored."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

import sfkd_jax
from sfkd_jax import plants, policy
from sfkd_jax.control import derive_path_law, law_from_arrays
from sfkd_jax.geometry import path_state, path_step
from sfkd_jax.types import BODY

BOX = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
SHIPPED = Path(sfkd_jax.__file__).parent / "pretrained"
PLANTS = {"kinematic": plants.kinematic(), "dynamic": plants.dynamic()}


@pytest.fixture(scope="module", params=PLANTS)
def derived(request):
    plant = PLANTS[request.param]
    derive = partial(
        derive_path_law, plant.step, coordinates=len(plant.state_names) - 1, **BOX
    )
    return plant, jit(partial(derive, points=(7, 2, 4)))()


def test_a_turn_at_a_point_of_the_tables_is_steady(derived):
    plant, law = derived
    along = jit(path_step(plant.step))
    env = jnp.asarray([0.5, 8.0])
    curvature = jnp.asarray(2.2 * 2 / 3 / 8.0**2)
    turn = law.turn(curvature, jnp.asarray(8.0), env)
    after = along(turn.state, turn.control, curvature, env)
    np.testing.assert_allclose(after, turn.state, atol=1e-4)
    assert float(turn.state[0]) == 0.0
    np.testing.assert_allclose(turn.state[2], 8.0)


@pytest.mark.parametrize("env", [(0.3, 8.0), (0.3, -8.0), (0.9, 0.0), (0.55, 5.0)])
def test_the_law_alone_keeps_the_car_on_its_path(derived, env):
    """10 m/s, lateral acceleration 1.6 m/s², from 0.4 m beside the path: then within 7
    cm.
    """
    plant, law = derived
    loop = plants.along_path(plant, law)
    inputs = jnp.asarray([0.0, 0.0, 0.016, 10.0])
    start = path_state(
        jnp.zeros(len(plant.state_names) - 1).at[0].set(0.4).at[2].set(9.0)
    )
    drive = jit(
        lambda x: jax.lax.scan(
            lambda x, _: (loop.step(x, inputs, jnp.asarray(env)), x), x, length=80
        )
    )
    last, _ = drive(start)
    assert abs(float(last[BODY][0])) < 0.07
    assert abs(float(last[BODY][2]) - 10.0) < 0.1


def test_the_loop_contracts_alike_where_tyres_give_little(derived):
    """Steering is weighted by the curvature it makes: the slowest mode on ice with wind
    is below 0.92.
    """
    plant, law = derived
    loop = plants.along_path(plant, law)
    inputs = jnp.asarray([0.0, 0.0, 0.02, 10.0])
    step = lambda xi, e: loop.step(path_state(xi), inputs, e)[BODY]
    slopes = jit(lambda e: jax.jacfwd(step)(law.turn(*inputs[2:], e).state, e))
    for env in ((0.3, 8.0), (0.9, 0.0)):
        slope = slopes(jnp.asarray(env))
        assert np.max(np.abs(np.linalg.eigvals(np.asarray(slope, np.float64)))) < 0.92


def test_a_law_survives_being_stored(derived):
    law = derived[1]
    flat = {name: np.asarray(leaf) for name, leaf in law._asdict().items()}
    again = law_from_arrays(flat)
    given = (
        jnp.full(law.state.shape[-1], 0.1),
        jnp.asarray(0.01),
        jnp.asarray(9.0),
        jnp.asarray([0.42, -3.0]),
    )
    np.testing.assert_array_equal(again(*given), law(*given))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", PLANTS)
def test_a_law_derived_again_is_that_of_the_shipped_policy(name):
    """Friction and wind at their ends and centres; the stored tables are finer."""
    stored = policy.restore(SHIPPED / f"{name}_path")
    settings = stored.settings["dataset"]
    options = {key: tuple(value) for key, value in BOX.items()}
    options |= {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in settings["law"].items()
    }
    options["points"] = (*options["points"][:2], 3)
    size = stored.law.state.shape[-1]
    derive = partial(derive_path_law, stored.vehicle.step, coordinates=size, **options)
    law = jax.jit(derive)()
    for entry in ("state", "control"):
        table = getattr(stored.law, entry)[:, :, ::3, ::3]
        np.testing.assert_allclose(getattr(law, entry), table, atol=1e-4)
    # Differences in float32 round: hardly for the steering, by 0.01 for the speed.
    for row, tolerance in ((0, 3e-4), (1, 1e-2)):
        table = stored.law.gain[:, :, ::3, ::3, row]
        np.testing.assert_allclose(law.gain[..., row, :], table, atol=tolerance)
