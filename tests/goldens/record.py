"""Record the controls of policies that ship, for `test_goldens.py`.

    PYTHONPATH=src:tests python tests/goldens/record.py kinematic_path dynamic_path

The episodes of the named policies are driven anew; the others stay as they are.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from helpers import optimised

import sfkd_jax
from sfkd_jax.driving import scenarios
from sfkd_jax.driving.paths import project, reference_window

RECORDED = Path(__file__).parent / "controls.npz"
STEPS = 60
KEY = 7
"""Of the roads, and of the planner in the test."""


def episode(policy, act, name):
    """States, environments, references and controls of one episode."""
    car = policy.vehicle
    sample = scenarios.scenario(
        name=name, duration=STEPS * car.dt, state_size=len(car.states), dt=car.dt
    )
    scene = sample(jax.random.key(KEY))
    state = scene.initial_state
    memory = policy.controller.init(jax.random.key(KEY))
    progress = np.float32(0.0)
    rows = []
    for env in scene.envs:
        reference = reference_window(
            scene.path, progress, scene.speed, dt=car.dt, horizon=20
        )
        control, memory, _ = act(policy.params, memory, state, env, reference)
        rows.append(tuple(map(np.asarray, (state, env, reference, control))))
        state = car.step(state, control, env)
        progress, _ = project(scene.path, state[:2], progress + scene.speed * car.dt)
    return map(np.stack, zip(*rows, strict=True))


def main(names):
    """Replace the episodes of these policies."""
    with np.load(RECORDED) as arrays:
        recorded = dict(arrays)
    for name in names:
        policy = sfkd_jax.load(name)
        act = optimised(policy.controller.act)
        for scenario in ("s1", "s2", "s3"):
            columns = episode(policy, act, scenario)
            for key, values in zip("xeru", columns, strict=True):
                recorded[f"{name}/{scenario}/{key}"] = values
    np.savez_compressed(RECORDED, **recorded)


if __name__ == "__main__":
    main(sys.argv[1:])
