"""The tuning of sfkd-bench-2 has one budget for all rows, and chooses what has a score."""

import json
from itertools import product

import pytest
import yaml

from benchmarks.quality import protocol2_tuning as tuning

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
