"""A test drive on several devices drives the same episodes as on one."""

import functools
import os
import subprocess
import sys
import textwrap

import pytest

PROGRAM = """
    import jax, jax.numpy as jnp, numpy as np
    from sfkd_jax import assembly, control, drive, evaluation, models, vehicle
    plant = vehicle.kinematic()
    told = {"delay_s": 0.0, "noise": [0.0, 0.0], "bias": [0.0, 0.0]}
    protocol = {"episodes": 4, "episode_s": 3.0, "seed": 1, "told": told, "variation": None}
    track = drive.lay({"evaluation": protocol, "scenario": {"name": "s3"}}, plant)
    law = control.path_feedback(wheelbase=plant.wheelbase)
    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    cost = control.tracking_cost(dt=plant.dt)
    task = control.path_tracking(models.physics(plant.nominal), cost, law, dt=plant.dt, **limits)
    planner = control.mppi(task, num_samples=16, horizon=5)
    def one(road, key):
        return evaluation.simulate(plant.step, planner, {}, road, key, dt=plant.dt, horizon=5).lateral
    lateral = jax.jit(jax.vmap(one))(track.roads, track.keys)
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
def test_episodes_are_dealt_to_all_devices_where_they_can_be_and_come_out_the_same(
    devices, used
):
    alone, alike = driven(1), driven(devices)
    assert alone[0] == 1
    assert alike[0] == used
    assert alike[1] == pytest.approx(alone[1], rel=1e-4, abs=1e-6)
