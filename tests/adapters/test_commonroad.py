"""CommonRoad's cars as plants: their own equations, grip, mirrors, frames, the servo,
and a drive on a road.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driver, jit

pytest.importorskip(
    "vehiclemodels",
    reason='CommonRoad\'s cars need the extra: pip install "sfkd-jax[plants]"',
)

from vehiclemodels import (
    init_mb,
    init_std,
    vehicle_dynamics_mb,
    vehicle_dynamics_std,
    vehicle_parameters,
)

from sfkd_jax import adapters, evaluation, scenarios
from sfkd_jax.types import Controller

MODELS = ("std", "mb")
FRICTIONS = (1.0, 0.6, 0.3)
GRAVITY = 9.81
PACKAGE = {
    "std": (vehicle_dynamics_std.vehicle_dynamics_std, init_std.init_std),
    "mb": (vehicle_dynamics_mb.vehicle_dynamics_mb, init_mb.init_mb),
}
BMW = vehicle_parameters.setup_vehicle_parameters(2)
STEP_STEER = {
    ("std", 1.0): (11.3688, 2.6182, 0.5382, 11.5853, 0.3376, 0.7841, 0.1799),
    ("std", 0.6): (11.6200, 1.9722, 0.3921, 11.6593, 0.0601, 0.5300, 0.1799),
    ("std", 0.3): (11.8588, 1.0839, 0.1974, 11.8193, 0.0517, 0.2338, 0.1799),
    ("mb", 1.0): (11.3341, 2.6939, 0.5557, 11.5659, 0.3826, 0.8134, 0.1799),
    ("mb", 0.6): (11.6292, 1.9522, 0.3867, 11.6696, 0.0611, 0.5120, 0.1799),
    ("mb", 0.3): (11.8816, 0.9757, 0.1767, 11.8430, 0.0532, 0.2064, 0.1799),
}
"""(p_x, p_y [m], yaw [rad], v, v_y [m/s], yaw rate [rad/s], δ [rad]) at the end of a
step steer.
"""


@cache
def plant(model, **changes):
    return adapters.commonroad_vehicle(model=model, **changes)


@cache
def stepper(model):
    return jit(plant(model).step)


@cache
def rates(model):
    return jit(plant(model).derivative)


def moving(model, speed=12.0, **changes):
    """Straight ahead and settled, but for the states named."""
    names = plant(model).state_names
    state = jnp.zeros(len(names)).at[names.index("v")].set(speed)
    for name, value in changes.items():
        state = state.at[names.index(name)].set(value)
    return state


def held(model, control, env, seconds, start=None):
    """x_0 … x_T under a control and an environment that are held."""
    states = [moving(model) if start is None else start]
    for _ in range(round(seconds / plant(model).dt)):
        states.append(
            stepper(model)(
                states[-1],
                jnp.asarray(control, dtype=float),
                jnp.asarray(env, dtype=float),
            )
        )
    return np.asarray(states, dtype=np.float64)


def by_runge_kutta(model, control, friction, seconds, steps):
    """The same on the package's functions alone, fixed steps: (p_x, p_y, yaw, v_x, v_y,
    yaw rate, δ).
    """
    derivative, initial = PACKAGE[model]
    car = vehicle_parameters.setup_vehicle_parameters(2)
    car.tire.p_dx1 *= friction / car.tire.p_dy1
    car.tire.p_dy1 = friction
    x, h = (
        np.asarray(initial([0.0, 0.0, 0.0, 12.0, 0.0, 0.0, 0.0], car), dtype=float),
        seconds / steps,
    )

    def flow(x):
        return np.asarray(
            derivative(x.tolist(), [(control[0] - x[2]) / 0.1, control[1]], car)
        )

    for _ in range(steps):
        k1 = flow(x)
        k2 = flow(x + 0.5 * h * k1)
        k3 = flow(x + 0.5 * h * k2)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + flow(x + h * k3))
    speed, side = (
        (x[3] * np.cos(x[6]), x[3] * np.sin(x[6])) if model == "std" else (x[3], x[10])
    )
    return np.asarray([x[0], x[1], x[4], speed, side, x[5], x[2]])


@pytest.mark.parametrize("friction", FRICTIONS)
@pytest.mark.parametrize("model", MODELS)
def test_a_step_steer_is_what_it_was_and_what_the_packages_own_equations_give(
    model, friction
):
    """0.18 rad at 12 m/s for 1 s, BMW 320i, commonroad-vehicle-models 3.0.2; recorded from `by_runge_kutta` with
    5000 steps and rounded. The package's own stored reference of this model does not hold for its own version.
    """
    result = held(model, (0.18, 0.0), (friction, 0.0), 1.0)[-1, :7]
    np.testing.assert_allclose(result, STEP_STEER[model, friction], atol=2e-4)
    np.testing.assert_allclose(
        result, by_runge_kutta(model, (0.18, 0.0), friction, 1.0, 500), atol=1e-4
    )


@pytest.mark.parametrize("model", MODELS)
def test_a_settled_start_rolls_straight_on(model):
    """But for 0.2 m/s² of the drift car at once: its tyre's force is not quite 0 at no
    slip (p_hx1).
    """
    rate = np.asarray(
        rates(model)(moving(model), jnp.zeros(2), jnp.asarray([0.9, 0.0]))
    )
    assert rate[0] == pytest.approx(12.0, rel=1e-6)
    np.testing.assert_allclose(rate[[1, 2, 4, 5, 6]], np.zeros(5), atol=1e-3)
    assert abs(rate[3]) < 0.25
    assert np.abs(held(model, (0.0, 0.0), (0.9, 0.0), 1.0)[-1, 1]) < 1e-3


@pytest.mark.parametrize("model", MODELS)
def test_grip_is_at_most_friction_times_gravity_and_half_the_friction_is_less_grip(
    model,
):
    """Centripetal acceleration v ω over the last second of a turn too tight for the
    tyres, at nearly steady speed.
    """
    grips = []
    for friction in (0.8, 0.4):
        states = held(model, (0.25, 1.0), (friction, 0.0), 3.0)[-10:]
        grips.append(np.mean(states[:, 3] * states[:, 5]) / GRAVITY)
        assert grips[-1] <= 1.05 * friction
        assert grips[-1] >= 0.7 * friction
    assert grips[1] < 0.6 * grips[0]


def test_the_servo_follows_the_command_and_keeps_its_rate():
    states = held("std", (0.3, 0.0), (0.9, 0.0), 1.5)
    moved = np.diff(states[:, 6]) / plant("std").dt
    assert moved[:6] == pytest.approx(0.4, rel=1e-4)
    assert moved.max() <= 0.4 * (1 + 1e-4)
    assert states[-1, 6] == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("model", MODELS)
def test_wind_pushes_sideways_ahead_of_the_centre_of_mass(model):
    mass = BMW.m if model == "std" else BMW.m_s
    calm, windy = (
        rates(model)(moving(model), jnp.zeros(2), jnp.asarray([0.9, wind]))
        for wind in (0.0, -4.0)
    )
    change = np.asarray(windy - calm)
    assert change[4] == pytest.approx(-160.0 / mass, abs=1e-3)
    assert change[5] == pytest.approx(-160.0 * 0.4 / BMW.I_z, abs=1e-3)
    np.testing.assert_allclose(change[[0, 1, 2, 3, 6]], np.zeros(5), atol=1e-3)


@pytest.mark.parametrize("model", MODELS)
def test_a_car_that_stops_has_left_what_its_equations_describe(model):
    states = held(model, (0.0, -6.0), (0.9, 0.0), 1.0, start=moving(model, speed=3.0))
    ended = np.isnan(states).all(axis=1)
    assert not ended[:4].any()
    assert ended[-2:].all()
    assert np.isfinite(states[~ended]).all()


@pytest.mark.parametrize("model", MODELS)
def test_a_wheel_that_locks_under_the_brakes_turns_again_without_them(model):
    wheels = slice(7, 9) if model == "std" else slice(-6, -2)
    braked = held(model, (0.0, -6.0), (0.3, 0.0), 0.5)[-1]
    radius, speed = BMW.R_w, braked[3]
    np.testing.assert_allclose(speed / radius + braked[wheels], 0.0, atol=1e-3)
    released = held(
        model, (0.0, 0.0), (0.3, 0.0), 0.5, start=jnp.asarray(braked, dtype=jnp.float32)
    )[-1]
    assert (
        released[3] > speed - 0.8
    )  # a car that slides on loses 0.3 g for 0.5 s, 1.5 m/s
    assert np.abs(released[wheels]).max() < 0.05 * speed / radius


def test_a_spin_that_turns_a_wheel_backwards_ends_the_multi_body_car():
    spinning = moving("mb", speed=2.0, yaw_rate=3.5)
    assert np.isnan(held("mb", (0.3, 0.0), (0.3, 0.0), 0.2, start=spinning)[-1]).all()


def test_an_observation_is_that_of_the_plants_of_this_project():
    state = moving("mb", speed=4.0, v_y=3.0, yaw=0.2)
    np.testing.assert_allclose(
        adapters.commonroad_observation(state), [0, 0, 0.2, 4, 3, 0, 0], atol=1e-6
    )
    np.testing.assert_allclose(
        adapters.commonroad_observation(state, states=4), [0, 0, 0.2, 5], atol=1e-6
    )


@pytest.mark.parametrize("model", MODELS)
def test_a_controller_for_our_plant_keeps_such_a_car_in_its_lane(model):
    """The law that plans are sampled around, over 5 s of a path of the benchmark, on a
    wet road.
    """
    follow, car = driver(plant(model)), plant(model)

    def act(params, memory, observation, env, reference):
        info = {
            "predicted_states": observation[None],
            "effective_samples": jnp.ones(()),
            "healthy": jnp.asarray(True),
        }
        return follow(observation, reference), memory, info

    controller = adapters.commonroad_controller(Controller(lambda key: (), act))
    family = scenarios.scenario(
        name="s1", duration=5.0, state_size=len(car.state_names), dt=car.dt
    )
    road = jit(family)(jax.random.key(3))
    envs = road.envs.at[:, 0].set(0.6)
    road = road._replace(envs=envs, observed_envs=envs)
    drive = jit(
        lambda key: evaluation.simulate(
            car.step, controller, {}, road, key, dt=car.dt, horizon=2
        )
    )
    episode = drive(jax.random.key(0))
    batch = jax.tree.map(lambda leaf: leaf[None], episode)
    scores = evaluation.score(batch, np.asarray(road.envs)[None], dt=car.dt)
    assert not scores["departures"].any()
    assert float(episode.progress[-1]) > 45.0
    assert np.abs(episode.states[:, 2]).max() > 0.05


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "st"}, "unknown model 'st'; choose one of std, mb"),
        ({"car": 4}, "car must be one of 1, 2, 3, got 4"),
        ({"dt": 0.0}, "dt and steering_lag must be positive, got 0.0 and 0.1"),
    ],
)
def test_an_unknown_car_is_refused_in_one_line(settings, message):
    with pytest.raises(ValueError, match=message) as refusal:
        adapters.commonroad_vehicle(**settings)
    assert "\n" not in str(refusal.value)


def test_an_observation_of_another_size_is_refused():
    with pytest.raises(
        ValueError, match="states must be 7, as of the dynamic vehicle, or 4"
    ):
        adapters.commonroad_observation(jnp.zeros(9), states=5)
