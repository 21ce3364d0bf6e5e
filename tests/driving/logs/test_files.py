"""Recorded runs are read without loss, implausible ones refused in one line."""

import re
import zipfile

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from recorded import NAMES, STATE, recorded_run, write_csv, write_npz

from sfkd_jax.driving.logs import Columns, fingerprint, from_logs
from sfkd_jax.driving.logs._tables import read_csv

DT, STEPS = 0.1, 10


def read(path, columns=None, **options):
    """The data set of some logs, and every line that was reported."""
    lines = []
    options = {"report": lines.append} | options
    options = {"dt": DT, "wheelbase": 2.7, "steps": STEPS} | options
    return from_logs(str(path), columns or Columns(), **options), lines


def refusal(path, columns=None, **options):
    """Why logs are refused: one line."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        read(path, columns, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def together(dataset):
    """Every segment of a data set, whatever part it went to."""
    parts = (dataset.train, dataset.validation, dataset.calibration, dataset.test)
    return [
        np.concatenate([np.asarray(getattr(part, name)) for part in parts])
        for name in ("states", "controls", "envs")
    ]


def expected(columns, steps=STEPS):
    """The same run cut by hand: positions from the segment's first."""
    rows = [slice(k, k + steps + 1) for k in range(0, len(columns["t"]) - steps, steps)]
    states = np.stack(
        [np.column_stack([columns[name] for name in STATE])[row] for row in rows]
    )
    states[..., :2] -= states[:, :1, :2]
    cut = [
        np.stack(
            [np.column_stack([columns[n] for n in names])[row][:-1] for row in rows]
        )
        for names in (NAMES[5:7], NAMES[7:])
    ]
    return [part.astype(np.float32) for part in (states, *cut)]


def same_segments(result, wanted):
    """Whether two sets of segments are the same in some order, to the last bit."""
    order = [
        np.lexsort(part[0].reshape(len(part[0]), -1).T) for part in (result, wanted)
    ]
    return all(
        np.array_equal(a[order[0]], b[order[1]])
        for a, b in zip(result, wanted, strict=True)
    )


@pytest.mark.parametrize("kind", [",", "\t", " ", "npz", "parquet"])
def test_a_run_comes_back_to_the_last_bit(tmp_path, kind):
    columns = recorded_run()
    if kind == "npz":
        # An array of objects cannot be read without running code.
        others = {"camera": np.zeros((3, 4)), "meta": np.array({"car": "A"})}
        write_npz(tmp_path / "a.npz", columns | others)
    elif kind == "parquet":
        parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    else:
        write_csv(tmp_path / "a.csv", columns, kind)
    assert same_segments(together(read(tmp_path)[0].dataset), expected(columns))
    if kind == ",":  # what nobody asked for stays in the file
        assert list(read_csv(tmp_path / "a.csv", ["v", "t"]).columns) == ["t", "v"]


def test_whole_runs_as_x_u_e_come_back_to_the_last_bit(tmp_path):
    runs = [recorded_run(seconds=1.0, phase=0.3 * k) for k in range(12)]
    file = stacked(runs, tmp_path)
    with np.load(file) as opened:
        np.savez(file, **opened, meta=np.array({"car": "A"}))
    wanted = [np.concatenate(parts) for parts in zip(*map(expected, runs), strict=True)]
    logged, lines = read(tmp_path / "a.npz")
    assert same_segments(together(logged.dataset), wanted)
    assert not [line for line in lines if "too few runs" in line]


def test_a_column_tells_runs_in_one_file_apart(tmp_path):
    runs = [recorded_run(seconds=5.0, phase=0.3 * k) for k in range(8)]
    joined = {name: np.concatenate([one[name] for one in runs]) for name in NAMES}
    labels = np.repeat(np.arange(8), 51)
    write_csv(tmp_path / "a.csv", joined | {"run": labels})
    wanted = [np.concatenate(parts) for parts in zip(*map(expected, runs), strict=True)]
    assert same_segments(
        together(read(tmp_path, Columns(run="run"))[0].dataset), wanted
    )


def test_an_unknown_environment_becomes_a_constant(tmp_path):
    columns = {
        name: values for name, values in recorded_run().items() if name not in NAMES[7:]
    }
    write_csv(tmp_path / "a.csv", columns)
    logged, _ = read(tmp_path, needs_environment=False)
    assert together(logged.dataset)[2].shape == (30, STEPS, 2)
    assert not together(logged.dataset)[2].any()
    assert logged.coverage["environment"] == {}
    assert np.all(np.asarray(logged.dataset.env_high) >= 1e6)  # nothing can be outside


@pytest.mark.parametrize("period", [0.01, 0.03])
def test_resampling_interpolates_states_and_averages_controls(tmp_path, period):
    recorded = recorded_run(period=period)
    # It wraps around at ±π.
    recorded["yaw"] = np.mod(recorded["yaw"] + 3.0 + np.pi, 2 * np.pi) - np.pi
    turned = np.cos(3.0), np.sin(3.0)
    x, y = recorded["p_x"], recorded["p_y"]
    recorded |= {
        "p_x": turned[0] * x - turned[1] * y,
        "p_y": turned[1] * x + turned[0] * y,
    }
    write_csv(tmp_path / "a.csv", recorded)
    states, controls, _ = together(read(tmp_path)[0].dataset)
    t = recorded["t"]
    moments = DT * np.arange(len(states) * STEPS)
    speed = np.sort(np.interp(moments, t, recorded["v"]).astype(np.float32))
    np.testing.assert_allclose(np.sort(states[:, :-1, 3].ravel()), speed, rtol=1e-6)
    fine = np.arange(round(t[-1] / 1e-3)) * 1e-3 + 5e-4
    held = recorded["steering"][np.searchsorted(t, fine, side="right") - 1]
    mean = held[: 100 * len(moments)].reshape(-1, 100).mean(axis=1)
    np.testing.assert_allclose(
        np.sort(controls[..., 0].ravel()), np.sort(mean), rtol=0, atol=1e-6
    )
    steps = np.diff(states[..., 2], axis=1)
    # |d yaw / dt| ≤ 0.36: no turn by 2π between two moments
    assert np.abs(steps).max() < 0.37 * DT


def test_commands_that_are_logged_with_jitter_explain_the_next_state(tmp_path):
    """Rows are up to 30 ms off the grid; each command acts from its row on."""
    rng = np.random.default_rng(0)
    columns = recorded_run()
    times = DT * np.arange(301) + rng.uniform(0.0, 0.03, 301)
    states = {n: np.interp(times, columns["t"], columns[n]) for n in NAMES[1:4]}
    pushes = 0.3 * rng.choice([-1.0, 1.0], 301)
    gained = np.concatenate([[0.0], np.cumsum(pushes[:-1] * np.diff(times))])
    columns |= states | {"t": times, "v": 5.0 + gained, "acceleration": pushes}
    speed = 5.0 + np.concatenate(
        [
            [0.0],
            np.cumsum(0.5 * (columns["v"][1:] + columns["v"][:-1]) * np.diff(times)),
        ]
    )
    columns |= {"p_x": speed, "p_y": 0.0 * speed, "yaw": 0.0 * speed}
    write_csv(tmp_path / "a.csv", columns)
    states, controls, _ = together(read(tmp_path)[0].dataset)
    gained = np.diff(states[..., 3], axis=1)
    np.testing.assert_allclose(gained, DT * controls[..., 1], atol=2e-6)


def test_a_gap_splits_a_run_and_nothing_is_invented_in_it(tmp_path):
    columns = recorded_run()
    saved = (columns["t"] <= 10.0 + 1e-9) | (columns["t"] >= 20.0 - 1e-9)
    path = write_csv(
        tmp_path / "a.csv", {name: values[saved] for name, values in columns.items()}
    )
    logged, lines = read(path)
    assert (
        f"warning: {path}, line 103: 10 s without rows; runs are split there" in lines
    )
    states = together(logged.dataset)[0]
    assert len(states) == 20
    moved = np.linalg.norm(np.diff(states[..., :2], axis=1), axis=-1)
    assert moved.max() < 0.61  # v ≤ 6 m/s


def test_moments_of_a_clock_and_places_on_earth_lose_no_digits(tmp_path):
    columns = recorded_run()
    here = expected(columns)
    moved = columns | {
        "t": columns["t"] + 1.7e9,
        "p_x": columns["p_x"] + 4.5e5,
        "p_y": columns["p_y"] + 5.3e6,
    }
    write_csv(tmp_path / "a.csv", moved)
    there = together(read(tmp_path)[0].dataset)
    order = [np.lexsort(part[1].reshape(len(part[1]), -1).T) for part in (here, there)]
    np.testing.assert_allclose(there[0][order[1]], here[0][order[0]], atol=1e-5)


def change(name, row, value):
    def spoil(columns):
        columns[name] = columns[name].copy()
        columns[name][row] = value

    return spoil


def scale(name, how):
    return lambda columns: columns.update({name: how(columns[name])})


def swap(one, other):
    return lambda columns: columns.update({one: columns[other], other: columns[one]})


def jump(columns):
    columns["p_x"] = columns["p_x"] + 3.0 * (columns["t"] > 10.05)


def stale(columns):
    held = np.arange(301) // 10 * 10
    columns.update({name: columns[name][held] for name in ("p_x", "p_y")})


def bursts(columns):
    """Five rows at a time, stamped on arrival 1 ms apart."""
    rows = np.arange(301)
    columns["t"] = 0.5 * (rows // 5) + 1e-3 * (rows % 5)


def late(names, steps):
    """The columns come some rows after the others."""

    def shift(columns):
        for name, values in columns.items():
            kept = slice(0, -steps) if name in names else slice(steps, None)
            columns[name] = values[kept]

    return shift


def back_and_forth(columns):
    """Half of the run, then the same way in reverse."""
    rows = np.append(np.arange(151), np.arange(150)[::-1])
    columns |= {name: columns[name][rows] for name in NAMES[1:]}
    columns["v"] = np.where(np.arange(301) > 150, -1.0, 1.0) * columns["v"]


def unsigned(columns):
    back_and_forth(columns)
    columns["v"] = np.abs(columns["v"])


def straight(columns):
    travelled = 0.1 * np.cumsum(columns["v"]) - 0.05 * columns["v"]
    small = {"yaw": 1e-3 * columns["yaw"], "steering": 1e-3 * columns["steering"]}
    columns |= small | {"p_x": travelled, "p_y": 0.0 * travelled}


def on_earth(write, *axes):
    """Positions in UTM, some axes written as float32."""

    def spoil(columns):
        for axis, far in (("p_x", 5e5), ("p_y", 4.5e6)):
            values = columns[axis] + far
            if axis in axes:
                values = np.asarray([float(write(np.float32(x))) for x in values])
            columns[axis] = values

    return spoil


WRONG = {
    "northing in float32": (
        on_earth(float, "p_y"),
        ", lines 2 to 302: p_y has a resolution of 0.5 m; log positions as float64",
    ),
    "easting in float32": (
        on_earth("{:.2f}".format, "p_x"),
        ", lines 2 to 302: p_x has a resolution of 0.031 m",
    ),
    "nan": (
        change("yaw", 7, np.nan),
        ", line 9: yaw is nan; dataset.missing=drop leaves such rows out",
    ),
    "infinite": (change("steering", 100, np.inf), ", line 102: steering is inf"),
    "degrees": (
        scale("yaw", np.rad2deg),
        ", lines 2 to 302: yaw and the direction of travel differ; yaw is probably in degrees",
    ),
    "clockwise": (scale("yaw", np.negative), "yaw probably counts clockwise"),
    "compass": (
        scale("yaw", lambda yaw: np.pi / 2 - yaw),
        "yaw is probably a compass heading (from north, clockwise)",
    ),
    "km/h": (
        scale("v", lambda v: 3.6 * v),
        "0.278 times as fast as v; the speed is probably in km/h",
    ),
    "milliseconds": (scale("t", lambda t: 1e3 * t), "time is probably in ms"),
    "centimetres": (
        lambda c: c.update(p_x=100 * c["p_x"], p_y=100 * c["p_y"]),
        "positions are probably in cm",
    ),
    "unsigned": (unsigned, "the robot moves against the sign of v (14"),
    "late positions": (
        late(("p_x", "p_y"), 3),
        "the lag of p_x, p_y behind v is 0.3 s (3 steps of vehicle.dt)",
    ),
    "late speed": (late("v", 2), "the lag of p_x, p_y behind v is -0.2 s (-2 steps"),
    "late yaw": (
        late(("yaw",), 3),
        "the lag of yaw behind the direction of travel is 0.27 s (2.7 steps",
    ),
    "swapped controls": (
        swap("steering", "acceleration"),
        "yaw follows acceleration (correlation 1.00), not steering (0.",
    ),
    "yaw and v": (
        swap("yaw", "v"),
        "yaw fits as the speed: have columns changed places?",
    ),
    "p_x and p_y": (swap("p_x", "p_y"), "or p_x and p_y changed places"),
    "p_x and v": (swap("p_x", "v"), "wrong units, or columns changed places?"),
    "standing": (scale("v", np.zeros_like), "v stands still while the position moves"),
    "stale": (
        stale,
        ", line 3: the position of the row before at 5.07 m/s (270 rows like this)",
    ),
    "no excitation": (
        scale("steering", np.zeros_like),
        ", lines 2 to 302: steering is always 0; without excitation",
    ),
    "slow": (
        lambda c: c.update({n: c[n][::3] for n in NAMES}),
        "recorded every 0.3 s, slower than vehicle.dt=0.1",
    ),
    "short": (
        lambda c: c.update({n: c[n][:8] for n in NAMES}),
        "the longest run without a gap has 7 steps, a segment 10",
    ),
    "few": (
        lambda c: c.update({n: c[n][:21] for n in NAMES}),
        "2 segments are too few for dataset.shares=",
    ),
    "no friction": (
        change("friction", slice(100, 105), -1.0),
        ", line 102: friction is -1, not a measured value (5 rows like this)",
    ),
    "no wind": (
        change("wind", slice(100, 105), 9999.0),
        ", line 102: wind is 9999, not a measured value (5 rows like this)",
    ),
    "no steering": (
        change("steering", slice(100, 105), -9999.0),
        ", line 102: steering is -9999, not a measured value (5 rows like this); leave",
    ),
    "a yaw of half its size": (
        scale("yaw", lambda yaw: 0.5 * yaw),
        ", lines 2 to 302: the direction of travel turns 2 times as much as yaw; has",
    ),
    "bursts": (
        bursts,
        ", lines 2 to 302: rows come in bursts, most of them 0.001 s after the row "
        "before and the others 0.5 s; log when a row was measured",
    ),
    "missing": (
        lambda c: c.pop("yaw"),
        "no column yaw among t, p_x, p_y, v, steering, acceleration, friction, wind; map it with dataset.columns.state",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_cannot_be_right_is_one_line_with_its_place(tmp_path, kind):
    spoil, message = WRONG[kind]
    columns = recorded_run()
    spoil(columns)
    line = refusal(write_csv(tmp_path / "a.csv", columns))
    assert message in line
    if kind not in ("short", "few"):  # of all files together
        assert line.startswith(f"{tmp_path / 'a.csv'}")


TEXTS = {
    "empty": ("", ": the file is empty"),
    "no header": (
        "0,1,2\n1,2,3\n",
        ", line 1: numbers where the names of the columns should be",
    ),
    "a logger alone": (
        '"Format","MoTeC CSV File"\n\n' + "0," * 8 + "0\n",
        f", line 1 is no header: 2 cells above rows of 9, and no line has one of the "
        f"names {', '.join(NAMES)}; set dataset.columns",
    ),
    "twice": ("t,t\n0,1\n", ", line 1: the column t appears twice"),
    "ragged": (
        ",".join(NAMES) + "\n" + "0," * 8 + "0\n0,1,2\n",
        ", line 3: 3 cells below a header of 9",
    ),
    "empty cell": (
        ",".join(NAMES) + "\n" + "0," * 8 + "0\n1,,0,0,0,0,0,0,0\n",
        ", line 3: p_x is empty, not a number; dataset.missing=drop leaves such rows out",
    ),
    "word": (
        ",".join(NAMES) + "\n" + "0," * 8 + "off\n",
        ", line 2: wind is 'off', not a number",
    ),
}


def with_commas(text):
    return text.replace(",", ";").replace(".", ",")


RECORDERS = {
    "a mark": lambda text: text.encode("utf-8-sig"),
    "Windows-1252": lambda text: text.replace("yaw", "yaw_°").encode("cp1252"),
    "decimal commas": lambda text: with_commas(text).encode(),
    "line ends of Windows": lambda text: text.replace("\n", "\r\n").encode(),
    "a preamble": lambda text: f"Recorder 3.1\nrun 7, dry\n\n{text}".encode(),
    "a logger's head": lambda text: f"# logger X1, t in s\n#v 2\n{text}".encode(),
    "a header of numpy": lambda text: f"# {text}".encode(),
    "comments": lambda text: f"# made by us\n{text}# the end\n\n".encode(),
}


@pytest.mark.parametrize("kind", RECORDERS)
def test_a_run_comes_back_from_what_recorders_write(tmp_path, kind):
    columns = recorded_run()
    text = (tmp_path / "a.csv", write_csv(tmp_path / "a.csv", columns))[0].read_text()
    (tmp_path / "a.csv").write_bytes(RECORDERS[kind](text))
    yaw = "yaw_°" if kind == "Windows-1252" else "yaw"
    logged, _ = read(tmp_path, Columns(state=("p_x", "p_y", yaw, "v")))
    assert same_segments(together(logged.dataset), expected(columns))


def test_lines_are_counted_as_an_editor_counts_them(tmp_path):
    head = f"Recorder 3.1\n\n# dry\n{';'.join(NAMES)}\n"
    body = "0;" * 8 + "0\n# pause\n" + "1,5;" * 8 + "off\n"
    (tmp_path / "a.csv").write_text(head + body)
    assert refusal(tmp_path).endswith("line 7: wind is 'off', not a number")


ARRAYS = {
    "objects": (
        {"t": np.array([None, 1])},
        "a.npz: not a readable npz file (Object arrays",
    ),
    "shapes": ({"t": np.zeros(3), "p_x": np.zeros(4)}, "p_x has shape (4,), t (3,)"),
    "x alone": (
        {"x": np.zeros((2, 5, 4)), "u": np.zeros((2, 5, 2)), "e": np.zeros((2, 4, 2))},
        "u must be numbers of shape (2, 4, 2), got float64 (2, 5, 2)",
    ),
    "states": (
        {"x": np.zeros((2, 5, 3)), "u": np.zeros((2, 4, 2)), "e": np.zeros((2, 4, 2))},
        "x must be numbers of shape (2, 5, 4), got float64 (2, 5, 3)",
    ),
    "no e": (
        {"x": np.zeros((2, 5, 4)), "u": np.zeros((2, 4, 2))},
        "or pass environment.source=none",
    ),
}


@pytest.mark.parametrize("kind", [*TEXTS, *ARRAYS])
def test_a_malformed_file_is_one_line_with_its_place(tmp_path, kind):
    content, message = (TEXTS | ARRAYS)[kind]
    if kind in ARRAYS:
        assert message in refusal(write_npz(tmp_path / "a.npz", content))
    else:
        (tmp_path / "a.csv").write_text(content)
        assert refusal(tmp_path / "a.csv") == f"{tmp_path / 'a.csv'}{message}"


def test_an_array_that_no_memory_holds_is_one_line(tmp_path):
    """A header may claim any size: 500 bytes, 73 TiB."""
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name in NAMES:
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array_header_1_0(entry, header)
    assert "a.npz: not a readable npz file (Unable to" in refusal(tmp_path / "a.npz")


def test_every_refused_file_is_reported(tmp_path):
    for name, row in (("a", 3), ("b", 8)):
        columns = recorded_run(phase=row)
        change("yaw", row, np.nan)(columns)
        write_csv(tmp_path / f"{name}.csv", columns)
    lines = []
    with pytest.raises(ValueError, match=r"yaw is nan; .* \(the first of 2 findings\)"):
        read(tmp_path, report=lines.append)
    assert len(lines) == 1
    assert re.search(r"[ab]\.csv, line (5|10): yaw is nan;", lines[0])


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("???", "dataset.path is not set"),
        ("nowhere.csv", "no such file or folder, and no file matches it"),
        ("*.csv", "no such file or folder, and no file matches it"),
        (".", "no .csv, .npz, .parquet in this folder"),
        ("notes.txt", "unknown kind of log"),
    ],
)
def test_a_path_that_means_no_logs_is_refused(tmp_path, monkeypatch, path, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("")
    assert message in refusal(path)


def test_files_that_are_left_out_are_named_in_a_line(tmp_path):
    write_csv(tmp_path / "a.csv", recorded_run())
    assert not [line for line in read(tmp_path)[1] if "left out" in line]
    for name in ("b.csv.gz", "c.txt", "d.log", ".hidden.txt"):
        (tmp_path / name).write_bytes(b"")
    (line,) = [line for line in read(tmp_path)[1] if "left out" in line]
    assert line == (
        f"warning: {tmp_path}: 3 files are left out, since they are no .csv, .npz, "
        ".parquet: b.csv.gz, c.txt, d.log"
    )


@pytest.mark.parametrize(("most", "said"), [(0.03, False), (0.06, True)])
def test_times_that_jitter_are_uneven(tmp_path, most, said):
    columns = recorded_run()
    delays = np.random.default_rng(0).uniform(0.0, most, 301)
    columns["t"] = columns["t"] + delays
    _, lines = read(write_csv(tmp_path / "a.csv", columns))
    assert any("uneven sampling" in line for line in lines) == said


def test_contents_decide_which_data_set_it_is(tmp_path):
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
    write_csv(tmp_path / "here" / "a.csv", recorded_run())
    write_csv(tmp_path / "there" / "renamed.csv", recorded_run())
    first, moved = (fingerprint(str(tmp_path / folder)) for folder in ("here", "there"))
    write_csv(tmp_path / "here" / "a.csv", recorded_run(phase=0.1))
    assert first == moved != fingerprint(str(tmp_path / "here"))
    write_csv(tmp_path / "there" / "twice.csv", recorded_run())
    assert "the same numbers as" in refusal(tmp_path / "there")


def elsewhere(columns):
    """The same numbers by another clock, from another origin."""
    shifts = {"t": 500.0, "p_x": 3e5, "p_y": 5e6, "yaw": 0.0}
    return columns | {name: columns[name] + by for name, by in shifts.items()}


def overlapping(columns):
    longer = recorded_run(seconds=60.0)
    return elsewhere({name: longer[name][250:] for name in NAMES})


def stacked(runs, folder):
    x, u, e = (
        np.stack([np.column_stack([one[n] for n in names])[:end] for one in runs])
        for names, end in ((STATE, None), (NAMES[5:7], -1), (NAMES[7:], -1))
    )
    return write_npz(folder / "a.npz", {"x": x, "u": u, "e": e})


COPIES = {
    "text": ("a.csv, lines 2 to 302", "b.csv, lines 2 to 302"),
    "npz": ("a.csv, lines 2 to 302", "b.npz, rows 0 to 300"),
    "part": ("a.csv, lines 252 to 302", "b.npz, rows 0 to 50"),
    "labels": ("run 0, lines 2 to 302", "run 2, lines 604 to 904"),
    "stacked": ("run 0, rows 0 to 300", "run 2, rows 0 to 300"),
}


@pytest.mark.parametrize("how", COPIES)
def test_the_same_run_twice_is_found_by_its_numbers(tmp_path, how):
    columns, other, options = recorded_run(), recorded_run(phase=0.4), {}
    if how == "stacked":
        stacked([columns, other, elsewhere(columns)], tmp_path)
    elif how == "labels":
        parts = [columns, other, elsewhere(columns)]
        joined = {n: np.concatenate([part[n] for part in parts]) for n in columns}
        write_csv(tmp_path / "a.csv", joined | {"run": np.repeat(np.arange(3), 301)})
        options = {"columns": Columns(run="run")}
    else:
        write_csv(tmp_path / "a.csv", columns)
        text = (tmp_path / "a.csv").read_text().replace("\n", "\r\n")
        if how == "text":
            (tmp_path / "b.csv").write_text(text)
        else:
            copy = elsewhere(columns) if how == "npz" else overlapping(columns)
            write_npz(tmp_path / "b.npz", copy)
    line = refusal(tmp_path, **options)
    assert all(part in line for part in COPIES[how]), line
    assert ": the same numbers as " in line


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (Columns(environment=("friction", "v")), "dataset.columns names v twice"),
        (Columns(environment=()), "pass environment.source=none"),
    ],
)
def test_invalid_columns_are_refused(tmp_path, columns, message):
    assert message in refusal(write_csv(tmp_path / "a.csv", recorded_run()), columns)


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (scale("steering", np.negative), {}, "the robot turns against steering"),
        (late(("p_x", "p_y"), 1), {}, "behind v is 0.1 s (1 steps of vehicle.dt)"),
        (late(NAMES[1:5], 1), {}, "the lag of v behind acceleration is 0.05 s (0.5"),
        (straight, {}, "yaw turns by 0.014 degrees a second (root"),
        (scale("steering", np.sign), {}, "steering takes only 2 values"),
        (scale("yaw", lambda yaw: yaw + 1.0), {}, "differ by -1.00 rad throughout"),
        (
            scale("t", lambda t: t),
            {"wheelbase": 0.3},
            "suggest a wheelbase of 2.7 m, vehicle.wheelbase is 0.3",
        ),
        (
            scale("t", lambda t: t),
            {"limits": ((-0.1, -1.0), (0.1, 1.0))},
            "outside the range from -0.1 to 0.1 of vehicle.control_low",
        ),
    ],
)
def test_oddities_are_warned_of(tmp_path, spoil, options, message):
    columns = recorded_run()
    spoil(columns)
    _, lines = read(write_csv(tmp_path / "a.csv", columns), **options)
    assert any(
        line.startswith(f"warning: {tmp_path}") and message in line for line in lines
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (scale("steering", np.rad2deg), "yaw follows steering 0.0"),
        (scale("steering", np.negative), "yaw follows steering -"),
        (scale("acceleration", lambda a: a / 9.81), "v follows acceleration 9.8"),
        (scale("friction", lambda mu: 100 * mu), "friction is 60 to "),
    ],
)
def test_one_run_of_many_in_another_unit_is_warned_of(tmp_path, spoil, message):
    for number in range(8):
        columns = recorded_run(phase=0.3 * number)
        write_csv(tmp_path / f"{number}.csv", columns)
    assert not [line for line in read(tmp_path)[1] if "warning" in line]
    spoil(columns)
    path = write_csv(tmp_path / "7.csv", columns)
    (line,) = [line for line in read(tmp_path)[1] if "warning" in line]
    assert line.startswith(f"warning: {path}, lines 2 to 302: {message}")


def test_a_wind_that_is_constant_in_every_run_is_no_missing_value(tmp_path):
    for number, wind in enumerate((-6.0, 0.1, 0.1, 0.1)):
        columns = recorded_run(phase=0.3 * number)
        columns["wind"] = np.full(301, wind)
        write_csv(tmp_path / f"{number}.csv", columns)
    dataset = read(tmp_path)[0].dataset
    np.testing.assert_array_equal(dataset.env_low[1], -6.0)


@pytest.mark.parametrize(
    ("name", "role", "refused"),
    [
        ("friction", None, True),
        ("friction", "other", False),
        ("grip", None, False),
        ("grip", "friction", True),
        ("load", "mass", True),
    ],
)
def test_what_cannot_be_negative_is_stated_and_not_read_from_a_name(
    tmp_path, name, role, refused
):
    columns = recorded_run()
    columns[name] = columns.pop("friction")
    change(name, slice(100, 105), -0.2)(columns)
    path = write_csv(tmp_path / "a.csv", columns)
    names = Columns(environment=(name, "wind"))
    roles = {} if role is None else {"env_roles": (role, "side_force")}
    if refused:
        line = refusal(path, names, **roles)
        assert f"line 102: {name} is -0.2, not a measured value" in line
    else:
        assert read(path, names, **roles)[0].dataset.env_low[0] == np.float32(-0.2)


def test_a_yaw_rate_shows_a_late_yaw_and_driving_backwards_is_right(tmp_path):
    columns = recorded_run()
    columns["rate"] = 0.36 * np.cos(0.4 * columns["t"])
    names = Columns(state=(*STATE, "rate"))
    late(("yaw",), 2)(columns)
    line = refusal(write_csv(tmp_path / "a.csv", columns), names)
    assert "(the first of 2 findings)" in line
    columns = recorded_run()
    back_and_forth(columns)
    _, lines = read(write_csv(tmp_path / "a.csv", columns))
    assert not [line for line in lines if "against" in line or "the lag of yaw" in line]


def test_the_box_of_environments_is_what_logs_reach_or_what_is_asked(tmp_path):
    columns = recorded_run()
    path = write_csv(tmp_path / "a.csv", columns)
    result = read(path)[0].dataset
    envs = together(result)[2]
    np.testing.assert_array_equal(result.env_low, envs.min(axis=(0, 1)))
    np.testing.assert_array_equal(result.env_high, envs.max(axis=(0, 1)))
    # What was measured is what it says, zeros included, unless nobody measured it.
    for value in (0.0, 0.8):
        constant = columns | {name: np.full(301, value) for name in NAMES[7:]}
        path_of = write_csv(tmp_path / "constant.csv", constant)
        logged, unknown = read(path_of)[0], read(path_of, needs_environment=False)[0]
        np.testing.assert_array_equal(logged.dataset.env_low, np.float32([value] * 2))
        np.testing.assert_array_equal(logged.dataset.env_high, np.float32([value] * 2))
        assert set(logged.coverage["environment"]) == set(NAMES[7:])
        np.testing.assert_array_equal(unknown.dataset.env_high, np.float32([1e6] * 2))
        assert unknown.coverage["environment"] == {}
    chosen = read(path, env_low=(0.3, -8.0), env_high=(0.9, 8.0))[0].dataset
    np.testing.assert_array_equal(chosen.env_low, np.float32([0.3, -8.0]))
    first = int(np.argmax(columns["wind"] > 1.0 + 1e-5))
    line = refusal(path, env_low=(0.3, -8.0), env_high=(0.9, 1.0))
    assert line.startswith(f"{path}, line {first + 2}: wind is ")
    assert "must be 2 numbers each" in refusal(path, env_low=(0.3,), env_high=(0.9,))
    assert "must be 2 numbers each" in refusal(path, env_low=(0.3, -8.0))
