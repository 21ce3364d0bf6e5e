import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import write_policy
from PIL import Image

from sfkd_jax import report
from sfkd_jax.paper import write_comparison
from sfkd_jax.paper._sweep_figure import tradeoff
from sfkd_jax.paper._sweep_records import curves, records_of
from sfkd_jax.store import ArtefactError

PATTERN = "sweep/*/sfkd/seed=*"


def certificate(alpha, separate, d_bar):
    radii = [d_bar * (1 - alpha**k) / (1 - alpha) for k in range(1, 21)]
    drives = {
        name: {"coverage": share, "coverage_trajectories": 100}
        for name, share in (("s3", 0.84), ("s1", 0.96))
    }
    return {
        "valid": True, "alpha": alpha, "alpha_separate": separate, "alpha_joint": alpha, "attack": alpha - 0.125,
        "tightness": alpha / (alpha - 0.125), "weights_sha256": "ab" * 32,
        "lipschitz": {"body": 3.0}, "d_bar": {"value": d_bar, "validation": d_bar / 2, "by_scenario": drives},
        "tube": {"latent": radii, "physical": {"position_m": [0.1, 4.5]}, "ultimate": d_bar / (1 - alpha)},
    }  # fmt: skip


def driven(system, scenario, mean, **violation):
    rmse = {
        "mean": mean,
        "std": 0.005,
        "ci95": [mean - 0.003, mean + 0.004],
        "median": mean,
        "p95": mean + 0.01,
    }
    return {
        "system": system, "scenario": scenario, "vehicle": "kinematic", "sampling": "feedback", "env": "measured",
        "rmse_m": rmse, "ratio_to_oracle": mean / 0.016, "smoothness_rad_per_s": 0.054, "violation": violation,
    }  # fmt: skip


def write_run(directory, loop, rho, beta, proof, scale=1.0):
    settings = {"vehicle": {"name": "kinematic", "inner_loop": loop}, "seed": 0}
    settings["model"] = {"name": "sfkd", "system": "sfkd", "rho": rho, "beta": beta}
    claim = {"v0": 0.0, "v1": 0.01, "v1_tube": "certified", "v1_radius_m": 1.5}
    claim |= {"v1_conformal": 0.02, "v1_conformal_radius_m": 0.14}
    rows = [driven("oracle", "s3", 0.016), driven("sfkd", "s3", 0.02 * scale, **claim)]
    rows.append(driven("sfkd", "s3", 0.5) | {"sampling": "plain"})
    ahead = {"steps": list(range(1, 21)), "dt": 0.1}
    for name, last in (("position", 0.3), ("longitudinal", 0.25), ("lateral", 0.15)):
        ahead[f"{name}_rmse_m"] = [last * scale * step / 20 for step in ahead["steps"]]
    documents = {
        "settings": settings,
        "policy": {"sha256": "ab" * 32, "config": settings},
    }
    documents |= {"open_loop": ahead, "results": {"rows": rows}, "certificate": proof}
    directory.mkdir(parents=True)
    for name, document in documents.items():
        if document is not None and name == "policy":
            write_policy(directory, document)
        elif document is not None:
            (directory / f"{name}.json").write_text(json.dumps(document))


@pytest.fixture
def root(tmp_path):
    """Two points of a curve with the speed loop and one without, a rival β, a refusal,
    and a run still in training.
    """
    home = tmp_path / "sweep"
    write_run(
        home / "a/sfkd/seed=0", "speed", 0.825, 0.05, certificate(0.75, 0.875, 0.5)
    )
    write_run(
        home / "b/sfkd/seed=0", "speed", 0.845, 0.03, certificate(0.75, 0.875, 0.25), 3
    )
    write_run(
        home / "c/sfkd/seed=0", "none", 0.825, 0.05, certificate(0.75, 0.875, 1.0), 2
    )
    write_run(
        home / "d/sfkd/seed=0",
        "speed",
        0.925,
        0.05,
        certificate(0.875, 0.9375, 0.5),
        0.5,
    )
    refusal = {
        "valid": False,
        "reason": "alpha = 1.02 is not below 1",
        "alpha": 1.02,
        "d_bar": {"value": 3.0},
    }
    write_run(home / "e/sfkd/seed=0", "speed", 0.9, 0.2, refusal)
    write_run(home / "f/sfkd/seed=0", "none", 0.9, 0.05, None)
    for name in ("open_loop.json", "results.json", "policy.safetensors"):
        (home / f"f/sfkd/seed=0/{name}").unlink()
    (home / "g/sfkd/seed=0").mkdir(parents=True)
    return tmp_path


@pytest.fixture
def made(root):
    return write_comparison(root, PATTERN, "curve")


def rows_of(made):
    rows = json.loads(Path(made["comparison"]).read_text("utf-8"))["rows"]
    return {row["run"].split("/")[1]: row for row in rows}


def test_a_record_holds_what_the_artefacts_say_and_nothing_else(made):
    row = rows_of(made)["a"]
    assert row == {
        "run": "sweep/a/sfkd/seed=0", "system": "sfkd", "vehicle": "kinematic", "inner_loop": "speed", "rho": 0.825,
        "beta": 0.05, "seed": 0, "reason": None, "alpha": 0.75, "alpha_separate": 0.875, "alpha_joint": 0.75,
        "attack": 0.625, "tightness": 1.2, "d_bar": 0.5, "d_bar_validation": 0.25,
        "tube": {"steps": 20, "latent": 2 * (1 - 0.75**20), "position_m": 4.5},
        "ultimate": 2.0, "ultimate_separate": 4.0, "ultimate_validation": 1.0,
        "ultimate_body_validation": 3.0, "coverage": {"s1": 0.96, "s3": 0.84},
        "open_loop": {"steps": 20, "position_rmse_m": 0.3, "longitudinal_rmse_m": 0.25, "lateral_rmse_m": 0.15},
        "closed_loop": {"s3": {
            "rmse_m": {"mean": 0.02, "std": 0.005, "ci95": [0.017, 0.024], "median": 0.02, "p95": 0.03},
            "ratio_to_oracle": 1.25, "smoothness_rad_per_s": 0.054, "v0": 0.0, "v1_certified": 0.01,
            "v1_certified_radius_m": 1.5, "v1_conformal": 0.02, "v1_conformal_radius_m": 0.14,
        }},
        "smallest_of_its_betas": False,
    }  # fmt: skip


def test_the_smallest_ultimate_bound_is_marked_among_runs_that_differ_in_beta_alone(
    made,
):
    assert [
        name for name, row in rows_of(made).items() if row["smallest_of_its_betas"]
    ] == ["b"]
    text = Path(made["report"]).with_name("report.md").read_text("utf-8")
    assert "| **b** | **0.25** | **0.125** |" in text
    assert text.count("| **") == len(
        re.findall(r"(?m)^\| \*\*b\*\*.*", text)[0].split(" | ")
    )
    assert "smallest with β = 0.03 for ρ + β = 0.875 (speed loop)." in text


def test_a_refused_or_missing_certificate_is_a_row_of_nulls_with_its_reason(made):
    rows = rows_of(made)
    assert list(rows) == ["c", "f", "b", "a", "d", "e"]
    assert rows["e"]["reason"] == "alpha = 1.02 is not below 1"
    assert rows["f"]["reason"] == "certificate.json is missing"
    claims = (
        "alpha",
        "alpha_separate",
        "alpha_joint",
        "attack",
        "tightness",
        "d_bar",
        "d_bar_validation",
        "ultimate",
    )
    for name in "ef":
        assert {
            rows[name][key]
            for key in (*claims, "ultimate_separate", "ultimate_validation")
        } == {None}
        assert rows[name]["tube"] == {"steps": 0, "latent": None, "position_m": None}
        assert rows[name]["coverage"] == {}
    assert rows["e"]["closed_loop"]["s3"]["rmse_m"]["mean"] == 0.02
    assert rows["f"]["closed_loop"] == {}
    assert set(rows["f"]["open_loop"].values()) == {None}
    page = Path(made["report"]).read_text("utf-8")
    assert "alpha = 1.02 is not below 1" in page
    assert "Without a certificate: 2 runs" in page
    assert (
        re.search(
            r"\b(nan|inf|None|null)\b",
            re.sub(r"<style>.*?</style>|base64,[^\"]*", "", page),
        )
        is None
    )


def test_a_certificate_of_other_weights_is_not_believed(root):
    write_policy(root / "sweep/a/sfkd/seed=0", {"sha256": "cd" * 32})
    row = rows_of(write_comparison(root, PATTERN, "curve"))["a"]
    assert row["alpha"] is None
    assert "other weights" in row["reason"]


def test_a_certificate_of_an_older_format_gives_nulls(root):
    file = root / "sweep/a/sfkd/seed=0/certificate.json"
    proof = json.loads(file.read_text())
    for key in ("alpha_joint", "attack", "tightness"):
        del proof[key]
    proof["d_bar"] = {"value": 0.5}
    file.write_text(json.dumps(proof))
    row = rows_of(write_comparison(root, PATTERN, "curve"))["a"]
    assert [
        row[key] for key in ("alpha", "alpha_joint", "tightness", "ultimate_validation")
    ] == [
        0.75,
        None,
        None,
        None,
    ]


def test_the_paragraph_says_where_each_curve_begins_and_ends(made):
    text = (
        Path(made["report"]).with_name("report.md").read_text("utf-8").splitlines()[2]
    )
    assert text.startswith(
        "This page compares 6 runs. No inner loop, β = 0.05: at certified α = 0.75, the position error"
    )
    assert (
        "Speed loop, β = 0.05: from certified α = 0.75 to 0.875, the position error after 20 steps goes"
        in text
    )
    assert "goes from 0.3 to 0.15 m" in text
    assert (
        "lateral RMSE on S3 goes from 0.02 to 0.01 m (95 % intervals do not overlap)"
        in text
    )
    assert "the ultimate bound goes from 2 to 4." in text
    assert "divides the ultimate bound of ρ + β by 2.00 (4 runs)" in text


def test_the_figure_draws_every_run_at_its_joint_and_at_its_separate_alpha(root, made):
    assert [Path(figure).name for figure in made["figures"]] == ["curve.png"]
    with Image.open(made["figures"][0]) as image:
        assert image.size[0] > 900
    records = records_of(root, PATTERN)
    assert [[record["run"][6] for record in line] for line in curves(records)] == [
        ["c"],
        ["a", "d"],
    ]
    figure = tradeoff(records)
    error, driving, tube, ultimate = figure.axes
    np.testing.assert_allclose(
        error.get_lines()[1].get_xydata(), [[0.75, 0.3], [0.875, 0.15]]
    )
    solid = [
        line
        for line in driving.get_lines()
        if not str(line.get_label()).startswith("_")
    ]
    np.testing.assert_allclose(solid[1].get_xydata(), [[0.75, 0.02], [0.875, 0.01]])
    whiskers = sorted(
        tuple(line.get_ydata()) for line in driving.get_lines() if line not in solid
    )
    np.testing.assert_allclose(
        whiskers, [(0.007, 0.014), (0.017, 0.024), (0.037, 0.044)]
    )
    np.testing.assert_allclose(tube.get_lines()[0].get_ydata(), 4 * (1 - 0.75**20))
    drawn = [line.get_xydata() for line in ultimate.get_lines()]
    expected = [
        [[0.75, 4]],
        [[0.875, 8]],
        [[0.75, 2], [0.875, 4]],
        [[0.875, 4], [0.9375, 8]],
    ]
    for line, points in zip(drawn, expected, strict=True):
        np.testing.assert_allclose(line, points)
    hollow = [line.get_markerfacecolor() for line in ultimate.get_lines()]
    assert [colour == "white" for colour in hollow] == [False, True, False, True]


def test_the_same_runs_give_the_same_bytes(root, made):
    names = [made["report"], made["comparison"], *made["figures"]]
    before = [Path(name).read_bytes() for name in names]
    assert write_comparison(root, PATTERN, "curve") == made
    assert [Path(name).read_bytes() for name in names] == before


def test_without_any_certificate_there_is_a_table_and_no_figure(root, made):
    again = write_comparison(root, "sweep/[ef]/sfkd/seed=*", "curve")
    assert again["figures"] == []
    assert not Path(made["figures"][0]).exists()
    assert set(rows_of(again)) == {"e", "f"}


@pytest.mark.parametrize("pattern", ["nothing/*", "sweep/g/sfkd/seed=*"])
def test_a_pattern_without_runs_is_refused_in_one_line(root, pattern):
    with pytest.raises(ValueError, match=re.escape(pattern)) as refused:
        write_comparison(root, pattern, "curve")
    assert "\n" not in str(refused.value)
    assert not (root / "curve").exists()


def test_the_door_compares_when_it_is_asked_to(root):
    settings = {"root": str(root), "name": "curve", "report": {"compare": PATTERN}}
    assert report.run(settings)["report"] == str(
        root / "curve" / "comparison" / "index.html"
    )
    own = {
        "name": "none",
        "model": {"system": "sfkd"},
        "seed": 0,
        "report": {"compare": None},
    }
    with pytest.raises(ArtefactError, match=r"policy\.json"):
        report.run(settings | own)
