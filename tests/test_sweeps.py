"""Sweeps: every job has its own run, a failed job is reported and does not stop the
others, a study continues.
"""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sfkd_jax.cli import queues, sweeps

SCRIPT = """
    import os

    from sfkd_jax.pipeline import runs
    from sfkd_jax.cli.config import command_line
    from sfkd_jax.cli.entry import hydra_command

    def run(settings):
        if settings["seed"] == 1:
            raise ValueError("a job that cannot be done")
        if settings["seed"] == 2:
            raise TypeError("a job with a bug")
        if settings["seed"] == 4:
            os._exit(9)
        print("typed", command_line("toy"))
        return {"objective": (settings["seed"] - 3.0) ** 2, "run": str(runs.run_directory(settings))}

    if __name__ == "__main__":
        hydra_command(run)()
"""
RATES = "training.learning_rate=1e-3,0.003"


@pytest.fixture
def sweep(tmp_path):
    (tmp_path / "toy.py").write_text(textwrap.dedent(SCRIPT))

    def start(*arguments):
        command = [sys.executable, "toy.py", *arguments]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=300
        )

    return start


def failures(done):
    """The last lines of a sweep: one for each failed job, and the total."""
    lines = [line for line in done.stderr.splitlines() if "failed" in line]
    return lines[:-1], lines[-1]


def printed(done, word="{"):
    return [line for line in done.stdout.splitlines() if line.startswith(word)]


def test_every_job_has_a_run_named_by_its_settings_and_one_line_if_it_fails(sweep):
    done = sweep(
        "-m",
        "+experiment=smoke",
        RATES,
        "model.residual_hidden=[8,8],[16]",
        "seed=0,1,2",
    )
    assert done.returncode == 1
    runs = [json.loads(line)["run"] for line in printed(done)]
    assert len(set(runs)) == 4
    assert {Path(run).parts[-2:] for run in runs} == {("sfkd", "seed=0")}
    assert not any(character in run for run in runs for character in "[]'\"")
    names = {Path(run).parts[2] for run in runs}
    assert {name.split(",")[1] for name in names} == {
        "training.learning_rate=0.001",
        "training.learning_rate=0.003",
    }
    jobs, total = failures(done)
    assert (
        total
        == "sfkd_jax: 8 of 12 jobs failed; the same sweep again skips what is finished"
    )
    words = "training.learning_rate=0.001 model.residual_hidden=[8,8] seed=1"
    assert jobs[0] == f"sfkd_jax: job 1 ({words}) failed: a job that cannot be done"
    assert (
        sum(line.endswith("failed: TypeError: a job with a bug") for line in jobs) == 4
    )


def test_the_command_of_a_job_gives_the_same_run_in_a_shell(sweep):
    """Within a sweep over more jobs, and outside a sweep."""
    done = sweep("-m", "+experiment=smoke", RATES, "seed=0")
    command = printed(done, "typed")[0].split(" ", 4)[-1]
    again = sweep(
        *subprocess.check_output(
            ["sh", "-c", f"printf '%s\\n' {command}"], text=True
        ).split()
    )
    assert (again.returncode, again.stderr) == (0, "")
    assert printed(again) == printed(done)[:1]


def test_model_seed_and_settings_without_effect_on_weights_are_not_named_again(
    sweep,
):
    done = sweep(
        "-m",
        "+experiment=s1,s2",
        "model=sfkd_path,r2dn_path",
        "seed=0",
        "training.steps=50",
        "evaluation=tiny,quick",
    )
    runs = [json.loads(line)["run"] for line in printed(done)]
    run_dirs = [
        f"runs/{name}/{model}/seed=0"
        for name in ("s1", "s2")
        for model in ("sfkd_path", "r2dn_path")
    ]
    assert runs == [run_dir for run_dir in run_dirs for _ in range(2)]
    assert done.returncode == 0


def test_failures_of_joblib_workers_are_reported(sweep):
    done = sweep("-m", "seed=0,1", "hydra/launcher=cores")
    jobs, total = failures(done)
    assert jobs == ["sfkd_jax: job 1 (seed=1) failed: a job that cannot be done"]
    assert total.startswith("sfkd_jax: 1 of 2 jobs failed")
    assert "Traceback" not in done.stderr
    assert done.returncode == 1


def test_failures_of_submitit_jobs_and_killed_jobs_are_reported_with_their_log(sweep):
    done = sweep("-m", "seed=1,4", "hydra/launcher=submitit_local")
    jobs, total = failures(done)
    assert ["a job that cannot be done" in job for job in jobs] == [True, False]
    assert "has not produced any output" in jobs[1]
    assert all("_log.err" in job for job in jobs)
    assert total.startswith("sfkd_jax: 2 of 2 jobs failed")
    assert "Traceback" not in done.stderr
    assert done.returncode == 1


def test_a_sweep_that_cannot_be_launched_is_one_line(sweep, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")  # where no srun is
    done = sweep("-m", "seed=0,1", "hydra/launcher=cluster")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("sfkd_jax: the sweep stopped: ")
    assert "srun" in line


def test_outside_a_sweep_the_same_failure_is_an_exit_status(sweep):
    done = sweep("seed=1")
    assert (done.returncode, done.stderr.strip()) == (
        1,
        "sfkd_jax: a job that cannot be done",
    )


def test_a_study_minimises_survives_a_failure_and_continues(sweep, tmp_path):
    options = (
        "-m",
        "hydra/sweeper=optuna",
        "hydra.sweeper.n_jobs=1",
        "hydra.sweeper.direction=minimize",
    )
    options += (
        "hydra.sweeper.study_name=toy",
        "hydra.sweeper.storage=sqlite:///toy.db",
    )
    grid = ("hydra/sweeper/sampler=grid", "seed=choice(0,1,3,5)")
    results = []
    for trials in (2, 4):
        done = sweep(
            *options,
            *grid,
            f"hydra.sweeper.n_trials={trials}",
            f"hydra.sweep.dir=sweep{trials}",
        )
        assert done.returncode == 0, done.stderr[-2000:]
        results.append(
            OmegaConf.load(tmp_path / f"sweep{trials}" / "optimization_results.yaml")
        )
    assert results[-1].best_value == 0.0
    assert results[-1].best_params == {"seed": 3}


def test_a_study_fails_if_every_trial_did():
    sweep = sweeps.Sweep()
    sweep.is_study, sweep.jobs, sweep.failures = True, 2, ["job 0", "job 1"]
    assert sweep.status() == 1
    sweep.failures.pop()
    assert sweep.status() == 0


def composed(**values):
    config = {
        "training": {"a": 1.0, "b": "x"},
        "model": {"sizes": [8, 8]},
        "hydra": {"runtime": {"choices": {}}},
    }
    return OmegaConf.merge(config, OmegaConf.create(values))


@pytest.mark.parametrize(
    ("value", "spelled"),
    [
        (0.001, "0.001"),
        (1e-05, "1e-05"),
        (True, "true"),
        (None, "null"),
        ("identified", "identified"),
        ([64, 32], "64-32-"),
        ("logs/monday", "logs-monday-"),
        ("../x", "..-x-"),
        ("a,b=c", "a-b-c-"),
        ("x" * 60, "x" * 40 + "-"),
    ],
)
def test_a_value_is_spelled_so_that_files_can_be_called_by_it(value, spelled):
    name = sweeps.directory(composed(training={"b": value}), {"training.b"})
    key, value_name = name.split("=")
    assert key == "training.b"
    exact = not spelled.endswith("-")
    assert value_name == spelled if exact else value_name.startswith(spelled)
    assert len(value_name) == len(spelled) + (0 if exact else 8)


def test_policies_of_a_comparison_are_as_separate_as_its_results():
    known = {"name": "table1", "comparison": {"policies": "table1"}}
    typed = ["+experiment=table1", "training.a=1", "name=other"]
    assert sweeps.with_name(typed, OmegaConf.create(known), "") == typed
    named = sweeps.with_name(typed, OmegaConf.create(known), "training.a=1")
    assert named == [*typed[:2], r"name=table1/training.a\=1"]
    named = sweeps.with_name(
        typed, OmegaConf.create(known | {"name": "seeds"}), "training.a=1"
    )
    assert named[2:] == [
        r"name=seeds/training.a\=1",
        r"comparison.policies=table1/training.a\=1",
    ]


def test_directories_differ_where_settings_do_and_not_with_their_order():
    sizes = [
        composed(model={"sizes": sizes})
        for sizes in ([8, 8], [88], [8, [8]], ["8", 8], "8-8")
    ]
    assert len({sweeps.directory(config, {"model.sizes"}) for config in sizes}) == len(
        sizes
    )
    assert (
        sweeps.directory(composed(), {"training.b", "training.a"})
        == "training.a=1.0,training.b=x"
    )
    many = composed(training={f"setting{number}": number for number in range(40)})
    name = sweeps.directory(many, {f"training.setting{number}" for number in range(40)})
    assert len(name) <= sweeps.LONGEST_NAME
    assert name.startswith("40-settings-")


@pytest.fixture
def queue(monkeypatch):
    pytest.importorskip("submitit")
    now = [0.0]
    monkeypatch.setattr(queues.time, "monotonic", lambda: now[0])
    watcher = queues._queue()
    for job in ("7_0", "7_1"):
        watcher.register_job(job)

    def says(*lines, seconds=0.0):
        now[0] += seconds
        watcher._info_dict.update(watcher.read_info("\n".join(lines)))
        return [watcher.is_done(job, mode="cache") for job in ("7_0", "7_1")]

    says.watcher = watcher
    return says


def test_a_job_is_waited_for_while_slurm_may_run_it_again(queue, capsys):
    assert queue("7_0|RUNNING|None", "7_1|PENDING|Resources") == [False, False]
    assert queue("7_0|PENDING|BeginTime", "7_1|SUSPENDED|None") == [False, False]
    assert queue("7_0|RUNNING|None", "7_1|COMPLETING|None") == [False, False]
    assert queue("7_0|TIMEOUT|TimeLimit") == [True, True]
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "sfkd_jax: Slurm: 1 pending (Resources), 1 running"
    assert lines[-1] == "sfkd_jax: Slurm: 1 gone, 1 timeout"


def test_what_can_never_start_is_not_waited_for(queue):
    lines = ("7_0|PENDING|PartitionTimeLimit", "7_1|PENDING|Priority")
    assert queue(*lines) == [False, False]
    assert queue(*lines, seconds=queues.HOPELESS_S) == [True, False]
    assert "never start (Slurm says PartitionTimeLimit)" in queues._state_message(
        queue.watcher.get_info("7_0", mode="cache")
    )
    assert queue(
        "7_0|PENDING|Priority", "7_1|PENDING|Priority", seconds=queues.HOPELESS_S
    ) == [False, False]
    assert queue(*lines) == [False, False]


def test_what_was_raised_becomes_one_line():
    assert (
        queues.one_line(RuntimeError("sbatch: error:\n  no such partition"))
        == "sbatch: error: no such partition"
    )
    assert queues.one_line(KeyError("a")) == "KeyError: 'a'"
    assert queues.one_line(ValueError()) == "ValueError"
    assert len(queues.one_line(OSError("x" * 5000))) == 400
