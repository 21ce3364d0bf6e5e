"""Coordinates relative to a reference: exact, invertible, and checked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusal_of
from loops import DT, frame, mass, pushed, tracked

from sfkd_jax.systems import System, Tracked, integrated, regulation, tracking

NAN = float("nan")


def arm(step=pushed, **changed):
    """A system with angles: one that the reference has, and one that it has not."""
    states = {"way [m]": 0.0, "yaw [rad]": 0.0, "roll [rad]": 0.0, "turn [rad/s]": 0.0}
    arguments = {
        "reference": {("way",): (-1.0, 1.0), ("yaw", "turn"): (-1.0, 1.0)},
        "ranges": {"turn": (-0.5, 0.5)},
        "held": ("way",),
        **changed,
    }
    return Tracked(mass(step, states=states), tracking({"way": ("way",)}, **arguments))


def test_coordinates_and_state_are_inverse_and_only_angles_of_the_reference_wrap():
    of = arm()
    keys = jax.random.split(jax.random.key(0), 2)
    errors = jax.random.uniform(keys[0], (50, 4), minval=-3.0, maxval=3.0)
    references = 9.0 * jax.random.normal(keys[1], (50, 3))
    states = jax.vmap(of.state)(errors, references)
    np.testing.assert_allclose(
        jax.vmap(of.coordinates)(states, references), errors, atol=1e-5
    )
    turned = states + 2.0 * jnp.pi * jnp.asarray([0.0, 1.0, 1.0, 0.0])
    wrapped = jax.vmap(of.coordinates)(turned, references) - errors
    np.testing.assert_allclose(wrapped[:, [0, 1, 3]], 0.0, atol=1e-5)
    np.testing.assert_allclose(wrapped[:, 2], 2.0 * np.pi, atol=1e-5)


def test_a_reference_with_constant_rates_advances_exactly():
    of = arm()
    rates = jnp.asarray([0.3, -0.7])
    start = jnp.asarray([1.0, 0.2, 0.4])
    point = start
    for _ in range(20):
        point = of.advance(point, rates)
    t = 20 * DT
    expected = [1.0 + 0.3 * t, 0.2 + 0.4 * t - 0.35 * t**2, 0.4 - 0.7 * t]
    np.testing.assert_allclose(point, expected, rtol=1e-5)


def test_inputs_are_the_rates_and_the_ranged_states_of_a_reference():
    of = arm()
    assert of.frame.input_names == ("rate of way", "rate of turn", "turn")
    assert of.frame.input_box == ((-1.0, -1.0, -0.5), (1.0, 1.0, 0.5))
    rates = jnp.asarray([[0.3, -0.7], [0.1, 0.5], [-0.9, 0.2]])
    points = [jnp.asarray([1.0, 0.2, 0.4])]
    for rate in rates:
        points.append(of.advance(points[-1], rate))
    between = of.rates_between(jnp.stack(points))
    np.testing.assert_allclose(between, rates, atol=1e-5)
    np.testing.assert_allclose(
        of.inputs(points[1], between[1]), [0.1, 0.5, points[1][2]], atol=1e-5
    )


def test_an_angle_of_the_reference_may_be_wrapped():
    of = arm(reference={("yaw",): (-1.0, 1.0)}, ranges={}, held=("yaw",))
    points = jnp.asarray([[np.pi - 0.01], [-np.pi + 0.04]])
    np.testing.assert_allclose(of.rates_between(points), [[0.05 / DT]], atol=1e-4)


def test_a_step_of_the_error_is_the_step_of_state_and_reference():
    of = tracked()
    error = jnp.asarray([0.2, -0.1])
    point = jnp.asarray([3.0, 0.5])
    rates = jnp.asarray([0.8])
    control = jnp.asarray([1.0])
    env = jnp.asarray([1.1, 0.3])
    after = pushed(of.state(error, point), control, env)
    expected = of.coordinates(after, of.advance(point, rates))
    inputs = of.inputs(point, rates)
    np.testing.assert_allclose(
        of.step(error, control, inputs, env), expected, atol=1e-6
    )


def dragged(drag):
    """The mass with a force that depends on its velocity and on e."""

    def step(state, control, env):
        return pushed(state, control - drag(state[1], control[0], env), env)

    return Tracked(mass(step), frame())


@pytest.mark.parametrize(
    "drag",
    [
        lambda v, u, e: 0.05 * v,
        # Without wind, or without control, nothing depends on the velocity.
        lambda v, u, e: 0.2 * v * e[1],
        lambda v, u, e: 0.2 * v * u,
    ],
    ids=["drag", "wind", "control"],
)
def test_drag_needs_the_range_of_the_velocity(drag):
    of = dragged(drag)
    line = refusal_of(lambda: of.check_invariance(jax.random.key(0)))
    assert line is not None
    assert 'ranges={"v"' in line
    ranged = Tracked(of.system, frame(ranges={"v": (-1.0, 1.0)}))
    ranged.check_invariance(jax.random.key(0))
    tracked().check_invariance(jax.random.key(0))


def test_a_small_drag_is_seen_beside_a_state_that_changes_fast():
    def step(state, control, env):
        drag = 0.05 * state[1]
        body = pushed(state[:2], control - drag, env)
        return jnp.append(body, state[2] + 1000.0 * control[0] * DT)

    states = {"x": 0.0, "v": 0.0, "heat": 0.0}
    of = Tracked(mass(step, states=states), frame())
    assert refusal_of(lambda: of.check_invariance(jax.random.key(0))) is not None


def test_a_system_may_be_undefined_outside_the_range_of_its_reference():
    def step(state, control, env):
        return pushed(state, control - jnp.log(state[1]), env)

    of = Tracked(mass(step), frame(ranges={"v": (5.0, 9.0)}))
    of.check_invariance(jax.random.key(0))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"held": ("x", "v")}, "held"),
        ({"held": ("y",)}, "'y'; there are x, v"),
        ({"outputs": {"position": ("z",)}}, "'z'"),
        ({"outputs": {"position": ()}}, "position"),
        ({"outputs": {}}, "output"),
        ({"reference": {}}, "reference"),
        ({"reference": {("x", "w"): (-1.0, 1.0)}}, "'w'"),
        ({"reference": {("x", "v", "a"): (-1.0, 1.0)}}, "1 or 2 states"),
        ({"reference": {(): (-1.0, 1.0)}}, "reference: a chain"),
        ({"reference": {("x", "v"): (1.0, -1.0)}}, "the rate of v"),
        ({"reference": {("x", "v"): (0.5, 1.0)}}, "the rate of v"),
        ({"reference": {("x", "v"): (NAN, 1.0)}}, "the rate of v"),
        ({"reference": {("x",): (-1.0, 1.0), ("x", "v"): (-1.0, 1.0)}}, "two chains"),
        ({"reference": {("x",): (-1.0, 1.0), ("v",): (-1.0, 1.0)}}, "held"),
        ({"ranges": {"w": (-1.0, 1.0)}}, "ranges: w"),
        ({"ranges": {"v": (1.0, -1.0)}}, "ranges: v"),
        ({"ranges": {"x": (-1.0, 1.0), "v": (2.0, 3.0)}}, "ranges: x cannot stay"),
        ({"dwell": (2.0, 1.0)}, "dwell"),
        ({"dwell": (0.0, 1.0)}, "dwell"),
        ({"dwell": (1.0, np.inf)}, "dwell"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused_in_one_line(changed, named):
    line = refusal_of(lambda: tracked(**changed))
    assert line is not None
    assert named in line
    assert "none" not in line


def boat(drift=0.0, **changed):
    """A body that moves where it points, in a current that does not turn with it."""

    def rates(state, control, env):
        yaw, v, _, _ = state
        sideways = v * jnp.sin(yaw)
        return [env[0] * control[0], control[1], v * jnp.cos(yaw) + drift, sideways]

    system = System(
        integrated(rates, dt=DT),
        dt=DT,
        states={"yaw [rad]": 0.0, "v [m/s]": 0.0, "x [m]": 0.0, "y [m]": 0.0},
        controls={"turn [rad/s]": (-2.0, 2.0), "push [m/s²]": (-2.0, 2.0)},
        environment={"rudder": (0.8, 1.2)},
    )
    arguments = {
        "reference": {("yaw",): (-1.0, 1.0), ("v",): (-0.5, 0.5)},
        "ranges": {"v": (1.0, 2.0)},
        "course": ("x", "y", "yaw", "v"),
        **changed,
    }
    return Tracked(system, tracking({"position": ("x", "y")}, **arguments))


def test_the_error_of_a_course_turns_with_its_reference(key):
    of = boat()
    assert of.frame.followed == ("yaw", "v", "x", "y")
    assert [of.names[index] for index in of.held] == ["x", "y"]
    errors, references = jax.random.normal(key, (2, 50, 4))
    states = jax.vmap(of.state)(errors, references)
    np.testing.assert_allclose(
        jax.vmap(of.coordinates)(states, references), errors, atol=1e-5
    )
    # What is ahead of a reference that looks along y has a larger y.
    north = jnp.asarray([0.5 * np.pi, 1.0, 3.0, 4.0])
    np.testing.assert_allclose(
        of.state(jnp.asarray([0.0, 0.0, 2.0, 1.0]), north),
        [0.5 * np.pi, 1.0, 2.0, 6.0],
        atol=1e-5,
    )


def test_the_reference_of_a_course_moves_along_an_arc():
    of = boat()
    rate = 0.8
    v = 1.5
    rates = jnp.asarray([rate, 0.0])
    point = jnp.asarray([0.3, v, 5.0, -2.0])
    before = point
    for _ in range(20):
        before = point
        point = of.advance(point, rates)
    yaw = 0.3 + rate * 20 * DT
    x = 5.0 + v / rate * (np.sin(yaw) - np.sin(0.3))
    y = -2.0 - v / rate * (np.cos(yaw) - np.cos(0.3))
    np.testing.assert_allclose(point, [yaw, v, x, y], atol=1e-5)
    assert of.moves(before, rates, point)
    # 3 cm to the side are more than the room of a step.
    assert not of.moves(before, rates, point.at[2].add(0.03))


def test_a_step_of_a_course_is_the_same_wherever_its_reference_points(key):
    of = boat()
    of.check_invariance(key)
    error = jnp.asarray([0.2, -0.1, 0.3, -0.4])
    point = jnp.asarray([2.0, 1.2, -7.0, 3.0])
    rates = jnp.asarray([0.8, -0.3])
    control = jnp.asarray([1.0, 0.4])
    env = jnp.asarray([1.1])
    after = of.system.step(of.state(error, point), control, env)
    np.testing.assert_allclose(
        of.step(error, control, of.inputs(point, rates), env),
        of.coordinates(after, of.advance(point, rates)),
        atol=1e-5,
    )
    line = refusal_of(lambda: boat(drift=0.5).check_invariance(key))
    assert line is not None
    assert "yaw of the reference" in line


@pytest.mark.parametrize(
    ("course", "named"),
    [
        (("x", "y", "yaw"), "course: two states"),
        (("x", "x", "yaw", "v"), "course"),
        (("x", "y", "yaw", "w"), "course: w is in no chain"),
        (("yaw", "y", "yaw", "v"), "course"),
        (("v", "y", "yaw", "x"), "course: v is in a chain"),
        (("x", "z", "yaw", "v"), "'z'"),
    ],
)
def test_a_course_that_does_not_fit_is_refused_in_one_line(course, named):
    line = refusal_of(lambda: boat(course=course))
    assert line is not None
    assert named in line


def test_a_state_is_held_once():
    two = {"left [N]": (-1.0, 1.0), "right [N]": (-1.0, 1.0)}
    line = refusal_of(lambda: Tracked(mass(controls=two), frame(held=("x", "x"))))
    assert line is not None
    assert "held" in line


def test_regulation_is_a_set_point_that_moves_at_a_limited_rate():
    rests = regulation(
        {"position": ("x",)}, set_points={"x": (-2.0, 2.0)}, rates={"x": 0.5}
    )
    assert dict(rests.reference) == {("x",): (-0.5, 0.5)}
    assert rests.input_box == ((-0.5, -2.0), (0.5, 2.0))
    of = Tracked(mass(), rests)
    # The velocity is no state of the reference, and stays as it is.
    error = of.coordinates(jnp.asarray([1.0, 0.3]), jnp.asarray([0.4]))
    np.testing.assert_allclose(error, [0.6, 0.3], atol=1e-6)
    for rates in ({}, {"x": -0.5}, {"x": 0.5, "v": 1.0}):
        line = refusal_of(
            lambda rates=rates: regulation(
                {"position": ("x",)}, set_points={"x": (-2.0, 2.0)}, rates=rates
            )
        )
        assert line is not None
        assert "rate" in line
