"""Entries of the leaderboard have the schema, and its page says what they say."""

import copy
import json
import subprocess
import sys
from itertools import product

import pytest

from benchmarks.leaderboard import entry as entry_module
from benchmarks.leaderboard import page
from benchmarks.quality.protocol2_tuning import settings_of
from sfkd_jax.store import ArtefactError

ROW = {
    "system": "mine",
    "vehicle": "dynamic",
    "scenario": "s3",
    "sampling": "law",
    "variation": None,
    "seeds": [0, 1, 2],
    "episodes": 16,
    "params": 1234,
    "rmse_m": {"mean": 0.0123, "ci95": [0.0111, 0.0135]},
    "rmse_episodes_m": [0.0123, 0.0202, 0.0201, 0.0123, 0.02, 0.0123],
    "departures": 1,
    "ratio_to_oracle": 1.2,
    "provenance": {
        "source": "ab" * 32,
        "commit": "c" * 40,
        "version": "1.0",
        "jax": "0.10.2",
        "device": "cpu",
    },
}
WORDS = "model=own model.factory=my_models:mine training=state_model"


def results_of(words=WORDS, rows=None):
    """Results of a comparison along a path with one more row."""
    config = settings_of("+experiment=protocol2_path")
    config["comparison"]["rows"]["mine"] = words
    everywhere = [
        ROW | {"vehicle": vehicle, "scenario": scenario}
        for vehicle, scenario in product(page.VEHICLES, ("s3", "s1", "s2"))
    ]
    oracle = [ROW | {"system": "oracle"}]
    return {"config": config, "rows": oracle + (rows or everywhere)}


RESULTS = results_of()
ABOUT = {"label": "My model", "by": "Me | others", "code": None, "digest": "0" * 64}


def made(results=RESULTS, **changes):
    return entry_module.entry_of(results, "mine", **ABOUT | changes)


def test_the_page_is_made_of_the_entries():
    text = page.PAGE.read_text("utf-8")
    assert page.page(text) == text


def test_an_entry_repeats_the_results_in_millimetres():
    first, second, *_ = made()["results"]
    assert (first["scenario"], second["scenario"]) == ("s3", "s1")
    assert first["rmse_mm"] == pytest.approx(12.3)
    assert first["ci95_mm"] == pytest.approx([11.1, 13.5])
    assert (first["worst_mm"], first["trainings"]) == (pytest.approx(20.1), 3)


def test_a_table_is_ordered_by_the_error_on_s3():
    better = made(label="Better", code="https://example.org")
    better["results"][0]["rmse_mm"] = 9.0
    without = made(label="Without S3")
    del without["results"][0]
    text = page.table_of([without, made(), better], "kinematic", ("law",))
    lines = text.splitlines()
    assert [line.split(" | ")[0] for line in lines if "Me" in line] == [
        "| [Better](https://example.org)",
        "| My model",
        "| Without S3",
    ]
    assert "12.3 (11.1 to 13.5)" in lines[-2]
    assert "Me \\| others" in lines[-2]
    assert page.tables([]) == page.NONE


def test_equal_entries_and_those_without_parameters_have_an_order():
    nothing = made()
    for one in nothing["results"]:
        one["parameters"] = None
    lines = page.table_of([made(), nothing, made()], "dynamic", ("law",)).splitlines()
    assert sum("My model" in line for line in lines) == 3


def test_what_is_not_comparable_has_tables_of_its_own():
    around_feedback = made()
    for one in around_feedback["results"]:
        one["sampling"] = "feedback"
    text = page.tables([made(), around_feedback])
    assert text.count("My model") == text.count("**dynamic, ") * 3 == 6


CHANGED = [
    ("evaluation", "seed", 2026),
    ("evaluation", "episodes", 6),
    ("evaluation", "observation_noise", [0.0] * 7),
    ("vehicle", "dt", 0.2),
    ("scenario", "speed", 1.0),
    ("controller", "horizon", 99),
    ("dataset", "segments", 10**6),
    ("training", "steps", 10**6),
    ("comparison", "older", True),
    ("comparison", "controllers", {"mppi": ["s1"]}),
]


@pytest.mark.parametrize(("group", "name", "value"), CHANGED)
def test_results_of_another_protocol_are_refused(group, name, value):
    results = copy.deepcopy(RESULTS)
    results["config"][group][name] = value
    with pytest.raises(ValueError, match="sfkd-bench-2"):
        made(results)


@pytest.mark.parametrize(
    "words",
    [
        f"{WORDS} evaluation.seed=7",
        f"{WORDS} scenario.speed=5",
        f"{WORDS} controller.mppi.num_samples=9000",
        f"{WORDS} training.steps=40000",
    ],
)
def test_a_row_chooses_its_model_and_its_training_alone(words):
    with pytest.raises(ValueError, match=f"not {words.split()[-1]}"):
        made(results_of(words))
    results = results_of()
    results["config"]["comparison"]["tuned"]["dynamic"]["mine"] = words
    with pytest.raises(ValueError, match=f"not {words.split()[-1]}"):
        made(results)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"episodes": 2}, "has 16 episodes"),
        ({"variation": "8 m/s"}, "no variation"),
        ({"seeds": [0, 0, 0]}, "repeat a training"),
        ({"provenance": ROW["provenance"] | {"source": None}}, "several versions"),
        ({"provenance": ROW["provenance"] | {"source": "cd" * 32}}, "several versions"),
        ({"scenario": "s1"}, "is there twice"),
        ({"rmse_m": {"mean": 0.02, "ci95": [0.0111, 0.0135]}}, "contradict"),
        ({"rmse_episodes_m": [0.001] * 6}, "contradict"),
        ({"rmse_m": {"mean": float("nan"), "ci95": [0.0, 1.0]}}, "contradict"),
        ({"rmse_m": {"mean": float("inf"), "ci95": [0.0, 1.0]}}, "rmse_mm"),
    ],
)
def test_a_row_that_cannot_be_true_is_refused(change, words):
    rows = [row for row in RESULTS["rows"] if row["system"] == "mine"]
    with pytest.raises(ValueError, match=words):
        made(results_of(rows=[rows[0] | change, *rows[1:]]))


def test_plants_and_scenarios_cannot_be_picked():
    rows = [row for row in RESULTS["rows"] if row["system"] == "mine"]
    with pytest.raises(ValueError, match="kinematic s3 was not driven"):
        made(results_of(rows=rows[1:]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"code": "file:///etc/passwd"}, "code: "),
        ({"code": "https://a) <script>"}, "code: "),
        ({"label": ""}, "label: "),
        ({"label": "a\n<!-- end -->"}, "label: "),
        ({"by": "<img onerror=x>"}, "by: "),
        ({"digest": "abc"}, "results_sha256: "),
    ],
)
def test_an_entry_without_the_schema_is_refused_in_one_line(change, words):
    with pytest.raises(ValueError, match=words) as reason:
        made(**change)
    assert len(str(reason.value).splitlines()) == 1


def test_a_bad_file_is_named(tmp_path):
    (tmp_path / "one.json").write_text(json.dumps(made() | {"benchmark": "mine"}))
    with pytest.raises(ValueError, match=r"one\.json: benchmark: "):
        page.entries(tmp_path)
    (tmp_path / "one.json").write_text(json.dumps(made())[:-9])
    with pytest.raises(ArtefactError, match=r"one\.json"):
        page.entries(tmp_path)


def test_the_command_writes_what_the_page_reads(tmp_path):
    (tmp_path / "results.json").write_text(json.dumps(RESULTS))
    out = tmp_path / "entries" / "mine.json"
    command = [sys.executable, "-m", "benchmarks.leaderboard.entry", str(tmp_path)]
    words = ["--label", "My model", "--by", "Me", "--out", str(out)]
    subprocess.run([*command, "mine", *words], check=True, cwd=page.ROOT)
    assert [one["row"] for one in page.entries(out.parent)] == ["mine"]
    refused = subprocess.run(
        [*command, "another", *words], cwd=page.ROOT, capture_output=True, text=True
    )
    assert refused.returncode == 1
    assert "no row another; there are mine, oracle" in refused.stderr
    (tmp_path / "results.json").write_text(json.dumps(RESULTS | {"config": []}))
    refused = subprocess.run(
        [*command, "mine", *words], cwd=page.ROOT, capture_output=True, text=True
    )
    assert len(refused.stderr.splitlines()) == 1
