"""SIGINT and SIGTERM during training: a checkpoint at once, and the same final weights."""

import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np
from helpers import TINY, dataset

from sfkd_jax import store
from sfkd_jax.data import measure_space, random_windows, spread_windows
from sfkd_jax.models import sfkd
from sfkd_jax.training import Checkpoints, fit, multi_step_loss

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
