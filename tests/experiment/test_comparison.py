"""The cells of a comparison: which there are, when they are done, what is collected."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from composing import run, settings

from sfkd_jax.experiment import command, comparing
from sfkd_jax.experiment.run_directory import provenance
from sfkd_jax.settings import replace
from sfkd_jax.store import write_json

LEVELS = {"sfkd": 1.0, "icode": 3.0}
"""Error of the first episode of two rows [m]."""


@cache
def plan():
    return replace(
        settings().comparison,
        vehicles=["kinematic", "dynamic"],
        seeds=[0, 1],
        controllers={"mppi": ["s1", "s2"], "mppi_plain": ["s1"]},
        own_controllers={"program": {"mppi": "koopman_mpc", "mppi_plain": None}},
        rows={"ours": "model=sfkd", "program": "model=koopman_mpc seed=3"},
        policies="table",
    )


def cells(**changes):
    return comparing.list_cells(replace(plan(), **changes))


def test_every_row_has_every_scenario_under_each_of_its_controllers():
    found = cells()
    assert len(found) == len(set(found)) == 2 * 2 * (3 + 2)
    assert {c.controller for c in found if c.label == "program"} == {"koopman_mpc"}
    assert {c.scenario for c in found if c.controller == "mppi_plain"} == {"s1"}
    groups = comparing.group_cells(found)
    assert [cell for group in groups for cell in group] == found
    assert len(groups) == 2 * 2 * (2 + 1)


PUBLISHED = [
    path.stem
    for path in sorted(Path(command.conf_path(), "experiment").glob("*.yaml"))
    if "comparison" in path.read_text("utf-8")
]
"""Experiments that compare rows."""


@cache
def representatives():
    """Few cells, by experiment: a composition takes a third of a second.

    Together they have every row as tuned for each vehicle, and of every experiment
    every vehicle, controller and scenario.
    """
    parts = {}
    for name in PUBLISHED:
        comparison = settings(f"+experiment={name}").comparison
        for cell in comparing.list_cells(comparison):
            words = comparing.overrides(cell, comparison)
            of_the_row = tuple(words[4:])
            own = (name, cell.vehicle), (name, cell.controller), (name, cell.scenario)
            parts[name, *words] = {of_the_row, *own}
    missing = set().union(*parts.values())
    chosen = {name: [] for name in PUBLISHED}
    while missing:
        name, *words = best = max(parts, key=lambda cell: len(parts[cell] & missing))
        missing -= parts[best]
        chosen[name].append(words)
    return chosen


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_row_of_every_comparison_composes(name):
    for words in representatives()[name]:
        settings(f"+experiment={name}", *words)


def test_a_row_that_is_not_trained_again_has_the_first_seed_alone():
    found = cells(one_seed=["ours"])
    assert {cell.seed for cell in found if cell.label == "ours"} == {0}
    assert {cell.seed for cell in found if cell.label == "program"} == {0, 1}


def test_every_row_belongs_to_exactly_one_share():
    """Two controllers of one row share its policy: no two processes may train it."""
    groups = comparing.group_cells(cells())
    parts = [comparing.take_share(groups, (k, 3)) for k in range(3)]
    assert sorted(group for part in parts for group in part) == sorted(groups)
    policies = [row for part in parts for row in {group[0][:3] for group in part}]
    assert len(policies) == len(set(policies))
    assert comparing.take_share(groups, None) == groups
    with pytest.raises(ValueError, match=r"comparison\.share"):
        comparing.take_share(groups, (3, 3))


def rows_file(path):
    return Path(f"{path}.row.json")


def test_a_cell_is_done_only_with_its_own_settings_and_undamaged(tmp_path):
    path, chosen = cells()[0].path(tmp_path), run()
    assert not comparing.is_done(path, chosen)
    made = comparing.settings_hash(chosen)
    path.parent.mkdir(parents=True)
    write_json(rows_file(path), {"row": {}, "made_with": made})
    assert comparing.is_done(path, chosen)
    assert not comparing.is_done(path, run("evaluation.episodes=9"))
    assert not comparing.is_done(path, run("environment.sensor.delay_s=0.5"))
    assert not comparing.is_done(path, run("training.steps=50"))
    rows_file(path).write_bytes(rows_file(path).read_bytes()[:-5])
    assert not comparing.is_done(path, chosen)


def row(system, level, seed):
    episodes = [level, 2 * level]
    return {
        "system": system,
        "scenario": "s1",
        "vehicle": "kinematic",
        "sampling": "feedback",
        "max_deviation_m": level,
        "departures": 0,
        "ratio_to_oracle": None,
        "difference_to_sfkd": None,
        "seeds": [seed],
        "rmse_episodes_m": episodes,
        "rmse_m": {"mean": np.mean(episodes)},
    }


def keep(tmp_path, cell, entry, made):
    """A stored cell, made with these settings."""
    path = cell.path(tmp_path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        rows_file(path), {"row": entry, "made_with": comparing.settings_hash(made)}
    )


def collected(tmp_path, entries, missing=(), changes=()):
    """System -> row of a comparison on S1; `changes` are of the settings of icode."""

    def compose(cell):
        return run(*(changes if cell.label == "icode" else ()))

    listed = []
    for label in [*entries, *missing]:
        listed.append(comparing.Cell("kinematic", label, 0, "mppi", "s1"))
        if label in entries:
            keep(tmp_path, listed[-1], entries[label], compose(listed[-1]))
    rows = comparing.collect_rows(listed, tmp_path, compose)
    return {entry["system"]: entry for entry in rows}


@pytest.mark.parametrize("seeds", [1, 2])
def test_collecting_pools_the_seeds_and_compares_what_is_there(tmp_path, seeds):
    wanted = cells(
        rows={"sfkd": None, "icode": None, "missing": None},
        own_controllers={},
        vehicles=["kinematic"],
        seeds=list(range(seeds)),
        controllers={"mppi": ["s1"]},
    )
    for cell in wanted:
        if cell.label != "missing":
            entry = row(cell.label, LEVELS[cell.label], cell.seed)
            keep(tmp_path, cell, entry, run())
    rows = comparing.collect_rows(wanted, tmp_path, lambda cell: run())
    found = {entry["system"]: entry for entry in rows}
    assert set(found) == {"sfkd", "icode"}
    assert found["icode"]["seeds"] == list(range(seeds))
    assert len(found["icode"]["rmse_episodes_m"]) == 2 * seeds
    assert found["icode"]["difference_to_sfkd"]["mean"] == pytest.approx(3.0)


def test_a_row_that_was_made_with_other_settings_or_code_is_announced(tmp_path, capsys):
    listed = [
        comparing.Cell("kinematic", label, 0, "mppi", "s1")
        for label in ("sfkd", "icode", "nominal")
    ]
    sources = (provenance(), provenance(), {"commit": "another"})
    for cell, source in zip(listed, sources, strict=True):
        made = run("seed=9") if cell.label == "icode" else run()
        entry = row(cell.label, 1.0, 0) | {"provenance": source}
        keep(tmp_path, cell, entry, made)
    rows = comparing.collect_rows(listed, tmp_path, lambda cell: run())
    assert {entry["system"] for entry in rows} == {"sfkd", "nominal"}
    said = capsys.readouterr().err
    assert "1 cells were made by other settings: left out" in said
    assert "icode-seed=0" in said
    assert "1 cells were made by other code" in said


@pytest.mark.parametrize(
    ("changes", "are_paired"),
    [((), True), (("scenario.speed=5.0",), False), (("evaluation.seed=2",), False)],
)
def test_rows_that_met_other_roads_are_not_paired(tmp_path, changes, are_paired):
    entries = {label: row(label, level, 0) for label, level in LEVELS.items()}
    found = collected(tmp_path, entries, changes=changes)
    assert (found["icode"]["difference_to_sfkd"] is not None) == are_paired


def test_an_unfinished_comparison_marks_no_more_than_the_finished_one(tmp_path):
    """Rows that are still to be driven count in Holm's correction."""
    entries = {label: row(label, level, 0) for label, level in LEVELS.items()}
    for number, entry in enumerate(entries.values()):
        entry["rmse_episodes_m"] = [1.0 + number, 1.1 + number, 1.3 + 1.1 * number]
    alone = collected(tmp_path / "a", entries)["icode"]["difference_to_sfkd"]
    more = collected(tmp_path / "b", entries, [f"row{k}" for k in range(9)])
    beside = more["icode"]["difference_to_sfkd"]
    assert beside["p"] == alone["p"] < 0.01
    assert alone["p_holm"] == pytest.approx(alone["p"])
    assert beside["p_holm"] == pytest.approx(10 * alone["p"])
