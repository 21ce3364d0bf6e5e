"""Commands that start from nothing make all artefacts that they need."""

import json

import numpy as np
import pytest
from helpers import last_line, run_command


def test_a_sweep_runs_every_job_and_ends_with_json(tmp_path):
    done = run_command(
        "generate",
        "-m",
        "+experiment=smoke",
        "dataset.segments=40",
        "dataset.seed=0,1",
        cwd=tmp_path,
    )
    assert last_line(done)["segments"] == 40
    assert len(list((tmp_path / "runs/datasets").iterdir())) == 2


ROBOT = """
import jax.numpy as jnp


def step(x, u, e):
    p_x, p_y, yaw, v, rate = x
    wanted = v * jnp.tan(u[0]) * jnp.minimum(1.0, 0.5 + e[0])
    heading = yaw + 0.1 * rate
    ahead = jnp.stack([p_x + 0.1 * v * jnp.cos(heading), p_y + 0.1 * v * jnp.sin(heading), heading])
    return jnp.append(ahead, jnp.stack([v + 0.1 * u[1], rate + 0.5 * (wanted - rate)]))
"""


@pytest.mark.exhaustive
def test_all_stages_run_for_a_users_step_function_under_a_speed_loop(tmp_path):
    """A step function in the current directory gives data, weights, a certificate,
    episodes and a report.
    """
    (tmp_path / "my_robot.py").write_text(ROBOT)
    own = (
        "vehicle=own",
        "vehicle.step=my_robot:step",
        "vehicle.state_names=[p_x,p_y,yaw,v,yaw_rate]",
    )
    own += (
        "vehicle.control_low=[-0.4,-3.0]",
        "vehicle.control_high=[0.4,2.0]",
        "vehicle.wheelbase=1.0",
    )
    small = (
        "training.steps=25",
        "training.save_every=25",
        "dataset.segments=160",
        "evaluation.episode_s=4.0",
    )
    small += (
        "model.rank=8",
        "model.vertices=3",
        "model.residual_hidden=[8,8]",
        "model.decoder_hidden=[8]",
    )
    small += ("evaluation.systems=[self]", "vehicle.inner_loop=speed", "name=robot")
    summary = last_line(
        run_command("train", "+experiment=smoke", *own, *small, cwd=tmp_path)
    )
    assert (tmp_path / summary["report"]).exists()
    assert 0 < summary["alpha"] < 1
    (row,) = json.loads((tmp_path / summary["results"]).read_text())["rows"]
    assert (row["system"], row["vehicle"], row["episodes"]) == ("sfkd", "own", 2)
    assert np.isfinite(row["rmse_m"]["mean"])
