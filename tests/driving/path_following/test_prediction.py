"""Prediction to the time at which a command acts: exact with an exact model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law

from sfkd_jax import assembly
from sfkd_jax.driving import plants
from sfkd_jax.driving.corridor import closed_loop
from sfkd_jax.driving.corridor._closed_loop import law_sensors
from sfkd_jax.driving.drives import drive_along_path
from sfkd_jax.driving.path_coordinates import path_coordinates
from sfkd_jax.driving.path_following import (
    Conditions,
    Prediction,
    Predictor,
    along_reference,
)
from sfkd_jax.driving.scenarios import DriveClass
from sfkd_jax.info import ControllerInfo, PlanInfo
from sfkd_jax.latency import CommandDelay, Latency
from sfkd_jax.types import Controller

PLANT = plants.kinematic()
LAW = any_law()
EXACT = assembly.reference_systems(PLANT, LAW)["oracle"].model
ENV = jnp.asarray([0.8, 3.0])
CURVATURE = 0.02
SPEED = 9.0
HORIZON = 6


def circle(first, count):
    """Points of the circle, one a period."""
    turned = CURVATURE * SPEED * PLANT.dt * (first + np.arange(count))
    x = np.sin(turned) / CURVATURE
    y = (1.0 - np.cos(turned)) / CURVATURE
    points = [x, y, turned, np.full(count, SPEED)]
    return jnp.asarray(np.stack(points, axis=1), jnp.float32)


def shown_to(controller, delay, state, sent, reference):
    """What a controller behind projection and predictor is shown."""
    prediction = Prediction(model=EXACT, law=LAW, dt=PLANT.dt, **controller)

    def act(params, memory, xi, env, preview):
        told = {"xi": xi, "observation": preview.observation, "road": preview.road}
        plan = PlanInfo(states=jnp.tile(xi, (HORIZON, 1)))
        return jnp.zeros(2), memory, ControllerInfo(plan=plan, planner=told)

    inner = Controller(lambda key: (), act)
    if delay.first:
        inner = Predictor(inner=inner, prediction=prediction, delay=delay).controller()
    outer = along_reference(inner, coordinates=3, delay=delay)
    memory = outer.init(jax.random.key(0))._replace(sent=sent)
    _, _, info = jax.jit(outer.act)({}, memory, state, ENV, reference)
    return info


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_controller_sees_the_state_at_which_its_command_acts(steps):
    """In ξ and in the world, with the points of its plan beside the road of then."""
    delay = CommandDelay((float(steps), float(steps)))
    start = circle(0, 1)[0] + jnp.asarray([0.02, 0.15, -0.03, 0.4])
    sent = jnp.asarray([[0.03, 0.5], [0.08, -1.0], [-0.02, 0.2]])[:steps]
    after = start
    for command in sent:
        after = PLANT.step(after, command, ENV)
    info = shown_to({}, delay, start, sent, circle(1, HORIZON + steps))
    seen = info.planner
    expected = path_coordinates(after, circle(1 + steps, 1)[0], jnp.asarray(CURVATURE))
    np.testing.assert_allclose(seen["xi"], expected, atol=1e-4)
    # Along the path it is only known to a few millimetres, and nobody steers by it.
    gap = np.asarray(seen["observation"] - after)
    np.testing.assert_allclose(gap[:2], 0.0, atol=1e-2)
    np.testing.assert_allclose(gap[2], 0.0, atol=1e-3)
    assert seen["road"].shape == (HORIZON, 2)
    # The plan is ξ at every step: beside the points that come after the command.
    beside = info.plan.states[:, :2] - circle(1 + steps, HORIZON)[:, :2]
    lateral = np.hypot(*np.asarray(beside).T)
    np.testing.assert_allclose(lateral, abs(float(expected[0])), atol=1e-4)


def test_younger_entries_wait_until_the_oldest_arrive():
    """A speed that comes a period earlier is that of the observation one call later."""

    def act(params, memory, xi, env, preview):
        plan = PlanInfo(states=jnp.tile(xi, (HORIZON, 1)))
        return jnp.zeros(2), memory, ControllerInfo(plan=plan)

    outer = along_reference(
        Controller(lambda key: (), act), coordinates=3, hold_back=(0.0, 0.0, 0.0, 1.0)
    )
    memory = outer.init(jax.random.key(0))
    seen = []
    for speed in (5.0, 6.0, 7.0):
        state = jnp.asarray([0.0, 0.1 * speed, 0.01, speed])
        _, memory, info = outer.act({}, memory, state, ENV, circle(1, HORIZON))
        seen.append(np.asarray(info.path.xi))
    assert np.isnan(seen[0]).all(), "the first speed belongs to no observation yet"
    np.testing.assert_allclose([xi[2] for xi in seen[1:]], [5.0, 6.0])
    np.testing.assert_allclose(seen[2][0], 0.7, atol=0.05)


def test_part_of_a_period_is_part_of_a_step():
    """Between the predictions of the whole steps before and after."""
    start = circle(0, 1)[0] + jnp.asarray([0.0, 0.1, 0.02, 0.0])
    sent = jnp.asarray([[0.05, 0.5], [0.05, 0.5]])

    def xi(periods):
        delay = CommandDelay((periods, periods))
        held = sent[: delay.steps]
        reference = circle(1, HORIZON + delay.steps)
        info = shown_to({}, delay, start, held, reference)
        return np.asarray(info.planner["xi"])

    middle = 0.75 * xi(1.0) + 0.25 * xi(2.0)
    np.testing.assert_allclose(xi(1.25), middle, atol=1e-4)


def test_outside_its_box_a_car_turns_by_its_steering():
    """Where no model was learned the vehicle's own steering is still taken along."""
    box = ((-0.1, -0.1, 8.0), (0.1, 0.1, 10.0))
    conditions = {"conditions": Conditions(state=box)}
    delay = CommandDelay((2.0, 2.0))
    start = circle(0, 1)[0] + jnp.asarray([0.0, 2.0, 0.2, -3.0])
    sent = jnp.asarray([[-0.1, 0.0], [-0.1, 0.0]])
    info = shown_to(conditions, delay, start, sent, circle(1, HORIZON + 2))
    after = PLANT.step(PLANT.step(start, sent[0], ENV), sent[1], ENV)
    expected = path_coordinates(after, circle(3, 1)[0], jnp.asarray(CURVATURE))
    np.testing.assert_allclose(info.planner["xi"], expected, atol=0.08)


@pytest.mark.parametrize(
    ("sensors", "controls", "tolerance"),
    [(0.1, 0.0, 1e-4), (0.1, 0.2, 1e-4), (0.0, 0.3, 1e-4), (0.05, 0.1, 5e-3)],
)
def test_with_an_exact_model_a_late_loop_drives_as_one_on_time(
    sensors, controls, tolerance
):
    """Smith's predictor: the runs of a corridor with latency, and those without."""
    envs = jnp.tile(ENV, (4, 140, 1))

    def runs(latency):
        loop = closed_loop(PLANT, EXACT, {}, LAW, (), latency)
        drive = jax.jit(
            lambda key: drive_along_path(
                loop.plant,
                envs,
                key,
                limits=DriveClass(speed=(8.0, 10.5)),
                sensors=law_sensors(loop),
                offset=(0.0, 0.0, 0.0),
                burn_in=0,
            )
        )
        driven, readings = drive(jax.random.key(3))
        return np.asarray(driven.states), readings

    on_time, _ = runs(Latency())
    late, readings = runs(Latency((sensors,), (controls,)))
    # At the start neither knows what came before, and both contract.
    np.testing.assert_allclose(late[:, 100:], on_time[:, 100:], atol=tolerance)
    # What a gate expects of the next measurement agrees with it as well.
    whole = round((sensors + controls) / PLANT.dt)
    if tolerance < 1e-3:
        np.testing.assert_allclose(
            readings.measured[:, whole:], late[:, :-1, 3:][:, : 140 - whole], atol=1e-6
        )


def test_a_drive_that_is_later_than_the_steering_follows_it():
    """It is 0.1 s late beside the steering, and the speed approaches v_ref all the same."""
    envs = jnp.tile(ENV, (2, 80, 1))
    loop = closed_loop(PLANT, EXACT, {}, LAW, (), Latency((0.1,), (0.1, 0.2)))
    driven, readings = drive_along_path(
        loop.plant,
        envs,
        jax.random.key(3),
        limits=DriveClass(speed=(8.0, 10.5)),
        sensors=law_sensors(loop),
        burn_in=0,
    )
    assert readings.control.shape == (2, 80, 2)
    states = np.asarray(driven.states)
    gap = states[:, 40:-1, 5] - np.asarray(driven.controls)[:, 40:, 3]
    assert np.abs(gap).max() < 1.5
    assert np.abs(states[..., 3]).max() < 0.6


def test_a_model_of_another_car_is_seen_in_the_late_loop():
    """The equality above would not notice a loop without latency."""
    other = assembly.reference_systems(PLANT, LAW)["nominal"].model
    envs = jnp.tile(jnp.asarray([0.35, 8.0]), (2, 80, 1))

    def lateral(model):
        loop = closed_loop(PLANT, model, {}, LAW, (), Latency((0.2,), (0.1,)))
        driven, _ = drive_along_path(
            loop.plant,
            envs,
            jax.random.key(0),
            limits=DriveClass(speed=(8.0, 10.5)),
            sensors=law_sensors(loop),
            burn_in=0,
        )
        return np.asarray(driven.states)[..., 3]

    assert np.max(np.abs(lateral(EXACT) - lateral(other))) > 5e-3
