"""Every plant: integrators, frames and mirrors, rest and stop, gradients, speed loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving.plants import rk4, with_speed_loop
from sfkd_jax.geometry import compose
from sfkd_jax.types import POSE


@pytest.mark.usefixtures("x64")
def test_the_error_falls_with_the_fourth_power_of_the_step(vehicle):
    state = jnp.zeros(len(vehicle.state_names)).at[3].set(12.0)
    state = state.at[4:].set(jnp.array([-0.2, 0.25, 0.06])[: state.size - 4])
    control, env = jnp.array([0.08, -1.5]), jnp.array([0.6, 4.0])

    @jax.jit
    def end(steps):
        step = rk4(lambda x, u, e: vehicle.derivative(x, u, e) / steps, dt=1.0)
        return jax.lax.fori_loop(0, steps, lambda _, x: step(x, control, env), state)

    steps = np.array([4, 6, 9, 14, 20]) * (
        10 if vehicle.name == "dynamic" else 1
    )  # tyres are stiffer than a path
    exact = end(3000)
    errors = [float(jnp.linalg.norm(end(n) - exact)) for n in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.15)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("which", ["step", "nominal", "nominal_derivative"])
def test_the_mirrored_drive_is_the_mirror_of_the_drive(vehicle, which, many, sweep):
    step = many(getattr(vehicle, which))
    drawn = sweep(vehicle, 64)
    flip = jnp.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])[: drawn.states.shape[1]]
    after = step(drawn.states, drawn.controls, drawn.envs)
    other = jnp.array([-1.0, 1.0])
    mirrored = step(
        flip * drawn.states, other * drawn.controls, other[::-1] * drawn.envs
    )
    np.testing.assert_allclose(mirrored, flip * after, rtol=0, atol=1e-12)
    assert jnp.abs(after - drawn.states)[:, 1:3].max() > 0.1


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("which", ["step", "nominal"])
def test_the_drive_does_not_depend_on_the_frame_it_is_expressed_in(
    vehicle, which, many, sweep
):
    step = many(getattr(vehicle, which))
    drawn = sweep(vehicle, 64)
    frame = jnp.array([30.0, -20.0, 2.3])

    def move(states):
        return states.at[:, POSE].set(
            jax.vmap(compose, in_axes=(None, 0))(frame, states[:, POSE])
        )

    there = step(move(drawn.states), drawn.controls, drawn.envs)
    np.testing.assert_allclose(
        there, move(step(drawn.states, drawn.controls, drawn.envs)), rtol=0, atol=1e-11
    )


@pytest.mark.parametrize(
    "loop", [lambda vehicle: vehicle, with_speed_loop], ids=["acceleration", "speed"]
)
def test_gradients_are_finite_at_rest_at_zero_and_at_the_extremes(factory, loop, sweep):
    """Single precision and one substep (the others repeat it), by state, control and
    environment.
    """
    vehicle = loop(factory(dt=0.02, substeps=1))
    weights = jnp.asarray(
        np.random.default_rng(1).normal(size=len(vehicle.state_names))
    )
    gradient = jax.jit(
        jax.vmap(jax.grad(lambda *row: weights @ vehicle.step(*row), argnums=(0, 1, 2)))
    )
    drawn = sweep(vehicle, 2000, overdrive=1.5)
    zeros = [
        jnp.zeros_like(drawn.states),
        jnp.zeros_like(drawn.controls),
        drawn.envs * jnp.array([1.0, 0.0]),
    ]
    for rows in ((drawn.states, drawn.controls, drawn.envs), zeros):
        gradients = gradient(*rows)
        assert all(bool(jnp.isfinite(g).all()) for g in gradients)
        assert max(float(jnp.abs(g).max()) for g in gradients) < 100.0


@pytest.mark.usefixtures("x64")
def test_the_nominal_derivative_is_the_limit_of_the_nominal_step_and_knows_nothing_of_hidden_states(
    factory, many, sweep
):
    vehicle, drawn = factory(dt=1e-6), sweep(factory(), 64)
    states = drawn.states.at[:, 3].add(1.0)
    rates = many(vehicle.nominal_derivative)(states, drawn.controls, drawn.envs)
    quotient = (
        many(vehicle.nominal)(states, drawn.controls, drawn.envs) - states
    ) / 1e-6
    np.testing.assert_allclose(rates[:, :4], quotient[:, :4], rtol=0, atol=1e-3)
    assert bool(jnp.all(rates[:, 4:] == 0.0))


@pytest.mark.parametrize("which", ["step", "nominal"])
def test_a_standing_car_with_its_brakes_on_stands(vehicle, which, hold):
    start = (
        jnp.zeros(len(vehicle.state_names)).at[POSE].set(jnp.array([3.0, -2.0, 0.7]))
    )
    states = hold(
        vehicle._replace(step=getattr(vehicle, which)),
        start,
        (0.3, -6.0),
        (0.5, 8.0),
        3.0,
    )
    np.testing.assert_array_equal(
        states[:, :4], jnp.broadcast_to(start[:4], states[:, :4].shape)
    )
    assert (states[:, 4:6] == 0).all()


@pytest.mark.parametrize("friction", [0.3, 0.9])
@pytest.mark.parametrize("steering", [0.0, 0.1])
def test_braking_stops_a_car_and_does_not_reverse_it(vehicle, friction, steering, hold):
    states = hold(vehicle, 8.0, (steering, -6.0), (friction, 0.0), 6.0)
    heading = jnp.stack([jnp.cos(states[:-1, 2]), jnp.sin(states[:-1, 2])], axis=1)
    advance = (jnp.diff(states[:, :2], axis=0) * heading).sum(axis=1)
    assert (states[:, 3] >= 0).all()
    assert (advance >= -1e-6).all()
    np.testing.assert_allclose(states[-10:, 3], 0.0, atol=1e-5)
    np.testing.assert_allclose(states[-10:, :2] - states[-1, :2], 0.0, atol=1e-5)
    assert advance.sum() > 0.9 * 8.0**2 / (2 * friction * 9.81)


def test_a_car_launches_from_rest_along_the_kinematic_curve(vehicle, hold):
    steering = 0.1
    states = hold(vehicle, 0.0, (steering, 1.0), (0.9, 0.0), 3.0)
    assert jnp.isfinite(states).all()
    assert (jnp.diff(states[:, 3]) > 0).all()
    late = states[10:]
    turned = jnp.diff(late[:, 2])
    gone = jnp.linalg.norm(jnp.diff(late[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(
        turned / gone, np.tan(steering) / vehicle.wheelbase, rtol=0.06
    )


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("which", ["step", "nominal", "nominal_derivative"])
def test_the_loop_asks_for_what_the_actuator_can_give(vehicle, which, many):
    def controls(second):
        return jnp.stack([jnp.full(4, 0.1), jnp.asarray(second)], axis=1)

    envs = jnp.tile(jnp.asarray([0.9, 0.0]), (4, 1))
    states = jnp.zeros((4, len(vehicle.state_names))).at[:, 3].set(10.0)
    closed, opened = (
        many(getattr(one, which))(states, controls(asked), envs)
        for one, asked in (
            (with_speed_loop(vehicle, gain=2.0), [1e3, -1e3, 10.4, 9.5]),
            (vehicle, [3.0, -6.0, 0.8, -1.0]),
        )
    )
    np.testing.assert_allclose(closed, opened, rtol=0, atol=1e-12)
