"""Several devices simulate the same episodes as one."""

import functools
import os
import subprocess
import sys
import textwrap

import pytest

PROGRAM = """
    import jax, jax.numpy as jnp, numpy as np
    from sfkd_jax import control, evaluation, models, plants
    from sfkd_jax.pipeline import evaluate_system
    plant = plants.kinematic()
    sensor = {"delay_s": 0.0, "noise": [0.0, 0.0], "bias": [0.0, 0.0]}
    protocol = {"episodes": 4, "episode_s": 3.0, "seed": 1, "variation": None}
    settings = {
        "evaluation": protocol | {"env_sensor": sensor},
        "scenario": {"name": "s3"},
    }
    episodes = evaluate_system.make_episodes(settings, plant)
    law = control.path_feedback(wheelbase=plant.wheelbase)
    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    cost = control.tracking_cost(dt=plant.dt)
    task = control.path_tracking(models.physics(plant.nominal), cost, law, dt=plant.dt, **limits)
    planner = control.mppi(task, num_samples=16, horizon=5)
    def one(scenario, key):
        return evaluation.simulate(
            plant.step, planner, {}, scenario, key, dt=plant.dt, horizon=5
        ).lateral
    lateral = jax.jit(jax.vmap(one))(episodes.scenarios, episodes.keys)
    print(len(lateral.sharding.device_set), *np.asarray(lateral).ravel().tolist())
"""


@functools.cache
def driven(devices):
    flags = {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    }
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    done = subprocess.run(
        command, env=os.environ | flags, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    used, *lateral = done.stdout.split()
    return int(used), [float(value) for value in lateral]


@pytest.mark.parametrize(("devices", "used"), [(2, 2), (3, 1)])
def test_devices_share_the_episodes_evenly_and_return_the_same_drives(devices, used):
    alone, alike = driven(1), driven(devices)
    assert alone[0] == 1
    assert alike[0] == used
    assert alike[1] == pytest.approx(alone[1], rel=1e-4, abs=1e-6)
