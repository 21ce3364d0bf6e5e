"""The tuning of sfkd-bench-2 has one budget for all rows, and chooses what has a score."""

import json

import pytest

from benchmarks.quality import protocol2_tuning as tuning

TRIALS = sorted((tuning.HERE / "protocol2_trials").glob("*/*.json"))


@pytest.mark.parametrize(
    "file", TRIALS, ids=lambda file: f"{file.parent.name}-{file.stem}"
)
def test_no_row_had_more_trials_or_steps_than_another(file):
    document = json.loads(file.read_text())
    assert len(document["trials"]) <= tuning.TRIALS
    assert (document["steps"], document["seed"]) == (tuning.STEPS, tuning.SEED)
    failed = [trial for trial in document["trials"] if trial["score"] is None]
    assert len(failed) <= 2  # a search that mostly fails is not a search


def test_a_row_without_a_score_is_refused():
    trials = [{"overrides": [], "score": score} for score in (None, float("nan"))]
    with pytest.raises(SystemExit, match="no trial of sfkd_path"):
        tuning.chosen({"row": "sfkd_path", "trials": trials})
