"""What the README and the experiments promise is still so."""

import json
import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
EXPERIMENTS = sorted(folder for folder in (ROOT / "experiments").iterdir() if folder.is_dir())


def within(value, bounds):
    return (bounds[0] is None or value >= bounds[0]) and (bounds[1] is None or value <= bounds[1])


def test_the_first_screen_holds_the_two_commands():
    screen = "\n".join(README.splitlines()[:25])
    assert "python -m sfkd_jax.train +experiment=s3" in screen
    assert "pytest -q -n 2" in screen


def test_ci_runs_the_test_command_of_the_readme():
    assert "pytest -q -n 2" in (ROOT / ".ci" / "run").read_text("utf-8")


def test_every_relative_link_and_named_file_exists():
    names = re.findall(r"\]\(([^)#:]+)\)", README) + re.findall(r"`(\w+\.md|docs/[\w./-]+)`", README)
    assert [name for name in names if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("folder", EXPERIMENTS, ids=lambda folder: folder.name)
def test_an_experiment_is_a_script_an_expectation_and_a_result_that_meets_it(folder):
    assert os.access(folder / "run.sh", os.X_OK)
    expected = json.loads((folder / "expected.json").read_text())
    rows = json.loads((folder / "results.json").read_text())["rows"]
    found = {(row["scenario"], row["system"]): row for row in rows}
    for scenario, systems in expected["rows"].items():
        for system, bounds in systems.items():
            row = found[scenario, system]
            assert within(row["rmse_m"]["mean"], bounds["rmse_m"]), (scenario, system)
            assert within(row["ratio_to_oracle"], bounds["ratio_to_oracle"]), (scenario, system)
