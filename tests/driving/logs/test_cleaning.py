"""Runs are cut where they jump and where slow rows are dropped, and never joined."""

import numpy as np
import pytest
from recorded import NAMES, recorded_run, write_csv
from test_files import change, jump, read, refusal, together

STEPS = 10


def segments_of(logged):
    return together(logged.dataset)


def longest_move(states):
    return np.linalg.norm(np.diff(states[..., :2], axis=1), axis=-1).max()


def time_back(columns):
    columns["t"] = columns["t"] - 8.0 * (columns["t"] > 15.05)


def two_jumps(columns):
    jump(columns)
    columns["p_y"] = columns["p_y"] - 40.0 * (columns["t"] > 20.05)


JUMPS = {
    "position": (jump, "line 103: p_x, p_y jump 3.46 m at 5.66 m/s", 2),
    "two positions": (two_jumps, "rows like this", 3),
    "time back": (time_back, "line 153: t goes back from 15 to 7.1", 2),
    "time twice": (change("t", 150, 14.9), "line 152: t repeats 14.9", 2),
    "one row": (change("p_x", 150, 900.0), "(2 rows like this)", 3),
}


@pytest.mark.parametrize("kind", JUMPS)
def test_jumps_refuse_a_run_or_cut_it(tmp_path, kind):
    spoil, message, pieces = JUMPS[kind]
    columns = recorded_run()
    spoil(columns)
    path = write_csv(tmp_path / "a.csv", columns)
    line = refusal(path)
    assert line.startswith(path)
    assert "dataset.columns.run" in line or kind != "time back"
    logged, lines = read(path, split_at_jumps=True)
    (warning,) = (line for line in lines if line.endswith("the run is cut there"))
    assert warning.startswith(f"warning: {path}, line ")
    assert message in warning
    states = segments_of(logged)[0]
    assert 30 - 2 * pieces < len(states) <= 30
    assert longest_move(states) < 0.61  # v ≤ 6 m/s


def test_a_jump_of_yaw_cuts_a_run(tmp_path):
    columns = recorded_run()
    change("yaw", 150, columns["yaw"][150] + 2.5)(columns)
    path = write_csv(tmp_path / "a.csv", columns)
    assert "yaw jumps by" in refusal(path)
    states = segments_of(read(path, split_at_jumps=True)[0])[0]
    assert np.abs(np.diff(states[..., 2], axis=1)).max() < 0.05


def test_without_jumps_cutting_changes_nothing(tmp_path):
    path = write_csv(tmp_path / "a.csv", recorded_run())
    plain, cut = read(path)[0], read(path, split_at_jumps=True, min_speed=1.0)[0]
    for a, b in zip(segments_of(plain), segments_of(cut), strict=True):
        np.testing.assert_array_equal(a, b)


def stop(columns):
    """Half a second at standstill, where yaw, from the course, means nothing."""
    columns["v"] = columns["v"].copy()
    columns["v"][100:105] = 0.0
    columns["yaw"] = columns["yaw"].copy()
    columns["yaw"][100:105] += np.asarray([3.0, -2.0, 1.5, np.nan, 2.0])


def test_slow_rows_are_dropped_and_the_run_is_cut_there(tmp_path):
    columns = recorded_run()
    stop(columns)
    path = write_csv(tmp_path / "a.csv", columns)
    assert "yaw is nan" in refusal(path)
    logged, lines = read(path, min_speed=0.5)
    assert (
        f"warning: {path}, line 102: v is 0 m/s (5 rows like this), "
        "dropped by dataset.min_speed=0.5; the run is cut there"
    ) in lines
    states, controls, _ = segments_of(logged)
    assert len(states) == 9 + 19  # 100 rows are 9 segments, 196 are 19
    assert states[..., 3].min() > 3.9
    # Every segment is a stretch of the recording: no row follows another that it did
    # not follow there.
    recorded = np.stack([columns[name] for name in NAMES[5:7]], axis=1)
    starts = [
        np.flatnonzero((recorded.astype(np.float32) == one[0]).all(axis=1))
        for one in controls
    ]
    for one, start in zip(controls, starts, strict=True):
        (first,) = start
        np.testing.assert_array_equal(
            one, recorded[first : first + STEPS].astype(np.float32)
        )


def test_rows_with_missing_numbers_are_dropped_and_the_run_is_cut_there(tmp_path):
    columns = recorded_run()
    change("yaw", 100, np.nan)(columns)
    path = tmp_path / "a.csv"
    text = (write_csv(path, columns), path.read_text())[1].splitlines()
    cells = text[203].split(",")  # row 202
    text[203] = ",".join([*cells[:5], "", *cells[6:]])
    path.write_text("\n".join(text))
    assert refusal(path).startswith(f"{path}, line 204: steering is empty")
    logged, lines = read(path, missing="drop")
    assert (
        f"warning: {path}, line 102: yaw is nan (2 rows like this), 0.66 % of the "
        "rows, dropped by dataset.missing=drop; the run is cut there"
    ) in lines
    states = segments_of(logged)[0]
    assert len(states) == 9 + 10 + 9  # of 100, 101 and 98 rows
    assert np.isfinite(states).all()
    assert longest_move(states) < 0.61
    assert "must be one of refuse, drop, got 'keep'" in refusal(path, missing="keep")


def test_a_run_that_is_slow_throughout_is_left_out(tmp_path):
    slow = recorded_run(phase=0.5) | {"v": np.full(301, 0.1)}
    write_csv(tmp_path / "slow.csv", slow)
    write_csv(tmp_path / "fast.csv", recorded_run())
    logged, lines = read(tmp_path, min_speed=0.5)
    assert len(segments_of(logged)[0]) == 30
    assert any("(301 rows like this)" in line for line in lines)


def test_both_parts_of_a_cut_run_stay_in_one_part_of_the_data(tmp_path):
    """Neighbours in time resemble each other, whatever is between them."""
    for k in range(8):
        columns = recorded_run(seconds=10.0, phase=0.3 * k)
        columns["p_x"] = columns["p_x"] + 100.0 * (columns["t"] > 5.05)
        write_csv(tmp_path / f"{k}.csv", columns)
    logged, lines = read(tmp_path, split_at_jumps=True)
    assert not any("too few runs" in line for line in lines)
    assert sum(logged.dataset.runs.values()) == 8


def test_cut_runs_still_have_their_units_checked(tmp_path):
    columns = recorded_run()
    jump(columns)
    columns["v"] = 3.6 * columns["v"]
    path = write_csv(tmp_path / "a.csv", columns)
    assert "km/h" in refusal(path, split_at_jumps=True)
