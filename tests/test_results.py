"""The results in the repository: what the pages say of them."""

import json

import numpy as np
import pytest

from experiments import results

PRETRAINED = results.HOME.parent / "src" / "sfkd_jax" / "pretrained"


def row(name, scenario, label, vehicle, controller="mppi_path_300"):
    return results.of_scenario(name, scenario, (controller,))[label][vehicle]


def behind(name, scenario, label, vehicle, **about):
    """SFKD's error minus that of a row [mm]."""
    pair = [row(name, scenario, each, vehicle, **about) for each in ("sfkd", label)]
    return results.difference(*pair)["mean"]


@pytest.mark.parametrize("name", results.BENCHMARKS)
def test_a_file_has_a_line_a_row_and_every_row_its_episodes(name):
    text = (results.HOME / f"{name}.json").read_text("utf-8")
    document = json.loads(text)
    assert len(text.splitlines()) == len(document["rows"]) + 2
    for one in document["rows"]:
        errors = np.asarray(one["rmse_mm"])
        assert errors.shape[0] == len(one["seeds"])
        assert np.all(np.isfinite(errors)) or one["left_the_lane"]


def test_what_the_bound_costs_along_a_path():
    s2 = {"name": "benchmark_path", "scenario": "s2", "vehicle": "kinematic"}
    found = [
        behind(label=label, **s2)
        for label in ("oracle", "sfkd_no_contraction", "neural_ode")
    ]
    assert np.round(found, 1).tolist() == [2.7, 1.4, 2.6]
    for vehicle in ("kinematic_stiff", "dynamic"):
        for scenario in ("s1", "s2", "s3"):
            assert behind("benchmark_path", scenario, "oracle", vehicle) < 0.15


@pytest.mark.parametrize(
    ("plant", "corridor", "error", "over_oracle"),
    [("dynamic", 0.143, 7.1, 1.012), ("kinematic", 0.380, 14.4, 1.096)],
)
def test_the_corridor_and_what_was_driven_in_it(plant, corridor, error, over_oracle):
    path = PRETRAINED / f"{plant}_path" / "certificate.json"
    claims = json.loads(path.read_text("utf-8"))["corridor"]
    assert round(claims["corridor_m"], 3) == corridor
    assert round(claims["coverage"], 2) == 0.99
    sfkd, oracle = (
        np.mean(row("corridor", "s3", label, plant)["rmse_mm"])
        for label in ("sfkd", "oracle")
    )
    assert round(sfkd, 1) == error
    assert round(sfkd / oracle, 3) == over_oracle


def test_what_the_bound_costs_in_the_body_frame():
    """The first page: up to 4.5 mm behind the oracle, of 8.3, and most rivals better."""
    rows = results.of_scenario("benchmark", "s2", ("mppi", "koopman_mpc"))
    error = {
        label: np.mean(cars["dynamic"]["rmse_mm"])
        for label, cars in rows.items()
        if "dynamic" in cars
    }
    assert round(error["oracle"], 1) == 8.3
    assert round(error["sfkd"] - error["oracle"], 1) == 4.5
    rivals = [
        error[label] for label in error if label not in ("oracle", "nominal", "sfkd")
    ]
    assert sum(one < error["sfkd"] for one in rivals) > len(rivals) / 2
