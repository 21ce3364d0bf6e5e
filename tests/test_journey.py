"""The scripts from a simulator to its corridor type settings that exist."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from composing import settings

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
STAND_IN = """#!{python}
import json, sys
print(json.dumps(sys.argv[1:]))
"""


def commands(tmp_path, script, *words):
    """What a script would run, with a stand-in for python: modules and their words."""
    python = tmp_path / "python"
    python.write_text(STAND_IN.format(python=sys.executable))
    python.chmod(0o755)
    search = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", str(EXPERIMENTS / script), *words],
        env=os.environ | {"PATH": search},
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line)[1:] for line in done.stdout.splitlines()]


def composed(words):
    """Settings of a command, for a simulator that needs no package of others."""
    other = "vehicle.env=tests.driving.plants.simulators:Small"
    return settings(
        *(other if word.startswith("vehicle.env=") else word for word in words)
    )


@pytest.mark.parametrize(
    ("script", "name", "seconds"),
    [("simulator.sh", "highway", (60, 30)), ("slipx.sh", "slipx", (30, 20))],
)
def test_a_journey_trains_drives_and_ends_with_its_line(
    tmp_path, script, name, seconds
):
    typed = ["root=elsewhere", "training.steps=7"]
    full = commands(tmp_path, script, *typed)
    small = commands(tmp_path, script, "--small", *typed)
    for found, duration in zip((full, small), seconds, strict=True):
        train, *evaluate, last = found
        assert last == ["experiments.simulator", "elsewhere", name]
        assert train[0] == "sfkd_jax.train"
        for module, *words in evaluate:
            assert module == "sfkd_jax.evaluate"
            assert f"evaluation.episode_s={duration}" in words
            # What the user types comes last and wins.
            assert words[-2:] == typed
        # All of them drive the policy that the first has made, except for the last one.
        policy = {word for word in train[1:] if not word.startswith("evaluation.")}
        for _, *words in evaluate[:-1]:
            assert policy <= set(words)
    for _, *words in full[:-1]:
        assert composed(words).training.steps == 7
