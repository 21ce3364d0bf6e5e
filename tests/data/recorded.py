"""A run that is known at every moment, and files of it as recorders write them."""

import jax
import numpy as np

from sfkd_jax import control
from sfkd_jax.data import recorder
from sfkd_jax.scenarios import project, reference_window, smooth_path

ERRORS, PROJECT = jax.jit(control.path_errors), jax.jit(project)
WINDOW = jax.jit(reference_window, static_argnames=("dt", "horizon"))
STATE = ("p_x", "p_y", "yaw", "v")
NAMES = ("t", *STATE, "steering", "acceleration", "friction", "wind")
WHEELBASE = 2.7


def recorded_run(seconds=30.0, period=0.1, phase=0.0):
    """Columns of a run along v = 5 + sin 0.7 t, yaw = 0.9 sin 0.4 t; positions by
    fine quadrature.
    """
    fine = 20
    t = np.arange(round(seconds / period) * fine + 1) * (period / fine)
    speed, yaw = 5 + np.sin(0.7 * t + phase), 0.9 * np.sin(0.4 * t + phase)
    rate = 0.36 * np.cos(0.4 * t + phase)

    def integral(values):
        return np.concatenate(
            [[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * (period / fine))]
        )

    columns = {
        "t": t,
        "p_x": integral(speed * np.cos(yaw)),
        "p_y": integral(speed * np.sin(yaw)),
        "yaw": yaw,
        "v": speed,
    }
    columns |= {
        "steering": np.arctan(WHEELBASE * rate / speed),
        "acceleration": 0.7 * np.cos(0.7 * t + phase),
    }
    columns |= {
        "friction": 0.6 + 0.2 * np.sin(0.1 * t),
        "wind": 4.0 * np.sin(0.5 * t + phase),
    }
    return {name: values[::fine] for name, values in columns.items()}


def write_csv(path, columns, separator=","):
    """The columns as text that gives every number back."""
    rows = zip(*columns.values(), strict=True)
    body = "\n".join(separator.join(f"{value:.17g}" for value in row) for row in rows)
    path.write_text(f"{separator.join(columns)}\n{body}\n")
    return str(path)


def write_npz(path, columns):
    np.savez(path, **columns)
    return str(path)


def hand_driven(car, seed):
    """A driver that nobody knows: (observation, env, reference) -> control."""
    random, noise = np.random.default_rng(seed), np.zeros(2)

    def act(observation, env, reference):
        noise[:] = 0.85 * noise + random.normal(0.0, [0.012, 0.4])
        yaw, after = reference[:2, 2]
        aside, turned, _ = ERRORS(observation, reference[0], 0.0)
        bend = (after - yaw) / (reference[0, 3] * car.dt)
        steer = car.wheelbase * bend - 0.04 * aside - 0.5 * turned
        push = 0.6 * (reference[0, 3] - observation[3])
        wanted = np.array([steer, push]) + noise
        return np.clip(wanted, car.control_low, car.control_high)

    return act


def drive(car, act, box, seconds, seed, speed=(8.0, 11.0), bend=0.02):
    """One run on a random road while e switches in its box: rows as a log has them."""
    random, key = np.random.default_rng(seed), jax.random.key(seed)
    path = smooth_path(key, length=speed[1] * seconds + 60.0, peak_curvature=bend)
    state, along = np.zeros(len(car.state_names)), 0.0
    state[3], phase = speed[0], random.uniform(0.0, 2.0 * np.pi)
    for k in range(round(seconds / car.dt)):
        if k % 40 == 0:
            env = random.uniform(*box)
        wave = 0.5 + 0.5 * np.sin(0.25 * k * car.dt + phase)
        wanted = speed[0] + (speed[1] - speed[0]) * wave
        reference = np.asarray(WINDOW(path, along, wanted, dt=car.dt, horizon=20))
        u = np.asarray(act(state.astype(np.float32), env, reference), float)
        yield [k * car.dt, *state, *u, *env]
        car.reset(state)
        state = np.asarray(car.step(u, env), float)
        along, _ = PROJECT(path, state[:2], along + state[3] * car.dt)


def drive_by_hand(car, folder, box, seeds, seconds, names):
    """Logs of a car under its own driver, a csv file a run."""
    folder.mkdir(parents=True)
    for seed in seeds:
        rows = [*drive(car, hand_driven(car, seed), box, seconds, seed)]
        file, form = folder / f"{seed}.csv", {"delimiter": ",", "comments": ""}
        np.savetxt(file, rows, "%.12g", header=names, **form)


def drive_under(policy, car, folder, box, seeds, seconds):
    """Runs of a car under a policy, as its user records them."""
    decide = jax.jit(policy.controller.act)
    for seed in seeds:
        state = policy.controller.init(jax.random.key(seed))
        with recorder(policy, folder / f"{seed}.csv") as record:

            def act(observation, env, reference):
                nonlocal state
                seen = observation, np.float32(env), reference
                u, state, info = decide(policy.params, state, *seen)
                record(*seen[:2], u, info)
                return u

            [*drive(car, act, box, seconds, seed, bend=0.015)]
