"""Entries of the leaderboard have the schema, and its page says what they say."""

import copy
import json
import subprocess
import sys

import pytest

from benchmarks.leaderboard import entry as entry_module
from benchmarks.leaderboard import page

ROW = {
    "system": "mine",
    "vehicle": "dynamic",
    "scenario": "s3",
    "sampling": "feedback",
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
RESULTS = {
    "config": {"evaluation": dict(entry_module.PROTOCOL)},
    "rows": [ROW, ROW | {"scenario": "s1"}, ROW | {"system": "oracle"}],
}
ABOUT = {"label": "My model", "by": "Me | others", "code": None, "digest": "0" * 64}


def made(results=RESULTS, **changes):
    return entry_module.entry_of(results, "mine", **ABOUT | changes)


def test_the_page_is_made_of_the_entries():
    text = page.PAGE.read_text("utf-8")
    assert page.page(text) == text


def test_an_entry_repeats_the_results_in_millimetres():
    first, second = made()["results"]
    assert (first["scenario"], second["scenario"]) == ("s3", "s1")
    assert first["rmse_mm"] == pytest.approx(12.3)
    assert first["ci95_mm"] == pytest.approx([11.1, 13.5])
    assert (first["worst_mm"], first["trainings"]) == (pytest.approx(20.1), 3)


def test_a_table_is_ordered_by_the_error_on_s3():
    better = copy.deepcopy(made(label="Better", code="https://example.org"))
    better["results"][0]["rmse_mm"] = 9.0
    without = copy.deepcopy(made(label="Without S3"))
    del without["results"][0]
    lines = page.tables([without, made(), better]).splitlines()
    assert [line.split(" | ")[0] for line in lines if "Me" in line] == [
        "| [Better](https://example.org)",
        "| My model",
        "| Without S3",
    ]
    assert "12.3 (11.1 to 13.5)" in lines[-2]
    assert "Me \\| others" in lines[-2]
    assert page.tables([]) == page.NONE


@pytest.mark.parametrize(
    ("name", "value"), [("seed", 2026), ("episodes", 6), ("episode_s", 15.0)]
)
def test_results_of_other_episodes_are_refused(name, value):
    results = copy.deepcopy(RESULTS)
    results["config"]["evaluation"][name] = value
    with pytest.raises(ValueError, match=f"evaluation.{name}="):
        made(results)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"code": "file:///etc/passwd"}, "code: "),
        ({"label": ""}, "label: "),
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
