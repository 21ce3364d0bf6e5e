"""Systems of the user: their tables are parsed, and what does not fit is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusal_of
from loops import mass, pushed

from sfkd_jax.systems import integrated

NAN = float("nan")


def test_labels_are_names_and_units():
    system = mass(states={"roll [rad]": 0.01, " way  [m]": 0.0, "share": 0.1})
    assert system.state_names == ("roll", "way", "share")
    assert [state.unit for state in system.state_variables] == ["rad", "m", ""]
    angles = [state.is_angle for state in system.state_variables]
    assert angles == [True, False, False]
    assert system.sensor_noise == (0.01, 0.0, 0.1)
    assert system.control_variables[0].label == "force [N]"
    assert system.env_box == ((0.8, -0.5), (1.2, 0.5))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"states": {"x [m]": 0.0, "x [cm]": 0.0}}, "states: x is there twice"),
        ({"states": {}}, "states"),
        ({"states": {"x [m": 0.0}}, "x [m"),
        ({"states": {" [m]": 0.0}}, " [m]"),
        ({"states": {"": 0.0}}, "''"),
        ({"states": {"x": NAN}}, "states: the deviation of x"),
        ({"states": {"x": -0.1}}, "states: the deviation of x"),
        ({"controls": {"u": (1.0, -1.0)}}, "controls: u"),
        ({"controls": {"u": (1.0, 1.0)}}, "controls: u"),
        ({"controls": {"u": (-1.0, np.inf)}}, "controls: u"),
        ({"environment": {"m": (NAN, 1.0)}}, "environment: m"),
        ({"environment": {}}, "environment"),
        ({"dt": 0.0}, "dt"),
        ({"dt": NAN}, "dt"),
    ],
)
def test_bad_tables_are_refused_in_one_line_that_names_the_entry(changed, named):
    line = refusal_of(lambda: mass(**changed))
    assert line is not None
    assert named in line
    assert len(line) < 120


def test_a_step_is_refused_that_does_not_return_a_state():
    still = jnp.zeros(2)
    assert refusal_of(partial(mass().check_step, still)) is None
    for step, named in (
        (lambda x, u, e: x[:1], "shape (2,): x, v; got (1,)"),
        (lambda x, u, e: x[:, None], "got (2, 1)"),
        (lambda x, u, e: pushed(x, u, e) / jnp.abs(x), "not finite"),
    ):
        line = refusal_of(partial(mass(step).check_step, still))
        assert line is not None
        assert named in line


def test_the_integration_is_exact_for_a_constant_acceleration():
    step = integrated(lambda x, u, e: (x[1], (u[0] + e[1]) / e[0]), dt=0.1)
    state, control, env = map(jnp.asarray, ([1.0, -2.0], [3.0], [1.1, 0.2]))
    np.testing.assert_allclose(
        step(state, control, env), pushed(state, control, env), rtol=1e-6
    )


def test_the_error_of_the_integration_falls_with_the_fourth_power_of_the_step():
    def pendulum(x, u, e):
        return [x[1], -x[0] * e[0] + u[0]]

    with jax.enable_x64(True):
        state, control, env = map(jnp.asarray, ([0.3, -1.0], [0.2], [9.0]))
        angle = 3.0 * 0.8
        way = 0.3 - 0.2 / 9.0
        exact = [
            0.2 / 9.0 + way * np.cos(angle) - np.sin(angle) / 3.0,
            -3.0 * way * np.sin(angle) - np.cos(angle),
        ]
        errors = []
        for substeps in (8, 16, 32):
            step = integrated(pendulum, dt=0.8, substeps=substeps)
            errors.append(np.linalg.norm(step(state, control, env) - np.asarray(exact)))
    orders = np.log2(np.asarray(errors[:-1]) / np.asarray(errors[1:]))
    assert np.all((orders > 3.7) & (orders < 4.5)), orders
