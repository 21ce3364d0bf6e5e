"""10^4 changed files are read correctly or refused in one line that names them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ENGINE = Path(__file__).with_name("fuzzing.py")


@pytest.mark.exhaustive
def test_no_changed_file_is_misread_hangs_or_takes_memory():
    command = [sys.executable, str(ENGINE), "--cases", "10000", "--seed", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.stdout, done.stderr[-2000:]
    result = json.loads(done.stdout)
    assert result["faults"] == []
    assert result["cases"] >= 9_900
    assert result["memory_MiB"]["grown_by"] < 1024
    for name, counts in result["readers"].items():
        assert 0.2 < counts["refused"] / counts["cases"] < 0.99, name
        assert counts["accepted"] >= 5, name
