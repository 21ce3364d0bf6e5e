"""How late commands act, found in logs: within the interval, or undetermined."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded import write_csv

from sfkd_jax.driving import plants
from sfkd_jax.driving.logs import Columns, from_logs
from sfkd_jax.driving.logs._checks import Checks
from sfkd_jax.driving.logs._command_lags import command_lags
from sfkd_jax.driving.logs._logs import Log
from sfkd_jax.latency import Latency

PLANT = plants.kinematic()
CHECKS = Checks(
    columns=Columns(),
    dt=PLANT.dt,
    steps=10,
    wheelbase=PLANT.wheelbase,
    gap=2.5,
    min_speed=0.0,
    split_at_jumps=False,
    drop_missing=False,
    limits=(None, None),
    box=(None, None),
)
STEPS = 600


@cache
def drivers(delays):
    """(key, spread of both commands) -> states and commands of a car with the delays."""
    late = plants.late_loop(Latency((), delays), states=4, dt=PLANT.dt)
    env = jnp.asarray([0.8, 1.0])

    def drive(key, spread):
        command_key, noise_key = jax.random.split(key)

        def step(carry, draw):
            state, noise, pending = carry
            noise = 0.8 * noise + 0.6 * spread * draw
            command = noise + jnp.stack([0.0, 0.2 + 0.3 * (8.0 - state[3])])
            acting, pending = late.actuate(pending, command)
            after = PLANT.step(state, acting, env)
            return (after, noise, pending), (state, command)

        start = jnp.asarray([0.0, 0.0, 0.0, 8.0])
        carry = (start, jnp.zeros(2), late.init(jnp.append(start, 0.0)))
        draws = jax.random.normal(command_key, (STEPS, 2))
        _, (states, commands) = jax.lax.scan(step, carry, draws)
        noise = jax.random.normal(noise_key, states.shape)
        return states + jnp.asarray(PLANT.sensor_noise) * noise, commands

    return jax.jit(drive)


def driven(delays, seed, spread=(0.03, 0.6)):
    states, commands = drivers(delays)(jax.random.key(seed), jnp.asarray(spread))
    return np.asarray(states, float), np.asarray(commands, float)


def log_of(states, commands):
    count = len(states)
    return Log(
        source="1.csv",
        rows=np.arange(count),
        row_name="line",
        time=PLANT.dt * np.arange(count),
        states=states,
        controls=commands,
        envs=np.zeros((count, 2)),
        stretch=np.zeros(count, int),
    )


@pytest.mark.parametrize("delays", [(0.0,), (0.1,), (0.14,), (0.14, 0.08)])
def test_the_interval_has_the_latency_in_nine_of_ten_logs(delays):
    """The speed is held by a driver who sees it, and the sensors have noise."""
    hits = np.zeros(2)
    for seed in range(10):
        lags = command_lags(CHECKS, [log_of(*driven(delays, seed))])
        for k, lag in enumerate(lags.values()):
            hits[k] += lag.low_s <= delays[min(k, len(delays) - 1)] <= lag.high_s
            assert lag.high_s - lag.low_s < 0.06
    assert (hits >= 9).all()


def test_several_logs_say_more_than_one():
    logs = [log_of(*driven((0.14,), seed)) for seed in range(4)]
    one = command_lags(CHECKS, logs[:1])["acceleration"]
    all_of_them = command_lags(CHECKS, logs)["acceleration"]
    assert all_of_them.high_s - all_of_them.low_s < one.high_s - one.low_s


@pytest.mark.parametrize("spread", [(0.0, 0.0), (1e-5, 1e-3)])
def test_a_command_that_is_not_excited_has_no_lag(spread):
    states, commands = driven((0.1,), 0, spread)
    commands[:, 1] = 0.2
    lags = command_lags(CHECKS, [log_of(states, commands)])
    for lag in lags.values():
        assert lag.lag_s is lag.low_s is lag.high_s is None
    assert lags["steering"].line("steering").endswith("an undetermined time")


def test_too_short_a_log_has_no_lag():
    states, commands = driven((0.1,), 0)
    lags = command_lags(CHECKS, [log_of(states[:60], commands[:60])])
    assert lags["steering"].lag_s is None


def test_a_sine_whose_delays_repeat_is_not_determined():
    """Of 1.6 s: half a period later it agrees as well."""
    states, commands = driven((0.1,), 0)
    time = PLANT.dt * np.arange(STEPS)
    states[:, 2] = 0.1 * np.sin(2 * np.pi * time / 1.6)
    commands[:, 0] = np.cos(2 * np.pi * time / 1.6)
    assert command_lags(CHECKS, [log_of(states, commands)])["steering"].lag_s is None


def test_a_speed_command_is_found_and_its_servo_counts_as_lag():
    """0.1 s of latency, and a time constant of 0.1 s."""
    states, commands = driven((0.0,), 1)
    noise = np.random.default_rng(0).normal(0.0, 1.0, STEPS)
    command = 8.0 + np.convolve(noise, np.ones(10) / 10, "same")
    speed = np.full(STEPS, 8.0)
    for k in range(1, STEPS - 1):
        speed[k + 1] = command[k - 1] + (speed[k] - command[k - 1]) * np.exp(-1.0)
    states[:, 3] = speed
    commands[:, 1] = command
    lag = command_lags(CHECKS, [log_of(states, commands)])["acceleration"]
    assert 0.15 < lag.lag_s < 0.22


def test_from_logs_says_it_in_a_line_and_returns_it(tmp_path):
    states, commands = driven((0.14, 0.08), 0)
    columns = {"t": PLANT.dt * np.arange(STEPS)}
    columns |= dict(zip(("p_x", "p_y", "yaw", "v"), states.T, strict=True))
    columns |= dict(zip(("steering", "acceleration"), commands.T, strict=True))
    write_csv(tmp_path / "1.csv", columns)
    lines = []
    logged = from_logs(
        str(tmp_path),
        Columns(),
        dt=PLANT.dt,
        wheelbase=PLANT.wheelbase,
        needs_environment=False,
        steps=10,
        report=lines.append,
    )
    (line,) = (line for line in lines if "follows" in line)
    lag = logged.command_lags["steering"]
    assert f"yaw follows steering after 0.14 s ({lag.low_s:.2f} to" in line
    assert "latency and lag of the actuators together" in line
    assert abs(logged.command_lags["acceleration"].lag_s - 0.08) < 0.02
