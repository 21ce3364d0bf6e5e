"""The command line: errors of one line, sweeps."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from sfkd_jax.experiment.command import hydra_command

SCRIPT = """
    import os
    from sfkd_jax.certification import CertificateStale, CertificationRefused
    from sfkd_jax.experiment.command import hydra_command

    FAILS = {
        1: ValueError("a job that cannot be done"),
        2: CertificationRefused("not below 1"),
        3: CertificateStale("other weights"),
        4: TypeError("a bug"),
        99: KeyboardInterrupt(),
    }

    def main(run):
        seed = run.settings.seed
        if seed in FAILS:
            raise FAILS[seed]
        return {"objective": (seed - 7.0) ** 2, "run": str(run.directory)}

    if __name__ == "__main__":
        hydra_command(main)()
"""


@pytest.fixture
def toy(tmp_path):
    (tmp_path / "toy.py").write_text(textwrap.dedent(SCRIPT))

    def start(*arguments):
        return subprocess.run(
            [sys.executable, "toy.py", *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )

    return start


def printed(done):
    lines = done.stdout.splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


@pytest.mark.parametrize(
    ("argument", "status", "line"),
    [
        ("root=Größe", 1, "sfkd_jax: root=Größe: quote the value, 'root=\"Größe\"'"),
        ("seed=1", 1, "sfkd_jax: a job that cannot be done"),
        ("seed=2", 2, "sfkd_jax: refused: not below 1"),
        ("training.batch=0", 1, "sfkd_jax: training.batch must be in [1, inf), got 0"),
    ],
)
def test_an_expected_error_is_one_line_and_an_exit_code(toy, argument, status, line):
    done = toy(argument)
    assert done.returncode == status
    assert done.stderr.strip().splitlines() == [line]
    assert printed(done) == []


def test_a_directory_that_was_deleted_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    with pytest.raises(SystemExit, match="1"):
        hydra_command(dict)()
    assert "this directory was deleted: change to one" in capsys.readouterr().err
    monkeypatch.undo()
    tmp_path.mkdir()


def test_a_failed_job_of_a_sweep_does_not_lose_the_results_of_the_others(toy):
    done = toy("-m", "+experiment=smoke", "training.steps=75,150", "seed=0,1,4,5")
    assert done.returncode == 1
    runs = [document["run"] for document in printed(done)]
    assert len(set(runs)) == len(runs) == 4
    assert {Path(run).name for run in runs} == {"seed=0", "seed=5"}
    assert {Path(run).parts[2] for run in runs} == {
        "training.steps=75",
        "training.steps=150",
    }
    assert "a job that cannot be done" in done.stderr
    assert "a bug" in done.stderr


@pytest.mark.exhaustive
def test_jobs_of_a_sweep_that_differ_in_lists_have_names_that_can_be_read_back(toy):
    done = toy("-m", "model.residual_hidden=[8,8],[16]", "scenario=s1,s3")
    runs = [document["run"] for document in printed(done)]
    assert len(runs) == 4
    assert len(set(runs)) == 2  # a scenario changes no weights
    assert not any(character in run for run in runs for character in "[]'\" ")


@pytest.mark.exhaustive
def test_a_study_searches_and_a_failed_trial_does_not_end_it(toy):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    done = toy(
        "-m",
        "+experiment=tune",
        "hydra.sweeper.n_trials=4",
        "hydra.sweeper.storage=null",
        "seed=choice(1,5,6)",
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert printed(done)


def test_an_interrupted_command_prints_one_line_and_exits_130(toy):
    done = toy("seed=99")
    assert done.returncode == 130
    assert done.stderr == "sfkd_jax: interrupted; the same command continues\n"
