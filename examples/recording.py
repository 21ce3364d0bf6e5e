"""Runs of a simulated car as its owner would record them, a CSV file a run.

A car is any simulator of `vehicle=simulator` (`highway.py` is one): it has `dt`,
`wheelbase`, `state_names`, limits of the controls, `reset` and `step`.
`experiments/logs.sh` goes from such files to a policy in its corridor.
"""

import jax
import numpy as np

from sfkd_jax.driving import path_following
from sfkd_jax.driving.logs import recorder
from sfkd_jax.driving.paths import project, reference_window
from sfkd_jax.driving.scenarios import smooth_path

path_errors = jax.jit(path_following.path_errors)
project_on_path = jax.jit(project)
window_ahead = jax.jit(reference_window, static_argnames=("dt", "horizon"))


def hand_driven(car, seed):
    """A driver that nobody knows: (observation, environment, reference) -> control."""
    random = np.random.default_rng(seed)
    noise = np.zeros(2)

    def act(observation, env, reference):
        noise[:] = 0.85 * noise + random.normal(0.0, [0.012, 0.4])
        yaw, next_yaw = reference[:2, 2]
        lateral, heading, _ = path_errors(observation, reference[0], 0.0)
        curvature = (next_yaw - yaw) / (reference[0, 3] * car.dt)
        steering = car.wheelbase * curvature - 0.04 * lateral - 0.5 * heading
        acceleration = 0.6 * (reference[0, 3] - observation[3])
        wanted = np.array([steering, acceleration]) + noise
        return np.clip(wanted, car.control_low, car.control_high)

    return act


def drive(car, act, box, seconds, seed, speed=(8.0, 11.0), peak_curvature=0.02):
    """Drive a random road while the environment switches in its box every 40 steps.

    Args:
        car: a simulator.
        act: (observation, environment, reference) -> control.
        box: lower and upper end of the environment.
        seconds: of the run.
        seed: of road and environment.
        speed: the reference speed varies in this range [m/s].
        peak_curvature: of the road [1/m].

    Yields:
        rows as a log has them: time, state, control, environment.
    """
    random = np.random.default_rng(seed)
    path = smooth_path(
        jax.random.key(seed),
        length=speed[1] * seconds + 60.0,
        peak_curvature=peak_curvature,
    )
    state = np.zeros(len(car.state_names))
    state[3] = speed[0]
    along = 0.0
    phase = random.uniform(0.0, 2.0 * np.pi)
    for number in range(round(seconds / car.dt)):
        if number % 40 == 0:
            env = random.uniform(*box)
        wave = 0.5 + 0.5 * np.sin(0.25 * number * car.dt + phase)
        wanted = speed[0] + (speed[1] - speed[0]) * wave
        ahead = window_ahead(path, along, wanted, dt=car.dt, horizon=20)
        reference = np.asarray(ahead)
        command = np.asarray(act(state.astype(np.float32), env, reference), float)
        yield [number * car.dt, *state, *command, *env]
        car.reset(state)
        state = np.asarray(car.step(command, env), float)
        along, _ = project_on_path(path, state[:2], along + state[3] * car.dt)


def drive_by_hand(car, folder, box, seeds, seconds, names):
    """Log runs of a car under its own driver; `names` is the first line of a file."""
    folder.mkdir(parents=True)
    for seed in seeds:
        rows = [*drive(car, hand_driven(car, seed), box, seconds, seed)]
        file = folder / f"{seed}.csv"
        np.savetxt(file, rows, "%.12g", header=names, delimiter=",", comments="")


def drive_under(policy, car, folder, box, seeds, seconds):
    """Record runs of a car under a policy, as its user does."""
    decide = jax.jit(policy.controller.act)
    for seed in seeds:
        memory = policy.controller.init(jax.random.key(seed))
        with recorder(policy, folder / f"{seed}.csv") as record:

            def act(observation, env, reference):
                nonlocal memory
                env = np.float32(env)
                command, memory, info = decide(
                    policy.params, memory, observation, env, reference
                )
                record(observation, env, command, info)
                return command

            for _ in drive(car, act, box, seconds, seed, peak_curvature=0.015):
                pass
