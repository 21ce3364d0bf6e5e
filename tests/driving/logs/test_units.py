"""Columns whose names have units are read in SI units, or refused in one line."""

import numpy as np
import pytest
from recorded import recorded_run, write_csv, write_npz
from test_files import read

from sfkd_jax.driving.logs import Columns
from sfkd_jax.driving.logs._column_names import find_column, find_unit

WITH_UNITS = {
    "t": ("t (ms)", 1e3),
    "p_x": ("p_x(m)", 1.0),
    "p_y": ("p_y [cm]", 1e2),
    "yaw": ("yaw(deg)", 180.0 / np.pi),
    "v": ("v [km/h]", 3.6),
    "steering": ("steering(°)", 180.0 / np.pi),
    "acceleration": ("acceleration [m/s^2]", 1.0),
    "friction": ("friction[%]", 1e2),
    "wind": ("wind (kn)", 3600 / 1852),
}


def values(logged):
    part = logged.dataset.train
    return [np.asarray(leaf) for leaf in part]


def with_units(columns):
    return {WITH_UNITS[n][0]: WITH_UNITS[n][1] * a for n, a in columns.items()}


@pytest.mark.parametrize("write", [write_csv, write_npz])
def test_units_in_column_names_are_converted_and_reported(tmp_path, write):
    suffix = "csv" if write is write_csv else "npz"
    plain, _ = read(write(tmp_path / f"plain.{suffix}", recorded_run()))
    logged, lines = read(
        write(tmp_path / f"units.{suffix}", with_units(recorded_run()))
    )
    for given, expected in zip(values(logged), values(plain), strict=True):
        np.testing.assert_allclose(given, expected, rtol=1e-5, atol=1e-5)
    (line,) = (line for line in lines if line.startswith("converted"))
    assert line == (
        "converted to SI units: t (ms) to s (x 0.001), p_y [cm] to m (x 0.01), "
        "yaw(deg) to rad (x 0.0174533), v [km/h] to m/s (x 0.277778), "
        "steering(°) to rad (x 0.0174533), friction[%] to - (x 0.01), "
        "wind (kn) to m/s (x 0.514444)"
    )


def test_a_name_in_full_is_read_as_it_is_or_converted_if_its_unit_is_known(tmp_path):
    columns = recorded_run()
    columns["friction (estimate)"] = columns.pop("friction")
    columns["v [km/h]"] = 3.6 * columns.pop("v")
    names = Columns(
        state=("p_x", "p_y", "yaw", "v [km/h]"),
        environment=("friction (estimate)", "wind"),
    )
    logged, lines = read(write_csv(tmp_path / "a.csv", columns), names)
    assert lines[0] == "converted to SI units: v [km/h] to m/s (x 0.277778)"
    assert logged.coverage["state"]["v [km/h]"]["high"] < 6.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"v": "v [parsnip/day]"},
            "unknown unit 'parsnip/day' of column v [parsnip/day]",
        ),
        (
            {"p_x": "p_x (deg)"},
            "column p_x (deg) has a unit of angle, length is needed",
        ),
        ({"t": "t (m)"}, "column t (m) has a unit of length, time is needed"),
    ],
)
def test_other_units_are_one_line(tmp_path, changes, message):
    columns = {changes.get(name, name): a for name, a in recorded_run().items()}
    path = write_csv(tmp_path / "a.csv", columns)
    with pytest.raises(ValueError, match=r"^[^\n]*$") as refusal:
        read(path)
    assert str(refusal.value).startswith(f"{path}: {message}")


def test_two_columns_that_fit_are_refused(tmp_path):
    columns = recorded_run()
    columns["v (m/s)"] = columns["v [km/h]"] = columns.pop("v")
    with pytest.raises(ValueError, match="both fit v; configure one in full"):
        read(write_csv(tmp_path / "a.csv", columns))
    assert find_column("x", ["x(ft)", "x"], "length").header == "x"
    assert find_column("x", ["y", "xx(m)"], "length") is None


@pytest.mark.parametrize(
    ("symbols", "dimension", "factor"),
    [
        ("s sec", "time", 1.0),
        ("ms", "time", 1e-3),
        ("deg degrees °", "angle", np.pi / 180),
        ("km/h kph kmh KM/H", "speed", 1 / 3.6),
        ("kn", "speed", 1852 / 3600),
        ("deg/s °/s", "angular rate", np.pi / 180),
        ("rpm", "angular rate", np.pi / 30),
        ("m/s² m/s^2 m/s2", "acceleration", 1.0),
        ("g", "acceleration", 9.80665),
        ("kNm", "torque", 1e3),
        ("- 1", "ratio", 1.0),
        ("%", "ratio", 1e-2),
    ],
)
def test_units_have_their_dimension_and_factor(symbols, dimension, factor):
    for symbol in symbols.split():
        assert find_unit(symbol) == (dimension, pytest.approx(factor, rel=1e-12))


@pytest.mark.parametrize("symbol", ["", "estimate", "mu", "9**9**9", "x(", "degC", "2"])
def test_a_remark_is_no_unit(symbol):
    assert find_unit(symbol) is None
