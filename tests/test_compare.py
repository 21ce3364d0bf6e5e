"""A table, cell by cell."""

import json

from helpers import last_line, run_command

from sfkd_jax import plants
from sfkd_jax.pipeline import comparison

SMALL = ("training.steps=75", "training.save_every=75", "dataset.segments=200")
COMPARED = (
    "+experiment=smoke",
    "comparison=tiny",
    "evaluation.systems=[self]",
    "name=table",
    *SMALL,
)


def test_compare_evaluates_every_row_and_continues_where_it_stopped(tmp_path):
    first = last_line(run_command("compare", *COMPARED, cwd=tmp_path))
    document = json.loads((tmp_path / first["results"]).read_text())
    rows = {row["system"]: row for row in document["rows"]}
    assert set(rows) == {"oracle", "sfkd"}
    assert document["failed"] == {}
    assert rows["sfkd"]["difference_to_sfkd"] is None
    assert rows["oracle"]["difference_to_sfkd"]["mean"] < 0
    assert set(rows["sfkd"]["open_loop_rmse_m"]) == {"1", "5", "10", "20"}
    assert (tmp_path / first["report"]).exists()
    stored = tmp_path / "runs/table/cells"
    before = {file: file.read_bytes() for file in stored.rglob("*.row.json")}
    (victim,) = (file for file in before if "oracle" in file.name)
    victim.write_bytes(before[victim][:-9])
    again = run_command("compare", *COMPARED, cwd=tmp_path)
    assert "training" not in again.stderr
    after = {file: file.read_bytes() for file in stored.rglob("*.row.json")}
    remade, first_made = (json.loads(rows.pop(victim)) for rows in (after, before))
    assert after == before
    for document in (remade, first_made):
        assert document["row"].pop("provenance")["source"]
    assert remade == first_made


def test_rows_that_cannot_be_made_are_named_and_the_others_come_out(tmp_path):
    done = run_command(
        "compare",
        *COMPARED,
        "model.frame=boddy",
        "+comparison.rows.mistyped='training.step=3'",
        cwd=tmp_path,
    )
    assert last_line(done)["rows"] == 1
    assert last_line(done)["failed"] == 2
    assert "segment" in done.stderr
    assert "row mistyped: unknown setting training.step" in done.stderr


def test_a_row_that_could_not_be_certified_is_refused_before_it_is_trained(tmp_path):
    done = run_command("compare", *COMPARED, "certification.mode=boxes", cwd=tmp_path)
    assert last_line(done)["failed"] == 1
    assert "certification.mode" in done.stderr
    assert "training" not in done.stderr.replace("training.", "")


def test_episodes_are_made_once_for_all_rows_and_again_for_another_protocol():
    env_sensor = {"delay_s": 0.0, "noise": [0.0, 0.0], "bias": [0.0, 0.0]}
    protocol = {
        "episodes": 2,
        "episode_s": 2.0,
        "seed": 1,
        "env_sensor": env_sensor,
        "variation": None,
    }
    options = {
        "vehicle": {"name": "kinematic"},
        "scenario": {"name": "s1"},
        "evaluation": protocol,
    }
    make_episodes, plant = comparison.cached_episodes(), plants.kinematic()
    first, second = (
        make_episodes(options | {"model": {"name": model}}, plant)
        for model in ("sfkd", "icode")
    )
    assert second is first
    others = [
        {"evaluation": protocol | {"seed": 2}},
        {"scenario": {"name": "s3"}},
        {"vehicle": {"name": "other"}},
    ]
    assert (
        len(
            {id(make_episodes(options | other, plant)) for other in others}
            | {id(first)}
        )
        == 4
    )
