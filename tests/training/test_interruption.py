"""SIGINT and SIGTERM during training: a checkpoint at once, and the same final weights."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import TINY, dataset, largest_file

from sfkd_jax import store
from sfkd_jax.data import measure_space, random_windows, spread_windows
from sfkd_jax.models import sfkd
from sfkd_jax.training import Checkpoints, fit, multi_step_loss
from sfkd_jax.training._loop import open_log

WORKER = """
import os, sys
sys.path.insert(0, sys.argv[2])
import jax
from pathlib import Path
from training.test_interruption import train
try:
    train(Path(sys.argv[1]))
except KeyboardInterrupt:
    os._exit(130)  # as commands do
"""
EXACT = ("step", "loss", "validation_loss", "learning_rate", "gradient_norm")


def train(directory):
    """The weights after 80 steps and the best step, with few checkpoints."""
    data = dataset()
    space = measure_space(data)
    model, draw = sfkd(space, **TINY), partial(random_windows, batch=16, length=8)
    held_out = spread_windows(data.validation, length=8)
    options = {"steps": 80, "log_every": 5, "save_every": 40}
    return fit(
        model,
        multi_step_loss(model, space),
        draw,
        data.train,
        held_out,
        jax.random.key(3),
        directory,
        **options,
    )


def lines(directory):
    """The log of every step without its times."""
    return [
        {name: line.get(name) for name in EXACT}
        for line in store.read_jsonl(directory / "metrics.jsonl")
    ]


def stopped(directory, number, step):
    """Signal a run that has logged a step; return the time until it exits [s] and its
    status.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", WORKER, str(directory), str(Path(__file__).parents[1])]
    )
    log, patience = directory / "metrics.jsonl", time.monotonic() + 120
    while not (
        log.exists() and any(line["step"] >= step for line in store.read_jsonl(log))
    ):
        assert process.poll() is None
        assert time.monotonic() < patience
        time.sleep(0.005)
    process.send_signal(number)
    sent = time.monotonic()
    return process.wait(60), time.monotonic() - sent


def test_signals_save_a_checkpoint_within_5_s_and_the_end_is_that_of_an_unbroken_run(
    tmp_path,
):
    unbroken, best = train(tmp_path / "unbroken")
    directory = tmp_path / "broken"
    for number, step in ((signal.SIGINT, 10), (signal.SIGTERM, 50)):
        status, seconds = stopped(directory, number, step)
        assert status == 130
        assert seconds < 5.0
        saved = Checkpoints(directory / "checkpoints")
        latest = saved.latest_step()
        saved.close()
        assert latest == lines(directory)[-1]["step"]
        assert latest % 40
    resumed, best_again = train(directory)
    assert jax.tree.all(jax.tree.map(np.array_equal, unbroken, resumed))
    assert best == best_again
    assert lines(directory) == lines(tmp_path / "unbroken")


COMMAND = """
import os, signal, time
from sfkd_jax.experiment.command import hydra_command

def run(settings):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)

hydra_command(run)()
"""


def test_an_interrupted_command_prints_one_line_and_exits_130(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", COMMAND],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 130
    assert done.stderr == "sfkd_jax: interrupted; the same command continues\n"


DAMAGE = {
    "a flipped bit that makes a byte undecodable": lambda line: (
        line[:8] + bytes([line[8] | 0x80]) + line[9:]
    ),
    "a broken line": lambda line: line[: len(line) // 2] + b"\n",
    "a name that changed": lambda line: line.replace(b"step", b"stfp"),
    "no object": lambda line: b"7\n",
}


@pytest.mark.parametrize("damage", list(DAMAGE))
def test_a_damaged_line_is_reported_with_its_number_and_the_others_stay(
    tmp_path, capfd, damage
):
    log = tmp_path / "metrics.jsonl"
    whole = [
        json.dumps({"loss": 1.0, "step": step}).encode() + b"\n"
        for step in (10, 20, 30, 40)
    ]
    log.write_bytes(whole[0] + DAMAGE[damage](whole[1]) + whole[2] + whole[3])
    open_log(log, resumed_at=30)
    assert log.read_bytes() == whole[0] + whole[2]
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{log}: line 2 ")
    assert line.endswith("left out, the other lines stay")


def test_a_log_that_cannot_be_rewritten_stays_and_is_one_line(tmp_path):
    log = tmp_path / "metrics.jsonl"
    text = json.dumps({"loss": 1.0, "step": 10}) + "\n"
    log.write_text(text)
    with (
        largest_file(5),
        pytest.raises(store.ArtefactError, match="File too large"),
    ):
        open_log(log, resumed_at=30)
    assert log.read_text() == text
    assert os.listdir(tmp_path) == ["metrics.jsonl"]
