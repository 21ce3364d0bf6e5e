"""The tuning of sfkd-bench-2 has one budget for all rows, and chooses what has a score."""

import json
from collections import Counter
from itertools import product

import pytest
import yaml

from benchmarks import markdown
from benchmarks.quality import protocol2_page
from benchmarks.quality import protocol2_tuning as tuning
from sfkd_jax.pipeline import grid

ROWS = tuning.trained_rows()


@pytest.mark.parametrize(("vehicle", "label"), [*product(tuning.VEHICLES, ROWS)])
def test_every_row_had_the_same_trials_and_steps(vehicle, label):
    file = tuning.HERE / "protocol2_trials" / vehicle / f"{label}.json"
    document = json.loads(file.read_text())
    assert document["row"] == ROWS[label]
    assert len(document["trials"]) == tuning.TRIALS
    assert (document["steps"], document["seed"]) == (tuning.STEPS, tuning.SEED)
    failed = [trial for trial in document["trials"] if trial["score"] is None]
    assert len(failed) <= 2  # a search that mostly fails is not a search


def test_a_row_without_a_score_is_refused():
    trials = [{"overrides": [], "score": score} for score in (None, float("nan"))]
    with pytest.raises(SystemExit, match="no trial of sfkd_path"):
        tuning.chosen({"row": "sfkd_path", "trials": trials})


def test_the_settings_of_the_table_are_the_winners_of_the_trials():
    """Otherwise a row would be driven with settings that no trial chose."""
    assert yaml.safe_load(tuning.TUNED.read_text())["tuned"] == tuning.winners()


def test_a_part_without_all_its_cells_is_refused():
    comparison = tuning.settings_of("+experiment=protocol2_path")["comparison"]
    cells = grid.list_cells(comparison)
    names = ("vehicle", "system", "controller", "scenario")
    rows = [
        dict(zip(names, row, strict=True)) | {"seeds": [0] * count}
        for row, count in Counter(
            (cell.vehicle, cell.label, cell.controller, cell.scenario) for cell in cells
        ).items()
    ]
    assert protocol2_page.missing("protocol2_path", rows) == []
    assert len(protocol2_page.missing("protocol2_path", rows[1:])) == 1
    two = [row | {"seeds": [0, 1]} if len(row["seeds"]) == 3 else row for row in rows]
    assert protocol2_page.missing("protocol2_path", two) != []


def test_fewer_effective_samples_do_not_help_along_a_path():
    """Otherwise the planner of the path rows, whose samples count alike, is a handicap."""
    file = tuning.HERE / "path_samples.json"
    rows = json.loads(file.read_text("utf-8"))["rows"]
    error = {
        (row["system"], row["variation"]): row["rmse_m"]["mean"]
        for row in rows
        if row["scenario"] == "s3"
    }
    for system in ("oracle", "sfkd_path"):
        others = [error[key] for key in error if key[0] == system and key[1]]
        assert len(others) == 4
        assert error[system, None] < min(others)


def test_what_the_first_pages_say_is_what_the_benchmark_found():
    for page, made in protocol2_page.pages().items():
        text = page.read_text("utf-8")
        assert markdown.filled(text, made) == text


def test_the_bound_does_not_make_the_car_more_accurate():
    """README says so: without it no row is worse with any trainings, and more is won."""
    rows = protocol2_page.rows_of(*protocol2_page.PATH)["sfkd_no_contraction"]
    assert not [
        (vehicle, scenario)
        for vehicle, driven in rows.items()
        for scenario, row in driven.items()
        if protocol2_page.verdict(row) == 1
        and row["difference_to_sfkd"]["ci95"][0] > 0.0
    ]
    marked = [
        row["difference_to_sfkd"]["mean"]
        for driven in rows.values()
        for row in driven.values()
        if protocol2_page.verdict(row)
    ]
    assert sum(marked) < 0.0


@pytest.mark.parametrize(
    ("mean", "p_holm", "side"), [(0.002, 0.04, 1), (-0.002, 0.04, -1), (0.002, 0.06, 0)]
)
def test_a_row_is_better_or_worse_only_after_holms_correction(mean, p_holm, side):
    record = {"mean": mean, "ci95": [mean / 2, 2 * mean], "p_holm": p_holm}
    assert protocol2_page.verdict({"difference_to_sfkd": record}) == side
