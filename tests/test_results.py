"""The results in the repository: docs/results.md says what its files hold."""

import hashlib
import json
import re

import numpy as np
import pytest

import benchmarks
from benchmarks import pages, tables
from experiments import results, systems
from sfkd_jax import certificate
from sfkd_jax.driving.certificate import DrivingCertificate

PAGE = (results.HOME.parent / "docs" / "results.md").read_text("utf-8")
PRETRAINED = results.HOME.parent / "src" / "sfkd_jax" / "pretrained"


def row(name, scenario, label, vehicle, controller="mppi_path_300"):
    return results.of_scenario(name, scenario, (controller,))[label][vehicle]


def test_a_script_writes_the_lines_of_systems_into_their_file(tmp_path, monkeypatch):
    lines = {name: {"system": name} for name in ("c3m/pvtol", "motor")}
    for name, line in lines.items():
        file = tmp_path / name / "line.json"
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(line), "utf-8")
    written = tmp_path / "systems.json"
    monkeypatch.setattr(systems, "RESULTS", written)
    monkeypatch.setattr("sys.argv", ["systems", str(tmp_path), "motor", "--write"])
    systems.main()
    # In the order of the systems, those of others last.
    assert json.loads(written.read_text("utf-8")) == [
        lines["motor"],
        lines["c3m/pvtol"],
    ]


def test_the_systems_in_their_file_are_among_the_examples():
    names = [row["system"] for row in pages.read("experiments/systems.json")]
    assert len(set(names)) == len(names)
    assert set(names) <= set(systems.SYSTEMS)


def test_what_the_page_of_systems_says_of_the_drone():
    page = (results.HOME.parent / "docs" / "your-system.md").read_text("utf-8")
    words = " ".join(page.split())
    flown = pages.read("experiments/drone.json")
    own = flown["policy"]
    assert own["collisions"] == own["beyond"] == 0
    assert own["claimed"] == 1.0
    for said in (
        f"the certified bound of {flown['bound_m']:.3f} m",
        f"In {flown['flights']} flights through {flown['windows']} windows",
        f"errors was {own['largest_error_m']:.3f} m",
        f"up to {flown['nominal']['largest_error_m']:.3f} m off",
    ):
        assert said in words


def test_what_the_page_of_systems_says_of_the_worst_case():
    page = (results.HOME.parent / "docs" / "your-system.md").read_text("utf-8")
    words = " ".join(page.split())
    motor, cart = pages.read("experiments/worst_case.json")
    lines = pages.read("experiments/systems.json")
    tube = next(row for row in lines if row["system"] == "motor")["tube"]["speed"]
    assert motor["options"] in words
    assert f"with {motor['leaves']} leaves" in words
    assert f"tube is {motor['bound']:.2f} rad/s" in words
    # Eleven times.
    assert round(motor["bound"] / tube) == 11
    for row, factor in ((motor, 1.2), (cart, 2.0)):
        assert row["one_step"] <= factor * row["sampled"] * (1.0 + 1e-6)
    assert f"proved, a tube of {cart['bound']:.2f} m" in words


def test_what_the_page_of_the_lane_says_of_clearance_and_of_backing_up():
    rows = pages.read("benchmarks/lane.json")
    driven = [row for row in rows if row["group"] in ("random", "pedestrian")]
    in_lane = [row for row in driven if row["system"] == "lane"]
    assert sum(row["clearance_below_claim"] for row in in_lane) == 4
    assert sum(row["steps"] for row in in_lane) == 180_000
    page = (results.HOME.parent / "docs" / "lane.md").read_text("utf-8")
    assert "in 4 steps of the 180,000 of random courses" in " ".join(page.split())
    stands = {}
    for row in driven:
        if row["row"] == "pedestrian, friction 0.9":
            stands.setdefault(row["system"], []).append(row["stand"] / row["runs"])
    assert min(stands["lane"]) > 0.85
    assert max(stands["lane, reversing"]) == 0.0


@pytest.mark.parametrize("name", results.BENCHMARKS)
def test_a_file_has_a_line_a_row_and_every_row_its_episodes(name):
    text = (results.HOME / f"{name}.json").read_text("utf-8")
    document = json.loads(text)
    assert len(text.splitlines()) == len(document["rows"]) + 2
    for one in document["rows"]:
        errors = np.asarray(one["rmse_mm"])
        assert errors.shape[0] == len(one["seeds"])
        assert np.all(np.isfinite(errors)) or one["left_the_lane"]


def test_how_far_models_are_behind_a_planner_that_knows_the_car():
    """The first page and docs/results.md, in mm; and what samples are worth."""
    gaps, error = {}, {}
    for one in results.bench3():
        name, frame, car, _, samples = cell = results.CELL(one)
        error[cell] = np.mean(one["rmse_mm"][0])
        if samples in (1, results.SAMPLES):
            gaps.setdefault((frame, car, name), []).append(one["minus_oracle_mm"])
    worst = {where: round(max(found), 1) for where, found in gaps.items()}
    rows = "sfkd", "neural_ode", "icode", "control_synth", "sfkd_alone"
    kinematic, *others = (
        [worst.get(("path", car, one), 0) for one in rows] for car in results.VEHICLES
    )
    assert [kinematic, np.max(others)] == [[0.1, 0.5, 1.5, 1.4, 4.2], 0.3]
    assert max(gap for where, gap in worst.items() if where[2] == "sfkd") == 0.1
    for car, scenario, ratio in ("dynamic", "s3", 1.0), ("kinematic", "s2", 0.94):
        few = error["sfkd", "path", car, scenario, 16]
        assert round(few / error["law_learned", "path", car, scenario, 1], 2) == ratio


def test_what_observing_the_environment_brings():
    ratios = []
    for vehicle in results.VEHICLES:
        blind, sfkd = (
            np.mean(row("benchmark", "s3", label, vehicle, "mppi")["rmse_mm"])
            for label in ("sfkd_no_fiber", "sfkd")
        )
        ratios.append(blind / sfkd)
    assert np.round([min(ratios), max(ratios)], 1).tolist() == [1.6, 3.3]
    assert "1.6 to 3.3 times as large" in re.sub(r"\s+", " ", PAGE)


DRIVEN = ("dynamic", 0.114, 7.4), ("kinematic", 0.349, 14.2)


@pytest.mark.parametrize(("plant", "corridor", "error"), DRIVEN)
def test_the_corridor_and_what_was_driven_in_it(plant, corridor, error):
    path = PRETRAINED / f"{plant}_path" / "certificate.json"
    claims = certificate.read(path, DrivingCertificate).corridor
    assert round(claims.corridor_m, 3) == corridor
    assert claims.coverage.share >= 0.93
    sfkd, oracle = (
        np.mean(row("corridor", "s3", label, plant)["rmse_mm"])
        for label in ("sfkd", "oracle")
    )
    assert [round(sfkd, 1), round(sfkd / oracle, 2)] == [error, 1.0]


def test_adapting_on_cars_that_no_model_has_seen():
    rows = json.loads((results.HOME / "commonroad.json").read_text("utf-8"))["rows"]
    error = {
        (one["row"], one["car"], one["friction"]): np.mean(one["second_half_mm"])
        for one in rows
    }
    ratios = [
        value / error["nominal", *where]
        for (label, *where), value in error.items()
        if label == "SFKD, adaptive"
    ]
    assert np.round([min(ratios), max(ratios)], 2).tolist() == [0.23, 0.34]
    assert "0.23 to 0.34 times" in PAGE


def test_what_adaptation_brings():
    """The sentences of docs/adaptation.md."""
    file = results.HOME.parent / "benchmarks" / "adaptation.json"
    rows = json.loads(file.read_text("utf-8"))["rows"]
    found = {(one["car"], one["case"], one["row"]): one for one in rows}

    def errors(car, case):
        return (
            np.mean(np.square(found[car, case, label]["rmse_mm"])) ** 0.5
            for label in ("oracle that knows", "SFKD", "SFKD, adaptive")
        )

    def ratio(car, case):
        knows, _, ours = errors(car, case)
        return ours / knows

    for car, share in (("dynamic", 0.95), ("kinematic", 0.75)):
        knows, blind, ours = errors(car, "force, 3 s")
        assert (blind - ours) / (blind - knows) > share
    for case in ("mass + 30 %", "steering + 1 degree", "wheelbase + 5 %"):
        assert ratio("dynamic", case) < 1.205
    assert ratio("dynamic", "stiffness - 30 %") < 1.205
    assert round(ratio("dynamic", "e not measured"), 1) == 1.2
    assert 2.0 < ratio("kinematic", "e not measured") < 2.2


# ---- which numbers are old


@pytest.fixture
def ships(tmp_path, monkeypatch):
    """A policy and goldens that ship, as files that a test may change."""
    goldens, policy = tmp_path / "controls.npz", tmp_path / "car" / "policy.safetensors"
    policy.parent.mkdir()
    goldens.write_bytes(b"controls")
    policy.write_bytes(b"weights")
    monkeypatch.setattr(benchmarks, "GOLDENS", goldens)
    monkeypatch.setattr(benchmarks, "PRETRAINED", tmp_path)
    return goldens, policy


def test_a_stamp_is_the_beginning_of_the_hashes_of_what_ships(ships):
    first = {
        name: hashlib.sha256(name.encode()).hexdigest()[:12]
        for name in ("controls", "weights")
    }
    assert benchmarks.stamp("car") == first
    assert benchmarks.stamp() == {"controls": first["controls"]}


@pytest.mark.parametrize("changed", [0, 1])
def test_a_row_is_old_as_soon_as_controls_or_weights_that_ship_are_others(
    ships, changed
):
    row = {"rmse_mm": 7.0} | benchmarks.stamp("car")
    assert not benchmarks.is_old(row, "car")
    ships[changed].write_bytes(b"others")
    assert benchmarks.is_old(row, "car")
    # A model that was trained for the row does not depend on the weights that ship.
    assert benchmarks.is_old(row) == (changed == 0)


def test_a_row_without_a_stamp_is_old(ships):
    assert benchmarks.is_old({"rmse_mm": 7.0})
    assert benchmarks.is_old({"rmse_mm": 7.0} | benchmarks.stamp(), "car")


@pytest.mark.parametrize(
    ("old", "marked"),
    [
        ("", []),
        ("a", ["1 ‡"]),
        ("ab", ["first ‡"]),
        ("ac", ["left ‡"]),
        ("abc", ["left ‡", "first ‡"]),
        ("abcd", ["table ‡"]),
    ],
)
def test_a_mark_stands_once_for_all_that_is_old(old, marked):
    a, b, c, d = (
        tables.Measured(text, name in old)
        for name, text in zip("abcd", "1234", strict=True)
    )
    made = tables.table(["table", "left", "right"], [["first", a, b], ["second", c, d]])
    assert re.findall(r"[a-z0-9]+ ‡", made.split("\n\n")[0]) == marked
    assert made.endswith(tables.OLD_MEANS) == bool(old)


NOT_OURS = "trainings", "S2, paper", "S3, paper"
"""Columns whose numbers nobody drove here."""


def printed():
    """Every table of every page: (block, headings, rows)."""
    for blocks in pages.BLOCKS.values():
        for name, build in blocks.items():
            for part in build().split("\n\n"):
                if part.startswith("|"):
                    lines = [
                        [cell.strip() for cell in line[2:-2].split(" | ")]
                        for line in part.splitlines()
                    ]
                    yield name, lines[0], lines[2:]


def test_every_number_that_a_page_prints_is_marked_once_it_is_old(monkeypatch):
    monkeypatch.setattr(tables, "is_old", lambda row, policy=None: True)
    monkeypatch.setattr(pages, "is_old", lambda row, policy=None: True)
    of_others = {}, {"content_sha256": "of other weights"}
    monkeypatch.setattr(pages.store, "read_arrays", lambda *_, **__: of_others)
    numbers = 0
    for name, heads, rows in printed():
        for row in rows:
            for head, cell in zip(heads[1:], row[1:], strict=True):
                if re.search(r"\d", cell) and head not in NOT_OURS:
                    places = heads[0], head, row[0], cell
                    assert any(one.endswith("‡") for one in places), (name, places)
                    numbers += 1
    assert numbers > 400


def test_no_number_is_marked_while_it_is_new(monkeypatch):
    monkeypatch.setattr(tables, "is_old", lambda row, policy=None: False)
    monkeypatch.setattr(pages, "is_old", lambda row, policy=None: False)
    assert [name for name, *lines in printed() if "‡" in str(lines)] == []


def test_a_cell_has_one_number_and_the_first_page_eight_rows():
    for name, heads, rows in printed():
        assert len(heads) <= 7, name
        if name == "corridor":
            assert len(rows) <= 8
        for row in rows:
            for cell in row[1:]:
                assert len(re.findall(r"\d[\d.,]*", cell)) <= 1, (name, cell)
