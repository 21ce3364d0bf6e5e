"""SFKD learns from your own logged runs: read, train, certify and plan.

    python examples/own_data.py [LOGS.npz]

LOGS.npz has the arrays x (run, time + 1, state), u (run, time, control) and e (run,
time, environment); the state begins with position [m] and yaw [rad]. Without a file the
program logs some runs of a simulated robot first. It prints the certified rate, the
error of predicted positions on held-out runs, and the first control of a plan.
"""

import argparse
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import certification, control, models
from sfkd_jax.data import Dataset, measure_space, random_windows, split, spread_windows
from sfkd_jax.driving import path_following
from sfkd_jax.rollout import rollout
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import Trajectory

DT = 0.1  # control period [s]
WINDOW = 20  # steps that the loss predicts
HORIZON = 20  # steps that the planner predicts
SPEED = 3.0  # of the reference [m/s]


def log_some_runs(path: Path, runs: int) -> None:
    """Write random runs of the robot of `own_vehicle.py`, in place of a recorder."""
    from own_vehicle import step

    steps = 50
    random = np.random.default_rng(0)
    x = np.zeros((runs, steps + 1, 5), np.float32)
    x[:, 0, 3] = random.uniform(1.0, 5.0, runs)
    u = np.zeros((runs, steps, 2), np.float32)
    levels = random.uniform([0.3, -5.0], [0.9, 5.0], (runs, 1, 2))
    e = np.tile(levels, (1, steps, 1)).astype(np.float32)
    move = jax.jit(jax.vmap(step))
    noise = np.zeros((runs, 2))
    for k in range(steps):
        noise = 0.8 * noise + random.normal(0, [0.2, 0.6], (runs, 2))
        u[:, k] = np.clip(noise, [-1, -2], [1, 2])
        x[:, k + 1] = move(x[:, k], u[:, k], e[:, k])
    np.savez(path, x=x, u=u, e=e)


def read(path: Path) -> Dataset:
    """Return logged runs, dealt to training, validation, calibration and test."""
    with np.load(path) as logs:
        runs = Trajectory(
            states=jnp.asarray(logs["x"], jnp.float32),
            controls=jnp.asarray(logs["u"], jnp.float32),
            envs=jnp.asarray(logs["e"], jnp.float32),
        )
    return split(
        runs,
        jax.random.key(0),
        shares=(0.6, 0.1, 0.2, 0.1),
        env_low=runs.envs.min(axis=(0, 1)),
        env_high=runs.envs.max(axis=(0, 1)),
    )


def train(data: Dataset, steps: int, directory: Path):
    """Return the model and its trained parameters."""

    def draw(runs, key):
        return random_windows(runs, key, batch=64, length=WINDOW)

    space = measure_space(data)
    model = models.sfkd(space, rank=16)
    params, _ = fit(
        model,
        multi_step_loss(model, space),
        draw,
        data.train,
        spread_windows(data.validation, length=WINDOW),
        jax.random.key(1),
        directory,
        steps=steps,
    )
    return model, params


def build_planner(model, controls):
    """Return MPPI with the learned model, within the controls that were logged."""
    task = path_following.path_tracking(
        model,
        path_following.tracking_cost(dt=DT),
        path_following.no_feedback(),
        dt=DT,
        control_low=tuple(controls.min((0, 1)).tolist()),
        control_high=tuple(controls.max((0, 1)).tolist()),
    )
    return control.mppi(task, num_samples=256, horizon=HORIZON, noise_std=(0.1, 0.3))


def straight_reference():
    """Return poses and speed of a straight road ahead, (horizon, 4)."""
    ahead = jnp.arange(1, HORIZON + 1) * DT * SPEED
    zero = 0 * ahead
    return jnp.stack([ahead, zero, zero, zero + SPEED], axis=1)


def position_error(model, params, windows):
    """Return the mean distance of the last predicted position from the true one [m]."""

    def error(window):
        predicted = rollout(model, params, window).free
        return jnp.linalg.norm(predicted[-1, :2] - window.states[-1, :2])

    return jnp.mean(jax.vmap(error)(windows))


def main(
    logs: str | None = None, runs: int = 400, steps: int = 500
) -> dict[str, float]:
    """Return the certified rate, the error on held-out runs, and a first control."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(logs or Path(scratch) / "logs.npz")
        if logs is None:
            log_some_runs(path, runs)
        data = read(path)
        model, params = train(data, steps, Path(scratch) / "run")
    proof = certification.prove(
        model, params, (data.env_low, data.env_high), attack_starts=0
    )

    planner = build_planner(model, data.train.controls)
    state = jnp.asarray([0.0, 0.2, 0.0, SPEED, 0.0])
    env = data.train.envs[0, 0]
    first, _, _ = jax.jit(planner.act)(
        params, planner.init(jax.random.key(2)), state, env, straight_reference()
    )
    held_out = spread_windows(data.validation, length=WINDOW)
    return {
        "alpha": proof.alpha,
        "position_error_m": float(position_error(model, params, held_out)),
        "first_control": float(first[0]),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="?", metavar="LOGS.npz")
    print(main(parser.parse_args().logs))
