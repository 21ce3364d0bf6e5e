"""What the README and the experiments promise is still so."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.quality.result_pages import PAGES, page_of

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
README = (ROOT / "README.md").read_text("utf-8")
EXPERIMENTS = sorted(
    folder
    for folder in (ROOT / "experiments").iterdir()
    if folder.is_dir() and folder.name != "__pycache__"
)


def within(value, bounds):
    return (bounds[0] is None or value >= bounds[0]) and (
        bounds[1] is None or value <= bounds[1]
    )


def test_the_first_screen_holds_the_two_commands():
    screen = "\n".join(README.splitlines()[:25])
    assert "python -m sfkd_jax.train +experiment=s3" in screen
    assert "pytest -q -n 2" in screen


def test_the_readme_is_short():
    assert len(README.encode()) <= 8 * 1024


def test_the_ratios_to_the_oracle_are_those_of_the_table():
    """Rounded, not cut."""
    rows = json.loads(
        (ROOT / "experiments" / "table1_closed_loop" / "results.json").read_text()
    )["rows"]

    def ratio(vehicle, scenario):
        kind = {"vehicle": vehicle, "scenario": scenario, "sampling": "feedback"}
        chosen = [row for row in rows if kind.items() <= row.items()]
        error = {row["system"]: row["rmse_m"]["mean"] for row in chosen}
        return f"{error['sfkd'] / error['oracle']:.2f}"

    kinematic, dynamic = (
        [ratio(vehicle, scenario) for scenario in ("s1", "s2", "s3")]
        for vehicle in ("kinematic", "dynamic")
    )
    page = (RESULTS / "paper-comparison.md").read_text("utf-8")
    short = " ".join(page.split())
    for one, two, three in (kinematic, dynamic):
        assert f"at {one}, {two} and {three} times the oracle" in short


def test_ci_runs_the_test_command_of_the_readme():
    assert "pytest -q -n 2" in (ROOT / ".ci" / "run").read_text("utf-8")


@pytest.mark.parametrize("folder", EXPERIMENTS, ids=lambda folder: folder.name)
def test_an_experiment_is_a_script_an_expectation_and_a_result_that_meets_it(folder):
    assert os.access(folder / "run.sh", os.X_OK)
    expected = json.loads((folder / "expected.json").read_text())
    rows = json.loads((folder / "results.json").read_text())["rows"]
    for claim in expected.get("claims", []):
        about = [
            row
            for row in rows
            if all(row[name] in wanted for name, wanted in claim["where"].items())
        ]
        assert about, claim
        for row in about:
            for name, limits in claim["bounds"].items():
                assert within(named(row, name), limits), (
                    row["system"],
                    row["scenario"],
                    row["vehicle"],
                    name,
                )
    result = {(row.get("scenario"), row["system"]): row for row in rows}
    for scenario, systems in expected.get("rows", {}).items():
        for system, bounds in systems.items():
            row = result[scenario, system]
            for name, limits in bounds.items():
                assert within(named(row, name), limits), (scenario, system, name)


@pytest.mark.parametrize(
    ("folder", "page"),
    [
        result
        for result in PAGES.values()
        if (ROOT / "experiments" / result[0] / "results.json").exists()
    ],
)
def test_a_page_of_results_says_what_the_results_say(folder, page):
    results = json.loads((ROOT / "experiments" / folder / "results.json").read_text())
    shown = page_of(results, page)
    assert (RESULTS / f"{page}.md").read_text("utf-8") == shown
    linked = {
        (RESULTS / figure).name for figure in re.findall(r"\]\((\S+\.png)\)", shown)
    }
    assert {file.name for file in (RESULTS / f"{page}_files").glob("*.png")} == linked


def test_the_page_about_foreign_plants_says_what_the_results_say():
    command = [sys.executable, "-m", "experiments.commonroad.page"]
    printed = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    page = (RESULTS / "other-cars.md").read_text("utf-8")
    tables = printed.strip().split("\n\n")
    assert len(tables) == 7
    assert [table for table in tables if table not in page] == []


def test_the_ratios_of_adapting_on_foreign_cars_are_those_of_its_run():
    file = ROOT / "experiments" / "commonroad" / "adaptive.json"
    cars = json.loads(file.read_text())["cars"]
    ratios = [
        sum(ours) / sum(nominal)
        for rows in cars.values()
        for ours, nominal in zip(
            rows["SFKD, adaptive"]["after_mm"], rows["nominal"]["after_mm"], strict=True
        )
    ]
    words = f"{min(ratios):.2f} to {max(ratios):.2f} times"
    assert words in README
    assert words in (RESULTS / "index.md").read_text("utf-8")


def named(row, name):
    """A measure by its path; "rmse_m" is its mean."""
    value = row
    for part in name.split("."):
        value = value[int(part) if isinstance(value, list) else part]
    return value["mean"] if isinstance(value, dict) else value


def test_a_low_certified_rate_costs_little_under_the_speed_loop():
    """The curve of experiments/contraction: the lowest rate against the highest, and
    every certificate tight.
    """
    folder = ROOT / "experiments" / "contraction"
    expected = json.loads((folder / "expected.json").read_text())["speed"]
    rows = json.loads((folder / "results.json").read_text())["rows"]
    curve = [
        row
        for row in rows
        if row["inner_loop"] == "speed" and row["beta"] == expected["beta"]
    ]
    highest = max(curve, key=lambda row: row["rho"])
    low = [row for row in curve if row["alpha"] <= expected["alpha"]]
    assert low
    for row in low:
        predicted = (
            row["open_loop"]["position_rmse_m"]
            / highest["open_loop"]["position_rmse_m"]
        )
        driven = named(row["closed_loop"]["s3"], "rmse_m") / named(
            highest["closed_loop"]["s3"], "rmse_m"
        )
        assert within(predicted, expected["prediction_ratio"]), row["run"]
        assert within(driven, expected["rmse_ratio"]), row["run"]
    assert all(1.0 <= row["tightness"] <= expected["tightness"] for row in rows)
    assert all(row["closed_loop"]["s3"]["v0"] == 0.0 for row in rows)
