"""The script that drives a comparison with a process per core leaves none behind."""

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "experiments" / "on_every_core.sh"
STAND_IN = """#!{python}
import os, sys, time
words = sys.argv[1:]
if words[0] == "-c":
    print(0, 0)  # two shares, also on a machine with one core
elif any("share" in word for word in words):
    open("share-%d" % os.getpid(), "w").close()
    time.sleep(float(os.environ["SLEEP"]))
    sys.exit(int(os.environ["STATUS"]))
elif "sfkd_jax.compare" in words:
    open("collected", "w").close()
"""


def started(tmp_path, sleep=0, status=0):
    """The script with a stand-in for python that only waits, as its own group."""
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text(STAND_IN.format(python=sys.executable))
    python.chmod(0o755)
    search = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    about = {"PATH": search, "SLEEP": str(sleep), "STATUS": str(status)}
    return subprocess.Popen(
        ["bash", str(SCRIPT), "table1"],
        cwd=tmp_path,
        env=os.environ | about,
        start_new_session=True,
        # Where the tests run in the background it is ignored, and so by what they start.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        stderr=subprocess.PIPE,
        text=True,
    )


def shares(tmp_path):
    return [int(file.name.partition("-")[2]) for file in tmp_path.glob("share-*")]


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


pytestmark = pytest.mark.skipif(
    shutil.which("taskset") is None or shutil.which("nvidia-smi") is not None,
    reason="one process is started without taskset, or with an accelerator",
)


def test_stopping_it_stops_every_process(tmp_path):
    """A job in the background ignores Ctrl-C; two runs of it would share their cells."""
    script = started(tmp_path, sleep=600)
    end = time.monotonic() + 120
    while len(shares(tmp_path)) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    os.killpg(script.pid, signal.SIGINT)
    script.wait(timeout=120)
    assert script.returncode == 130
    assert len(shares(tmp_path)) == 2
    assert not [pid for pid in shares(tmp_path) if is_running(pid)]
    assert not (tmp_path / "collected").exists()


@pytest.mark.parametrize(("status", "collects"), [(0, True), (1, False)])
def test_a_process_that_fails_is_not_passed_over(tmp_path, status, collects):
    script = started(tmp_path, status=status)
    _, said = script.communicate(timeout=120)
    assert script.returncode == status
    assert (tmp_path / "collected").exists() == collects
    assert ("the same command continues" in said) == bool(status)
