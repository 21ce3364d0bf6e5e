"""Sweeps: a job that fails does not take the others with it, a sweeper is told, and a study goes on."""

import json
import subprocess
import sys
import textwrap

import pytest
from omegaconf import OmegaConf

SCRIPT = """
    from sfkd_jax.config import door

    def run(settings):
        if settings["seed"] == 1:
            raise ValueError("a job that cannot be done")
        return {"objective": (settings["seed"] - 3.0) ** 2}

    if __name__ == "__main__":
        door(run)()
"""


@pytest.fixture
def sweep(tmp_path):
    (tmp_path / "toy.py").write_text(textwrap.dedent(SCRIPT))

    def start(*arguments):
        command = [sys.executable, "toy.py", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)

    return start


@pytest.mark.parametrize("launcher", ["basic", "cores"])
def test_a_failed_job_leaves_the_others_alone(sweep, launcher):
    done = sweep("-m", "seed=0,1,2", f"hydra/launcher={launcher}")
    assert done.returncode == 0, done.stderr[-2000:]
    if launcher == "basic":  # the other one's workers write elsewhere
        objectives = [json.loads(line)["objective"] for line in done.stdout.splitlines() if line.startswith("{")]
        assert objectives == [9.0, 1.0]
        assert "sfkd_jax: a job that cannot be done" in done.stderr


def test_outside_a_sweep_the_same_failure_is_an_exit_status(sweep):
    done = sweep("seed=1")
    assert (done.returncode, done.stderr.strip()) == (1, "sfkd_jax: a job that cannot be done")


def test_a_study_minimises_survives_a_failure_and_continues(sweep, tmp_path):
    options = ("-m", "hydra/sweeper=optuna", "hydra.sweeper.n_jobs=1", "hydra.sweeper.direction=minimize")
    options += ("hydra.sweeper.study_name=toy", "hydra.sweeper.storage=sqlite:///toy.db")
    grid = ("hydra/sweeper/sampler=grid", "seed=choice(0,1,2,3)")
    found = []
    for trials in (2, 4):
        done = sweep(*options, *grid, f"hydra.sweeper.n_trials={trials}", f"hydra.sweep.dir=sweep{trials}")
        assert done.returncode == 0, done.stderr[-2000:]
        found.append(OmegaConf.load(tmp_path / f"sweep{trials}" / "optimization_results.yaml"))
    assert found[-1].best_value == 0.0
    assert found[-1].best_params == {"seed": 3}
