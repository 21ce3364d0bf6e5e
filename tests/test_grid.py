"""The cells of a comparison, their overrides, and when they are done."""

from pathlib import Path

import numpy as np
import pytest

from sfkd_jax.pipeline import grid
from sfkd_jax.store import source_hash, write_json

PLAN = {
    "vehicles": ["kinematic", "dynamic"],
    "seeds": [0, 1],
    "controllers": {"mppi": ["s1", "s2"], "mppi_plain": ["s1"]},
    "own_controllers": {"program": {"mppi": "koopman_mpc", "mppi_plain": None}},
    "rows": {
        "ours": "model=sfkd",
        "program": "model=koopman_mpc model.environment=false",
    },
    "variations": {"as it is": None, "late": "evaluation.env_sensor.delay_s=0.5"},
    "policies": "table",
    "only": [],
    "untrained": [],
    "trained_once": [],
    "tuned": {},
}


def test_every_row_has_every_scenario_under_each_of_its_controllers():
    result = grid.list_cells(PLAN)
    assert len(result) == len(set(result)) == 2 * 2 * 2 * (3 + 2)
    assert {cell.controller for cell in result if cell.label == "program"} == {
        "koopman_mpc"
    }
    assert {cell.scenario for cell in result if cell.controller == "mppi_plain"} == {
        "s1"
    }


@pytest.mark.parametrize("name", ["untrained", "trained_once"])
def test_a_row_that_is_not_trained_again_has_the_first_seed_alone(name):
    result = grid.list_cells(PLAN | {name: ["ours"]})
    assert {cell.seed for cell in result if cell.label == "ours"} == {0}
    assert {cell.seed for cell in result if cell.label == "program"} == {0, 1}
    with pytest.raises(ValueError, match=rf"unknown comparison\.{name} us"):
        grid.list_cells(PLAN | {name: ["us"]})


def test_what_was_tuned_for_a_vehicle_changes_its_cells_alone():
    tuned = PLAN | {"tuned": {"dynamic": {"ours": "model.rank=24 seed=7"}}}
    for cell in grid.list_cells(tuned):
        more = set(grid.overrides(cell, tuned)) - set(grid.overrides(cell, PLAN))
        is_tuned = (cell.vehicle, cell.label) == ("dynamic", "ours")
        assert more == ({"model.rank=24", "seed=7"} if is_tuned else set())


def test_rows_can_be_picked_and_an_unknown_one_is_named_with_the_choices():
    assert {cell.label for cell in grid.list_cells(PLAN | {"only": ["program"]})} == {
        "program"
    }
    with pytest.raises(
        ValueError, match=r"unknown comparison\.only iocde; choose of ours, program"
    ):
        grid.list_cells(PLAN | {"only": ["iocde"]})


def test_the_cells_of_one_system_are_adjacent():
    groups = grid.group_cells(grid.list_cells(PLAN))
    assert [cell for group in groups for cell in group] == grid.list_cells(PLAN)
    assert len(groups) == 2 * 2 * (2 + 1)


def test_a_cell_composes_its_row_its_controller_and_its_variation():
    cell = grid.Cell("dynamic", "program", 1, "koopman_mpc", "late", "s2")
    options = [
        "vehicle=dynamic",
        "scenario=s2",
        "controller=koopman_mpc",
        "seed=1",
        "model=koopman_mpc",
    ]
    assert grid.overrides(cell, PLAN) == [
        *options,
        "model.environment=false",
        "evaluation.env_sensor.delay_s=0.5",
    ]


def test_a_variation_that_retrains_has_a_policy_of_its_own():
    cell = grid.Cell("dynamic", "ours", 1, "mppi", "10 % of the data", "s2")
    assert grid.policy_name(cell, PLAN, retrained=False) == "table/dynamic/ours"
    assert (
        grid.policy_name(cell, PLAN, retrained=True)
        == "table/dynamic/ours/10_%_of_the_data"
    )


def settings(root, **changes):
    names = (
        "dataset",
        "model",
        "training",
        "seed",
        "controller",
        "scenario",
        "certification",
    )
    options = {name: {"name": name} for name in names} | {
        "vehicle": {"dt": 0.1},
        "evaluation": {"episodes": 4, "episode_s": 30.0, "seed": 1},
    }
    return (
        options
        | {"env_source": "measured", "root": str(root), "name": "table"}
        | changes
    )


LEVELS = {"sfkd": 1.0, "icode": 3.0}
"""Error of the first episode of two rows [m]."""


def rows_file(path):
    return Path(f"{path}.row.json")


def test_a_cell_is_done_only_with_its_own_settings_and_undamaged(tmp_path):
    cell, options = grid.list_cells(PLAN)[0], settings(tmp_path)
    path = grid.cell_path(cell, options)
    assert not grid.is_done(path, options)
    path.parent.mkdir(parents=True)
    write_json(rows_file(path), {"row": {}, "made_with": grid.settings_hash(options)})
    assert grid.is_done(path, options)
    more = options["evaluation"] | {"episodes": 8}
    assert not grid.is_done(path, settings(tmp_path, evaluation=more))
    assert not grid.is_done(path, settings(tmp_path, env_source="estimated"))
    rows_file(path).write_bytes(rows_file(path).read_bytes()[:-5])
    assert not grid.is_done(path, options)


def row(system, level, seed):
    about = {
        "system": system,
        "scenario": "s1",
        "vehicle": "kinematic",
        "sampling": "feedback",
        "variation": None,
    }
    measures = {
        "max_deviation_m": level,
        "departures": 0,
        "ratio_to_oracle": None,
        "difference_to_sfkd": None,
    }
    episodes = [level, 2 * level]
    return (
        about
        | measures
        | {
            "seeds": [seed],
            "rmse_episodes_m": episodes,
            "rmse_m": {"mean": np.mean(episodes)},
        }
    )


def keep(tmp_path, cell, entry, **made_with):
    """A stored cell, made with these changes of its settings."""
    path = grid.cell_path(cell, settings(tmp_path))
    path.parent.mkdir(parents=True, exist_ok=True)
    made = grid.settings_hash(settings(tmp_path, **made_with))
    write_json(rows_file(path), {"row": entry, "made_with": made})


@pytest.mark.parametrize("seeds", [1, 2])
def test_collecting_pools_the_seeds_and_compares_what_is_there(tmp_path, seeds):
    plan = PLAN | {
        "rows": {"sfkd": "", "icode": "", "missing": ""},
        "vehicles": ["kinematic"],
    }
    plan |= {
        "seeds": list(range(seeds)),
        "variations": {"as it is": None},
        "controllers": {"mppi": ["s1"]},
    }
    wanted = grid.list_cells(plan)
    for cell in wanted:
        if cell.label != "missing":
            level = 1.0 if cell.label == "sfkd" else 3.0
            keep(tmp_path, cell, row(cell.label, level, cell.seed))
    result = {
        entry["system"]: entry
        for entry in grid.collect_rows(
            wanted, settings(tmp_path), lambda cell: settings(tmp_path)
        )
    }
    assert set(result) == {"sfkd", "icode"}
    assert result["icode"]["seeds"] == list(range(seeds))
    assert len(result["icode"]["rmse_episodes_m"]) == 2 * seeds
    assert result["icode"]["difference_to_sfkd"]["mean"] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("older", "systems", "message"),
    [
        (False, {"sfkd"}, "left out; comparison.older=true uses them"),
        (True, {"sfkd", "icode"}, ": used"),
    ],
)
def test_a_row_that_was_made_with_other_settings_enters_no_table_unseen(
    tmp_path, capsys, older, systems, message
):
    wanted = [
        grid.Cell("kinematic", label, 0, "mppi", "as it is", "s1")
        for label in ("sfkd", "icode")
    ]
    for cell in wanted:
        of_another = {} if cell.label == "sfkd" else {"controller": "another"}
        keep(tmp_path, cell, row(cell.label, 1.0, 0), **of_another)
    result = grid.collect_rows(
        wanted, settings(tmp_path), lambda cell: settings(tmp_path), older=older
    )
    assert {entry["system"] for entry in result} == systems
    output = capsys.readouterr().err
    assert output.startswith("1 cells were made with other settings, such as")
    assert "icode-seed=0" in output
    assert message in output


def collected(tmp_path, entries, missing=(), **changes):
    """System -> row of a comparison on S1; `changes` are of the settings of icode."""

    def compose(cell):
        return settings(tmp_path, **(changes if cell.label == "icode" else {}))

    cells = []
    for label in [*entries, *missing]:
        cells.append(grid.Cell("kinematic", label, 0, "mppi", "as it is", "s1"))
        if label in entries:
            made = changes if label == "icode" else {}
            keep(tmp_path, cells[-1], entries[label], **made)
    rows = grid.collect_rows(cells, settings(tmp_path), compose)
    return {entry["system"]: entry for entry in rows}


@pytest.mark.parametrize(
    ("changes", "are_paired"),
    [
        ({}, True),
        ({"model": "another"}, True),
        ({"scenario": {"name": "s1", "speed": 5.0}}, False),
        ({"vehicle": {"dt": 0.1, "mass": 1.0}}, False),
        ({"evaluation": {"episodes": 4, "episode_s": 30.0, "seed": 2}}, False),
    ],
)
def test_rows_that_met_other_roads_are_not_paired(tmp_path, changes, are_paired):
    entries = {label: row(label, level, 0) for label, level in LEVELS.items()}
    found = collected(tmp_path, entries, **changes)
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


def test_an_error_that_is_not_finite_is_shown_and_does_not_hide_other_rows(tmp_path):
    entries = {label: row(label, level, 0) for label, level in LEVELS.items()}
    entries["icode"]["rmse_episodes_m"] = [3.0, None]  # as NaN is stored
    found = collected(tmp_path, entries)
    assert found["sfkd"]["rmse_episodes_m"] == [1.0, 2.0]
    assert np.isnan(found["icode"]["difference_to_sfkd"]["mean"])
    assert "p_holm" not in found["icode"]["difference_to_sfkd"]


def test_a_seed_is_not_counted_twice():
    with pytest.raises(ValueError, match=r"comparison\.seeds=\[0, 0\] repeats"):
        grid.list_cells(PLAN | {"seeds": [0, 0]})


def test_every_row_belongs_to_exactly_one_share():
    """Two controllers of one row share its policy: no two processes may train it."""
    groups = grid.group_cells(grid.list_cells(PLAN))
    parts = [grid.take_share(groups, [k, 3]) for k in range(3)]
    assert sorted(str(group) for part in parts for group in part) == sorted(
        map(str, groups)
    )
    policies = [row for part in parts for row in {group[0][:3] for group in part}]
    assert len(policies) == len(set(policies))
    assert grid.take_share(groups, None) == groups
    with pytest.raises(ValueError, match=r"comparison\.share"):
        grid.take_share(groups, [3, 3])


def test_cells_of_other_code_are_used_and_announced(tmp_path, capsys):
    cells = grid.list_cells(PLAN)[:2]
    for cell, source in zip(cells, (source_hash(), "another"), strict=True):
        keep(tmp_path, cell, row("icode", 1.0, 0) | {"provenance": {"source": source}})
    found = grid.collect_rows(
        cells, settings(tmp_path), lambda cell: settings(tmp_path)
    )
    assert len(found) == 2
    assert "1 cells were made by other code" in capsys.readouterr().err
