"""What is told of a training: to a person, and to the libraries that draw losses."""

import sys

import composing
import pytest
import wandb

from sfkd_jax.experiment.command import named_for_sweep
from sfkd_jax.experiment.loggers import FOLDER, LOGGERS, logger
from sfkd_jax.progress import Progress

METRICS = [(50, {"loss": 2.0, "alpha": 0.9}), (100, {"loss": 1.0, "alpha": 0.8})]


def told(name, directory):
    """Tell a logger of a training, and return the bytes of all its files."""
    with logger(name, directory, {"steps": 100}) as callback:
        for step, metrics in METRICS:
            callback(step, metrics)
    files = [path for path in (directory / FOLDER).rglob("*") if path.is_file()]
    return b"".join(path.read_bytes() for path in files)


def test_tensorboard_gets_all_metrics(tmp_path):
    written = told("tensorboard", tmp_path)
    assert b"loss" in written
    assert b"alpha" in written


def test_wandb_gets_all_metrics_offline(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    logged = []
    log = wandb.Run.log

    def spied(run, metrics, *, step):
        logged.append((step, metrics))
        log(run, metrics, step=step)

    monkeypatch.setattr(wandb.Run, "log", spied)
    told("wandb", tmp_path)
    assert logged == METRICS
    assert len([*(tmp_path / FOLDER).rglob("*.wandb")]) == 1


def test_no_logger_writes_nothing_and_another_is_named(tmp_path):
    assert told(None, tmp_path) == b""
    with pytest.raises(ValueError, match="one of tensorboard, wandb, got 'mlflow'"):
        logger("mlflow", tmp_path, {})


@pytest.mark.parametrize(
    ("name", "library"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")]
)
def test_a_library_that_is_missing_is_named_with_its_extra(
    name, library, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, library, None)
    with (
        pytest.raises(ValueError, match=rf"pip install 'sfkd-jax\[{name}\]'"),
        logger(name, tmp_path, {}),
    ):
        pass


@pytest.mark.parametrize("name", LOGGERS)
def test_a_logger_changes_neither_a_run_nor_its_name(name):
    plain = composing.run("+experiment=smoke")
    logged = composing.run("+experiment=smoke", f"training.logger={name}")
    assert logged.settings.training.logger == name
    assert logged.identity == plain.identity
    assert named_for_sweep(logged.settings).name == plain.settings.name


def test_progress_counts_what_was_done_before_and_says_what_is_left(capfd, monkeypatch):
    now = 100.0
    monkeypatch.setattr("sfkd_jax.progress.time.monotonic", lambda: now)
    with Progress("training", 4000, 1000) as progress:
        progress.advance(0, "begins")
        now = 129.0
        progress.advance(500)  # no line yet: half a minute has not passed
        now = 130.0
        progress.advance(500)
        now = 160.0
        progress.advance(1000, "loss 1")
    first, second, third = capfd.readouterr().err.splitlines()
    assert "training 1,000 / 4,000, ? left: begins" in first
    assert "training 2,000 / 4,000, 1:00 left" in second
    # 2000 steps in a minute.
    assert "training 3,000 / 4,000, 0:30 left: loss 1" in third


def test_on_a_terminal_progress_is_a_bar(capfd, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with Progress("training", 4) as progress:
        progress.advance(2, "loss 1")
        progress.advance(2)
    shown = capfd.readouterr().err
    assert "training: 100%" in shown
    assert "loss 1" in shown
