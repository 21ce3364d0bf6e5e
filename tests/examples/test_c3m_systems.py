"""The systems of C3M among the examples move as its code says.

The equations are written here as there: one row a state, in the order of its states,
with e as it is there.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric, CoRL
2020, and its code, github.com/sundw2014/C3M.
"""

import runpy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy import cos, sin, tan

from sfkd_jax.systems import Tracked

FOLDER = Path(__file__).parents[2] / "examples" / "systems" / "c3m"
FINE = 30
"""Integration steps of a sampling period."""
POINTS = 5


def car(x, u):
    _, _, theta, v = x
    return [v * cos(theta), v * sin(theta), u[0], u[1]]


def pvtol(x, u):
    """With velocities along the axes of the body."""
    _, _, phi, vx, vz, turn = x
    m = 0.486
    return [
        vx * cos(phi) - vz * sin(phi),
        vx * sin(phi) + vz * cos(phi),
        turn,
        vz * turn - 9.81 * sin(phi),
        -vx * turn - 9.81 * cos(phi) + (u[0] + u[1]) / m,
        0.25 / 0.00383 * (u[0] - u[1]),
    ]


def segway(x, u):
    _, theta, v, omega = x
    c = cos(theta)
    s = sin(theta)
    pushed = c * (9.8 * s + 11.5 * v) + 68.4 * v - 1.2 * omega**2 * s
    turned = -58.8 * v * c - 243.5 * v - s * (208.3 + omega**2 * c)
    return [
        v,
        omega,
        (pushed + (-1.8 * c - 10.9) * u[0]) / (c - 24.7),
        (turned + (9.3 * c + 38.6) * u[0]) / (c**2 - 24.7),
    ]


def tlpra(x, u):
    q1, q2, v1, v2 = x
    alpha = 3.1
    beta = 2.3
    eta = 2.3
    inertia = [
        [alpha + beta + 2 * eta * cos(q2), beta + eta * cos(q2)],
        [beta + eta * cos(q2), beta],
    ]
    bias = [
        -eta * (2 * v1 * v2 + v2**2) * sin(q2)
        + alpha * 9.8 * cos(q1)
        + eta * 9.8 * cos(q1 + q2),
        eta * v1**2 * sin(q2) + eta * 9.8 * cos(q1 + q2),
    ]
    return [v1, v2, *np.linalg.solve(inertia, np.subtract(u, bias))]


def cartpole(x, u):
    _, theta, v, omega = x
    c = cos(theta)
    s = sin(theta)
    return [
        v,
        omega,
        (s * (omega**2 - 9.8 * c) + u[0]) / (1 + s**2),
        (omega**2 * c * s - 2 * 9.8 * s + u[0] * c) / (1 + s**2),
    ]


def quadrotor_8d(x, u):
    _, _, _, vx, vy, vz, tx, ty = x
    return [vx, vy, vz, 9.81 * tan(tx), 9.81 * tan(ty), u[0], u[1], u[2]]


def quadrotor_9d(x, u):
    _, _, _, vx, vy, vz, thrust, a, b = x
    pushed = [-thrust * sin(b), thrust * cos(b) * sin(a)]
    return [vx, vy, vz, *pushed, 9.81 - thrust * cos(b) * cos(a), *u]


def same(x):
    return x


def along_world(x):
    """States of the PVTOL with velocities along the axes of the world."""
    px, pz, phi, vx, vz, turn = x
    ahead = vx * cos(phi) - vz * sin(phi)
    up = vx * sin(phi) + vz * cos(phi)
    return np.asarray([px, pz, ahead, up, phi, turn])


def swapped(x):
    """Speed before angle."""
    return np.asarray(x)[[0, 2, 1, 3]]


def above_hover(x):
    return np.asarray(x) - 9.81 * np.eye(9)[6]


# Equations of the source -> the states of the example from those of the source, and e.
CASES = {
    car: (same, 1.0),
    pvtol: (along_world, 0.486),
    segway: (swapped, 1.0),
    tlpra: (same, 0.0),
    cartpole: (swapped, 1.0),
    quadrotor_8d: (same, 1.0),
    quadrotor_9d: (above_hover, 1.0),
}


def made(name):
    """What an example consists of, and its system and frame."""
    example = runpy.run_path(str(FOLDER / f"{name}.py"))
    return example, *example["make"]()


def integrated_finely(rates, x, u, dt):
    """The state a sampling period later, by Runge-Kutta of order 4."""
    h = dt / FINE
    for _ in range(FINE):
        k1 = np.asarray(rates(x, u))
        k2 = np.asarray(rates(x + 0.5 * h * k1, u))
        k3 = np.asarray(rates(x + 0.5 * h * k2, u))
        k4 = np.asarray(rates(x + h * k3, u))
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


def test_the_eight_systems_are_there_and_short():
    files = {file.stem: file for file in FOLDER.glob("*.py")}
    assert set(files) == {case.__name__ for case in CASES} | {"neurallander"}
    for file in files.values():
        assert len(file.read_text("utf-8").splitlines()) <= 60


@pytest.mark.parametrize("rates", CASES, ids=lambda rates: rates.__name__)
def test_a_system_moves_as_the_equations_of_its_source_say(rates):
    _, system, _ = made(rates.__name__)
    states_of, nominal = CASES[rates]
    low, high = system.control_box
    draw = np.random.default_rng(0)
    for _ in range(POINTS):
        x = draw.uniform(-1.0, 1.0, len(system.states))
        u = draw.uniform(low, high)
        state = jnp.asarray(states_of(x))
        after = system.step(state, jnp.asarray(u), jnp.asarray([nominal]))
        expected = states_of(integrated_finely(rates, x, u, system.dt))
        np.testing.assert_allclose(after, expected, rtol=1e-4, atol=1e-4)


# Force of the network of the source [N] at a height [m] and a velocity [m/s].
FORCES = [
    (0.1, (0.0, 0.0), (8.9, 1.6, 15.3)),
    (0.3, (0.0, 0.0), (10.2, 1.5, 6.1)),
    (0.5, (0.0, 0.0), (11.9, 1.8, 2.7)),
    (1.0, (0.0, 0.0), (11.9, 2.0, 2.3)),
    (1.0, (0.5, 0.0), (6.4, 1.1, 2.2)),
    (1.0, (1.0, 0.0), (-1.7, 1.0, 2.2)),
    (1.0, (0.0, 1.0), (14.0, -5.3, 1.5)),
    (1.0, (0.0, -1.0), (13.0, 6.4, 1.3)),
]


def test_the_forces_near_the_ground_are_about_those_of_the_network():
    example, _, _ = made("neurallander")
    for height, (vx, vy), force in FORCES:
        state = jnp.asarray([0.0, 0.0, height, vx, vy, 0.0])
        rates = example["rates"](state, jnp.asarray([0.0, 0.0, 9.81]), jnp.ones(1))
        errors = np.abs(np.asarray(rates[3:]) * 1.47 - force)
        # Of drag and ground effect only: what one speed does to another is left out.
        assert np.all(errors <= [3.3, 1.2, 1.0])


@pytest.mark.parametrize("name", [*(case.__name__ for case in CASES), "neurallander"])
def test_a_system_fits_its_frame_and_its_starts(name, key):
    example, system, frame = made(name)
    tracked = Tracked(system, frame)
    system.check_step(tracked.state(jnp.zeros(len(tracked.names)), tracked.middle))
    tracked.check_invariance(key)
    assert set(example["STARTS"]) <= set(system.state_names)
    assert example["DURATION"] >= 2.0
