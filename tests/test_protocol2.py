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
    settings = tuning.composed("runs", "any", vehicle, ROWS[label], [])
    planned = tuning.trials_of(tuning.space_of(settings))
    assert tuning.stored(file, ROWS[label], planned) == document["trials"]
    assert len(document["trials"]) == tuning.TRIALS
    failed = [trial for trial in document["trials"] if trial["score"] is None]
    assert len(failed) <= 2  # a search that mostly fails is not a search


@pytest.mark.parametrize(
    "change",
    [
        {"row": "model=other"},
        {"steps": 10},
        {"seed": 1},
        {"trials": [{"overrides": ["model.rank=99"], "score": 0.0}]},
    ],
)
def test_trials_of_another_search_are_not_continued(tmp_path, change):
    file = tmp_path / "sfkd.json"
    planned = [[], ["model.rank=8"]]
    trials = {"trials": [{"overrides": [], "score": 1.0}]}
    document = tuning.about("model=sfkd") | trials
    file.write_text(json.dumps(document))
    assert tuning.stored(file, "model=sfkd", planned) == trials["trials"]
    file.write_text(json.dumps(document | change))
    with pytest.raises(SystemExit, match="another row, budget or search"):
        tuning.stored(file, "model=sfkd", planned)


def test_a_row_without_a_score_is_refused():
    trials = [{"overrides": [], "score": score} for score in (None, float("nan"))]
    with pytest.raises(SystemExit, match="no trial of sfkd_path"):
        tuning.chosen({"row": "sfkd_path", "trials": trials})


def test_the_settings_of_the_table_are_the_winners_of_the_trials():
    """Otherwise a row would be driven with settings that no trial chose."""
    assert yaml.safe_load(tuning.TUNED.read_text())["tuned"] == tuning.winners()


def document_of(part, seeds, labels=None, once=()):
    """Results of a part that lack nothing, driven with these trainings and rows.

    Rows in `once` are trained once although the protocol asks for more.
    """
    settings = tuning.settings_of(f"+experiment={part}")
    settings["comparison"] |= {
        "seeds": seeds,
        "trained_once": [*settings["comparison"]["trained_once"], *once],
    }
    names = ("vehicle", "system", "controller", "scenario")
    cells = Counter(
        (cell.vehicle, cell.label, cell.controller, cell.scenario)
        for cell in grid.list_cells(settings["comparison"])
        if labels is None or cell.label in labels
    )
    rows = [
        dict(zip(names, cell, strict=True)) | {"seeds": seeds[:count]}
        for cell, count in cells.items()
    ]
    return {"config": settings, "rows": rows}


def test_a_row_without_all_its_cells_is_refused():
    part = "protocol2_path"
    whole = document_of(part, [0, 1, 2])
    assert protocol2_page.missing(part, whole) == []
    rows = whole["rows"]
    assert len(protocol2_page.missing(part, whole | {"rows": rows[1:]})) == 1
    two = [row | {"seeds": [0, 1]} if len(row["seeds"]) == 3 else row for row in rows]
    assert protocol2_page.missing(part, whole | {"rows": two}) != []


def test_a_part_may_stop_after_its_first_trainings_or_rows_and_says_so(monkeypatch):
    part = "protocol2"
    some = document_of(part, [0], ["oracle", "sfkd", "icode"])
    assert protocol2_page.missing(part, some) == []
    monkeypatch.setattr(protocol2_page, "document_of", lambda _: some)
    said = protocol2_page.with_left("- Bullets.", part)
    assert "ICODE-MPPI" in said
    assert "SFKD − contraction" in said
    assert "1 of 3" in said
    whole = document_of(part, [0, 1, 2])
    monkeypatch.setattr(protocol2_page, "document_of", lambda _: whole)
    assert protocol2_page.with_left("- Bullets.", part) == "- Bullets."


def test_a_row_may_be_trained_once_only_if_the_results_say_so(monkeypatch):
    part, row = "protocol2", "icode_mppi_extrinsic"
    some = document_of(part, [0, 1, 2], once=[row])
    assert protocol2_page.missing(part, some) == []
    monkeypatch.setattr(protocol2_page, "document_of", lambda _: some)
    assert "Trained once so far, not 3 times: ICODE-MPPI" in protocol2_page.left(part)
    whole = document_of(part, [0, 1, 2])
    assert protocol2_page.missing(part, some | {"config": whole["config"]}) != []
    assert protocol2_page.missing(part, whole | {"config": some["config"]}) != []


@pytest.mark.parametrize("seeds", [[], [1], [0, 2], [0, 1, 2, 3]])
def test_trainings_cannot_be_picked(seeds):
    """Otherwise a part could be told from the trainings that went well."""
    document = document_of("protocol2", seeds or [0])
    document["config"]["comparison"]["seeds"] = seeds
    with pytest.raises(SystemExit, match="not the first"):
        protocol2_page.missing("protocol2", document)


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("evaluation", "seed", 2026),
        ("evaluation", "observation_noise", []),
        ("comparison", "older", True),
    ],
)
def test_results_of_another_protocol_are_refused(group, name, value):
    document = document_of("protocol2", [0])
    document["config"][group][name] = value
    with pytest.raises(SystemExit, match="not driven as"):
        protocol2_page.missing("protocol2", document)


def test_a_part_without_the_oracle_is_refused():
    document = document_of("protocol2", [0], ["sfkd", "icode"])
    with pytest.raises(SystemExit, match="no row of SFKD or of the oracle"):
        protocol2_page.missing("protocol2", document)


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


def test_what_brings_accuracy_is_what_the_first_page_says():
    """Observing e everywhere but on dynamic S2; no other part by more than 0.3 mm."""
    body = protocol2_page.rows_of(*protocol2_page.BODY)
    path = protocol2_page.rows_of(*protocol2_page.PATH)

    def worse_without(driven):
        return {
            (vehicle, scenario): 1e3 * row["difference_to_sfkd"]["mean"]
            for vehicle, one in driven.items()
            for scenario, row in one.items()
            if protocol2_page.apart(row) == 1
        }

    places = {
        (vehicle, scenario)
        for vehicle, one in body["sfkd_no_fiber"].items()
        for scenario in one
    }
    assert places - {("dynamic", "s2")} == {*worse_without(body["sfkd_no_fiber"])}
    for row, most in (
        (body["sfkd_no_transport"], 0.0),
        (body["sfkd_no_residual"], 0.35),
        (body["sfkd_no_contraction"], 0.1),
        (path["sfkd_no_contraction"], 0.1),
    ):
        assert max(worse_without(row).values(), default=0.0) <= most


@pytest.mark.parametrize(
    ("part", "vehicle"),
    [(protocol2_page.PATH, "kinematic"), (protocol2_page.BODY, "dynamic")],
)
def test_every_training_is_worse_than_every_one_without_the_bound_where_they_differ_most(
    part, vehicle
):
    rows = protocol2_page.rows_of(*part)
    (said,) = protocol2_page.trainings(rows, protocol2_page.SHORT)
    assert f"{vehicle} S2" in said
    bound, free = (
        rows[row][vehicle]["s2"]["rmse_trainings_m"]
        for row in ("sfkd", "sfkd_no_contraction")
    )
    assert len(bound) == len(free) == 3
    assert max(free) < min(bound)


@pytest.mark.parametrize("seeds", [[0], [0, 1]])
def test_trainings_are_told_apart_only_if_there_are_several(seeds):
    row = {"seeds": seeds, "rmse_trainings_m": [0.001, 0.002] if seeds[1:] else None}
    rows = {"sfkd": {"dynamic": {"s2": row, "s3": row}}}
    said = protocol2_page.trainings(rows, protocol2_page.SHORT)
    assert bool(said) == bool(seeds[1:])
    assert all("dynamic S2 [mm]: 1.0, 2.0; 0 of" in bullet for bullet in said)


@pytest.mark.parametrize(
    ("mean", "p_holm", "side"), [(0.002, 0.04, 1), (-0.002, 0.04, -1), (0.002, 0.06, 0)]
)
def test_a_row_is_better_or_worse_only_after_holms_correction(mean, p_holm, side):
    record = {"mean": mean, "ci95": [mean / 2, 2 * mean], "p_holm": p_holm}
    assert protocol2_page.verdict({"difference_to_sfkd": record}) == side
