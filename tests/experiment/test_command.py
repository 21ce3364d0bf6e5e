"""The command line: errors of one line, sweeps."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from helpers import last_line

from sfkd_jax.experiment.command import hydra_command, print_result

SCRIPT = """
    import json, os, sys
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

    def start(number, arguments):
        # A process of its own, which has imported everything.
        if child := os.fork():
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for stream in (1, 2):
            os.dup2(os.open(f"{number}.{stream}", os.O_CREAT | os.O_WRONLY), stream)
        sys.argv[1:] = arguments
        hydra_command(main)()
        sys.exit()

    if __name__ == "__main__":
        lines = json.loads(sys.argv[1])
        print(json.dumps([start(k, arguments) for k, arguments in enumerate(lines)]))
"""


def started(folder, *lines):
    """How commands end that begin with these arguments: one import for all of them."""
    (folder / "toy.py").write_text(textwrap.dedent(SCRIPT))
    toy = [sys.executable, "toy.py", json.dumps(lines)]
    done = subprocess.run(
        toy, cwd=folder, capture_output=True, text=True, timeout=300, check=True
    )
    return [
        subprocess.CompletedProcess(
            line, code, *((folder / f"{k}.{stream}").read_text() for stream in (1, 2))
        )
        for k, (line, code) in enumerate(zip(lines, last_line(done), strict=True))
    ]


@pytest.fixture
def toy(tmp_path):
    """The command in a process that imports everything itself."""
    return lambda *arguments: started(tmp_path, arguments)[0]


EXPECTED = {
    "root=Größe": (1, "sfkd_jax: root=Größe: quote the value, 'root=\"Größe\"'"),
    "seed=1": (1, "sfkd_jax: a job that cannot be done"),
    "seed=2": (2, "sfkd_jax: refused: not below 1"),
    "seed=3": (3, "sfkd_jax: stale: other weights"),
    "seed=99": (130, "sfkd_jax: interrupted; the same command continues"),
    "training.batch=0": (1, "sfkd_jax: training.batch must be in [1, inf), got 0"),
}
"""The exit status and the line of a command, by its argument."""
SWEEP = ("-m", "+experiment=smoke", "training.steps=75,150", "seed=0,1,4")


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """How these commands and the sweep end."""
    lines = (*((argument,) for argument in EXPECTED), SWEEP)
    ended = started(tmp_path_factory.mktemp("toy"), *lines)
    return dict(zip((*EXPECTED, "sweep"), ended, strict=True))


def printed(done):
    lines = done.stdout.splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


@pytest.mark.parametrize("argument", EXPECTED)
def test_an_expected_error_is_one_line_and_an_exit_code(outcomes, argument):
    done = outcomes[argument]
    assert (done.returncode, done.stderr) == (
        EXPECTED[argument][0],
        f"{EXPECTED[argument][1]}\n",
    )
    assert done.stdout == ""


def test_a_directory_that_was_deleted_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    with pytest.raises(SystemExit, match="1"):
        hydra_command(dict)()
    assert "this directory was deleted: change to one" in capsys.readouterr().err
    monkeypatch.undo()
    tmp_path.mkdir()


def test_a_device_that_is_not_there_is_named(tmp_path):
    command = [sys.executable, "-m", "sfkd_jax.generate", "+experiment=smoke"]
    done = subprocess.run(
        [*command, f"root={tmp_path}"],
        capture_output=True,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "abacus"},
    )
    assert done.returncode == 1
    assert done.stderr.startswith("sfkd_jax: JAX_PLATFORMS=abacus: ")
    assert done.stderr.count("\n") == 1


def test_a_result_that_nobody_reads_is_no_error(monkeypatch):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        print_result({"objective": 1.0})
        # As the interpreter does at its end.
        stdout.flush()


def test_a_failed_job_of_a_sweep_does_not_lose_the_results_of_the_others(outcomes):
    """Nor does an expected error, nor a bug, end the jobs that follow."""
    done = outcomes["sweep"]
    assert done.returncode == 1
    runs = [Path(document["run"]) for document in printed(done)]
    assert [(run.parts[2], run.name) for run in runs] == [
        ("training.steps=75", "seed=0"),
        ("training.steps=150", "seed=0"),
    ]
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
