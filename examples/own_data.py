"""SFKD on your own data: read logged runs, train, certify and plan.

python examples/own_data.py LOGS.npz with arrays x (run, time + 1, state), u (run, time,
control) and e (run, time, environment); the state begins with position [m] and
yaw [rad]. Without an argument it logs some first.
"""

import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import certification, control, models
from sfkd_jax.data import (
    Dataset,
    measure_space,
    random_windows,
    split,
    spread_windows,
)
from sfkd_jax.rollout import rollout
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import Trajectory

DT = 0.1


def log_some_runs(path: Path, runs: int) -> None:
    """Random runs of the robot of `own_vehicle.py`; yours come from a recorder."""
    from own_vehicle import step

    random, noise = np.random.default_rng(0), np.zeros((runs, 2))
    x = np.zeros((runs, 51, 5), np.float32)
    x[:, 0, 3] = random.uniform(1.0, 5.0, runs)
    u = np.zeros((runs, 50, 2), np.float32)
    levels = random.uniform([0.3, -5.0], [0.9, 5.0], (runs, 1, 2))
    e = np.tile(levels, (1, 50, 1)).astype(np.float32)
    move = jax.jit(jax.vmap(step))
    for k in range(50):
        noise = 0.8 * noise + random.normal(0, [0.2, 0.6], (runs, 2))
        u[:, k] = np.clip(noise, [-1, -2], [1, 2])
        x[:, k + 1] = move(x[:, k], u[:, k], e[:, k])
    np.savez(path, x=x, u=u, e=e)


def read(path: Path) -> Dataset:
    """Logged runs, dealt as wholes to training, validation, calibration and test."""
    with np.load(path) as logs:
        runs = Trajectory(*(jnp.asarray(logs[name], jnp.float32) for name in "xue"))
    box = {
        "env_low": runs.envs.min(axis=(0, 1)),
        "env_high": runs.envs.max(axis=(0, 1)),
    }
    return split(runs, jax.random.key(0), shares=(0.6, 0.1, 0.2, 0.1), **box)


def main(
    logs: str | None = None, runs: int = 400, steps: int = 500
) -> dict[str, float]:
    """Prediction error on held-out runs, the certified rate, and a first control."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(logs or Path(scratch) / "logs.npz")
        if logs is None:
            log_some_runs(path, runs)
        data = read(path)
        model = models.sfkd(measure_space(data), rank=16)
        loss = multi_step_loss(model, measure_space(data))
        draw = partial(random_windows, batch=64, length=20)
        held_out = spread_windows(data.validation, length=20)
        params, _ = fit(
            model,
            loss,
            draw,
            data.train,
            held_out,
            jax.random.key(1),
            Path(scratch) / "run",
            steps=steps,
        )
    proof = certification.certify(
        model, params, (data.env_low, data.env_high), attack_starts=0
    )

    low, high = (
        tuple(bound.tolist())
        for bound in (data.train.controls.min((0, 1)), data.train.controls.max((0, 1)))
    )
    cost, law = control.tracking_cost(dt=DT), control.no_feedback()
    task = control.path_tracking(
        model, cost, law, dt=DT, control_low=low, control_high=high
    )
    planner = control.mppi(task, num_samples=256, horizon=20, noise_std=(0.1, 0.3))
    ahead = jnp.arange(1, 21) * DT * 3.0
    reference = jnp.stack([ahead, 0 * ahead, 0 * ahead, 0 * ahead + 3.0], axis=1)
    state, env = jnp.asarray([0.0, 0.2, 0.0, 3.0, 0.0]), data.train.envs[0, 0]
    first, _, _ = jax.jit(planner.act)(
        params, planner.init(jax.random.key(2)), state, env, reference
    )
    errors = jax.vmap(partial(error_of_position, model, params))(held_out)
    return {
        "alpha": proof.alpha,
        "position_error_m": float(jnp.mean(errors)),
        "first_control": float(first[0]),
    }


def error_of_position(model, params, window):
    """Distance between the last predicted position and the true one [m]."""
    predicted = rollout(model, params, window).free
    return jnp.linalg.norm(predicted[-1, :2] - window.states[-1, :2])


if __name__ == "__main__":
    print(main(*sys.argv[1:2]))
