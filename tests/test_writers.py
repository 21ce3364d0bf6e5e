"""Several processes write into one directory: locks, and no lost rows or episodes."""

import re
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from sfkd_jax import store
from sfkd_jax.driving import simulation
from sfkd_jax.experiment import run_directory
from sfkd_jax.store import DirectoryLocked, locked

ROW = {
    "system": "sfkd", "scenario": "s3", "vehicle": "kinematic", "inner_loop": "none", "controller": "mppi",
    "planner": "mppi", "sampling": "feedback", "env": "measured",
}  # fmt: skip
HOLD = """
    import sys, time
    from pathlib import Path
    from sfkd_jax.store import locked
    with locked(Path(sys.argv[1])):
        print("held", flush=True)
        time.sleep(float(sys.argv[2]))
"""


def started(program, *arguments):
    """A process that runs a program; its first line of output means that it is ready."""
    command = [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    )
    assert process.stdout.readline().strip()
    return process


def keep(run_dir, row, value=0.0):
    arrays = {"lateral": np.full((2, 40), float(value)), "dt": np.asarray(0.1)}
    run_directory.write_results(run_dir, {}, [(row, arrays)], 0.0)


# ---- the lock


def test_a_locked_directory_is_refused_at_once_and_the_message_names_the_process(
    tmp_path,
):
    holder = started(HOLD, tmp_path, 60)
    began = time.monotonic()
    with pytest.raises(DirectoryLocked) as caught, locked(tmp_path):
        pass
    assert time.monotonic() - began < 5.0
    holder.kill()
    holder.wait()
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{tmp_path}: process {holder.pid} on ")
    assert re.search(
        r"\(python -c .*since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d\+00:00\) is writing there",
        line,
    )


def test_a_waiting_process_prints_a_message_and_gets_the_lock(tmp_path, capfd):
    holder = started(HOLD, tmp_path, 3.0)
    with locked(tmp_path, wait=True):
        assert holder.wait(10) == 0
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"waiting: {tmp_path}: process {holder.pid} on ")


def test_a_lock_is_reentrant_in_its_process(tmp_path):
    with locked(tmp_path):
        with locked(tmp_path / "." / ""):
            pass
        process = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(HOLD), str(tmp_path), "0"],
            capture_output=True,
            text=True,
        )
        assert "is writing there" in process.stderr
    assert started(HOLD, tmp_path, 0).wait() == 0


# ---- rows and episodes


WRITER = """
    import sys, time
    sys.path.insert(0, sys.argv[3])
    from pathlib import Path
    from test_writers import ROW, keep
    run_dir, me = Path(sys.argv[1]), int(sys.argv[2])
    print("ready", flush=True)
    begins = float(sys.stdin.readline())
    for number in range(5):
        time.sleep(max(0.0, begins + 0.3 * number + 0.02 * me - time.time()))
        keep(run_dir, ROW | {"system": f"writer{me}", "scenario": f"road{number}"}, 10 * me + number)
"""


def test_two_processes_20_ms_after_each_other_lose_no_row_and_no_episode(tmp_path):
    writers = [started(WRITER, tmp_path, me, Path(__file__).parent) for me in (0, 1)]
    begins = time.time() + 0.5
    for writer in writers:
        writer.communicate(f"{begins}\n", timeout=120)
        assert writer.returncode == 0
    rows = store.read_json(tmp_path / "results.json")["rows"]
    assert {(row["system"], row["scenario"]) for row in rows} == {
        (f"writer{me}", f"road{number}") for me in (0, 1) for number in range(5)
    }
    assert len(rows) == 10
    for row in rows:
        value = 10 * int(row["system"][-1]) + int(row["scenario"][4:])
        arrays, _ = store.read_arrays(tmp_path / row["arrays"], kind="episodes")
        assert np.all(arrays["lateral"] == value)


@pytest.mark.parametrize("name", list(ROW))
def test_rows_that_differ_in_one_part_of_their_identity_are_two(name):
    other = ROW | {name: "other"}
    assert simulation.merge([ROW], [other]) == [ROW, other]
    assert simulation.merge([ROW], [dict(ROW)]) == [ROW]
    assert simulation.identity(ROW) != simulation.identity(other)
