"""The results in the repository: docs/results.md says what its files hold."""

import json
import re

import numpy as np
import pytest

from experiments import results

PAGE = (results.HOME.parent / "docs" / "results.md").read_text("utf-8")
PRETRAINED = results.HOME.parent / "src" / "sfkd_jax" / "pretrained"


def row(name, scenario, label, vehicle, controller="mppi_path_300"):
    return results.of_scenario(name, scenario, (controller,))[label][vehicle]


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


DRIVEN = ("dynamic", 0.104, 6.8), ("kinematic", 0.291, 13.3)


@pytest.mark.parametrize(("plant", "corridor", "error"), DRIVEN)
def test_the_corridor_and_what_was_driven_in_it(plant, corridor, error):
    path = PRETRAINED / f"{plant}_path" / "certificate.json"
    claims = json.loads(path.read_text("utf-8"))["corridor"]
    assert round(claims["corridor_m"], 3) == corridor
    assert claims["coverage"] >= 0.93
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
