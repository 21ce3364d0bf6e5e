import json
import math
import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from sfkd_jax.paper import results_markdown, write_results_page
from sfkd_jax.paper._animation import film
from sfkd_jax.paper._claims import better_rows
from sfkd_jax.paper._figures import deviations, overview
from sfkd_jax.paper._forces import forces_figure, forces_of, forces_tables
from sfkd_jax.paper._latex import latex
from sfkd_jax.paper._setups import setups
from sfkd_jax.paper._study import Study, study_of
from sfkd_jax.paper._variations import (
    variations,
    variations_figure,
    variations_table,
)
from sfkd_jax.reporting.blocks import Table
from sfkd_jax.reporting.film import MAX_BYTES
from sfkd_jax.reporting.rows import name_of
from sfkd_jax.store import ArtefactError, write_arrays


def page_texts(name):
    """Texts of the page of a comparison."""
    path = Path(__file__).parents[2] / "conf" / "comparison"
    title = {"table1": "The paper's table, row by row"}.get(name, name)
    rivals = yaml.safe_load((path / "none.yaml").read_text())["page"]["rivals"]
    as_printed = {"icode_mppi_one_step": "icode_mppi"}
    return {"title": title, "rivals": rivals, "printed_as": as_printed}


ORACLE, SFKD = 0.016, 0.020
LEVELS = ((0.9, 0.0), (0.6, -4.0), (0.3, 8.0), (0.6, 4.0))
SYSTEMS = {  # (system, env): RMSE on S3 [m]
    ("sfkd", "measured"): SFKD, ("sfkd_no_fiber", "none"): 0.060, ("sfkd_no_contraction", "measured"): 0.018,
    ("koopman_mpc", "measured"): 0.090, ("koopman_mpc", "none"): 0.150, ("neural_ode", "none"): 0.070,
    ("neural_ode", "measured"): 0.030, ("icode_mppi", "measured"): 0.025, ("icode_mppi", "none"): 0.080,
    ("icode_mppi_one_step", "measured"): 0.040, ("nominal", "none"): 0.120, ("oracle", "measured"): ORACLE,
}  # fmt: skip
PAPER = {
    "columns": [
        "rmse_s2_m",
        "rmse_s2_std",
        "rmse_s3_m",
        "rmse_s3_std",
        "smoothness_rad_per_s",
        "violation_rate",
    ],
    "icode_mppi": [0.127, 0.019, 0.174, 0.025, 0.134, 0.29],
    "sfkd": [0.098, 0.014, 0.120, 0.018, 0.101, 0.03],
}


def row(
    system,
    env,
    scenario="s3",
    vehicle="kinematic",
    sampling="feedback",
    factor=1.0,
    **more,
):
    sampling = None if system == "koopman_mpc" else sampling
    scale = (
        factor
        * {"s1": 0.5, "s2": 0.8, "s3": 1.0}[scenario]
        * (3 if sampling == "plain" else 1)
    )
    mean = SYSTEMS[system, env] * scale
    gap = mean - SFKD * scale
    own = system == "sfkd"
    violation = {
        "v0": 0.0 if own else None, "v1": 0.01, "v1_tube": "certified" if own else "conformal", "v1_radius_m": 2.0,
        "v1_conformal": 0.04, "v1_conformal_radius_m": 0.2, "v1_level": 0.95, "v2": 10 * mean * 1e-2, "segments": 96,
    }  # fmt: skip
    learned = system not in ("oracle", "nominal")
    return {
        "system": system, "model": system, "controller": "mppi", "sampling": sampling, "env": env,
        "scenario": scenario, "vehicle": vehicle, "inner_loop": "none", "seeds": [0, 1], "episodes": 8,
        "episode_s": 60.0, "variation": None,
        "rmse_m": {"mean": mean, "std": 0.2 * mean, "ci95": [0.9 * mean, 1.1 * mean], "median": mean, "p95": mean},
        "max_deviation_m": 8 * mean, "rmse_after_switch_m": None if scenario == "s1" else mean,
        "smoothness_rad_per_s": 0.054, "violation": violation, "departures": 0,
        "act_ms": {"p50": 9.25, "p99": 20.5}, "ratio_to_oracle": mean / (ORACLE * scale),
        "difference_to_sfkd": None if own else {"mean": gap, "ci95": [gap - 1e-3, gap + 1e-3]},
        "params": 12345 if learned else None, "alpha": 0.93211 if own else None,
        "open_loop_rmse_m": {"1": 0.01 * mean, "5": 0.1 * mean, "10": mean, "20": 5 * mean} if learned else None,
    } | more  # fmt: skip


def driven_under_forces(system, env):
    runs = [
        {"force_n": force, "v0": 0.0, "v1": 0.1, "v1_conformal": force / 1e3, "v2": 0.0}
        for force in (0.0, 500.0)
    ]
    runs[0] |= {"rmse_m": {"mean": SYSTEMS[system, env]}, "departures": 2}
    runs[1] |= {"departures": 0}
    return row(system, env, disturbed=runs)


def document(vehicles=("kinematic",), samplings=("feedback", "plain")):
    rows = []
    for vehicle, sampling, scenario in product(vehicles, samplings, ("s1", "s2", "s3")):
        for system, env in SYSTEMS:
            if system != "koopman_mpc" or sampling == "feedback":
                rows.append(row(system, env, scenario, vehicle, sampling))
    for folder, entry in enumerate(rows):
        if (entry["scenario"], entry["sampling"]) == ("s3", "feedback"):
            rows[folder] = entry | {
                "disturbed": driven_under_forces(entry["system"], entry["env"])[
                    "disturbed"
                ]
            }
    for variation, factor in {
        "environment 0.5 s late": 1.5,
        "environment 1 s late": 2.5,
        "sensor noise x 2": 1.25,
    }.items():
        left = 2 if factor == 1.25 else 0
        rows += [
            row(*one, factor=factor, variation=variation, departures=left)
            for one in SYSTEMS
        ]
    config = {
        "name": "table1",
        "comparison": {"paper": PAPER, "seeds": [0, 1], "page": page_texts("table1")},
        "evaluation": {"episodes": 8},
    }
    return {
        "rows": rows,
        "config": config,
        "versions": {"jax": "0.10.2"},
        "seconds": 90.0,
        "failed": {},
    }


def road(length):
    s = 0.5 * np.arange(2 * length + 400)
    curvature = 0.02 * np.sin(2 * np.pi * s / 90)
    yaw = np.cumsum(curvature) * 0.5
    return np.stack(
        [np.cumsum(np.cos(yaw)) * 0.5, np.cumsum(np.sin(yaw)) * 0.5, yaw, curvature],
        axis=1,
    )


def cell(
    directory,
    system,
    env,
    sampling="feedback",
    steps=40,
    vehicle="kinematic",
    **changes,
):
    """A cell whose deviation follows the wind, as far as the system is wrong."""
    path, levels = road(steps), np.array(LEVELS)[np.arange(steps) // 30 % len(LEVELS)]
    time = 0.1 * np.arange(1, steps + 1)
    gain = 2 * SYSTEMS[system, env]
    lateral = gain * (
        levels[:, 1] / 8 * (1 - np.exp(-3 * (time % 3)))
        + 0.3 * np.sin(1.7 * time + 40 * gain)
    )
    here = path[2 * np.arange(steps + 1)]
    offset = np.concatenate([[0.0], lateral])
    states = np.stack(
        [
            here[:, 0] - offset * np.sin(here[:, 2]),
            here[:, 1] + offset * np.cos(here[:, 2]),
        ],
        axis=1,
    )
    states = np.concatenate(
        [states, here[:, 2:3], np.full((steps + 1, 1), 10.0)], axis=1
    )
    arrays = {"lateral": lateral, "states": states, "envs": levels, "path": path}
    arrays = {
        name: np.stack([values] * 2).astype(np.float32)
        for name, values in arrays.items()
    }
    kind = "qp" if system == "koopman_mpc" else sampling
    folder = directory / "cells" / vehicle / "s3" / kind
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        name: values
        for name, values in (arrays | {"dt": np.float64(0.1)} | changes).items()
        if values is not None
    }
    write_arrays(folder / f"{system}-{env}.safetensors", arrays, kind="cell", config={})


def reported(directory, results):
    """A page of results, with the cells of all rows but two."""
    (directory / "results.json").write_text(json.dumps(results))
    for system, env in SYSTEMS:
        if system != "neural_ode":
            cell(directory, system, env)
    return directory, write_results_page(directory)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The table and studies of its rows on one page."""
    return reported(tmp_path_factory.mktemp("whole"), document())


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """The table alone."""
    results = document()
    rows = [
        {name: value for name, value in one.items() if name != "disturbed"}
        for one in results["rows"]
    ]
    results["rows"] = [one for one in rows if one["variation"] is None]
    return reported(tmp_path_factory.mktemp("table"), results)


def text_of(directory, name):
    return (directory / "report" / name).read_text("utf-8")


def tables_of(markdown, heading):
    """The cells of the first table under a heading, by row."""
    part = markdown.split(f"# {heading}")[1].split("\n#")[0]
    lines = [
        line.strip("| ").split(" | ")
        for line in part.splitlines()
        if line.startswith("|")
    ]
    lines = [
        [re.sub(r"^\*\*(.*)\*\*$", r"\1", cell) for cell in line] for line in lines
    ]
    return {name: cells for name, *cells in (lines[0], *lines[2:])}


FEEDBACK = "Kinematic vehicle, sampling around a feedback law"


def test_tracking_stands_beside_the_paper_with_intervals_in_millimetres(whole):
    result = tables_of(text_of(whole[0], "results.md"), f"Tracking: {FEEDBACK}")
    assert result["SFKD"] == [
        "10.0 (9.0–11.0)",
        "16.0 (14.4–17.6)",
        "98 ± 14",
        "20.0 (18.0–22.0)",
        "120 ± 18",
    ]
    assert result["ICODE-MPPI (e)"][-1] == result["ICODE-MPPI (no e)"][-1] == "174 ± 25"
    assert result["ICODE-MPPI, one step (e)"][-2:] == ["40.0 (36.0–44.0)", "174 ± 25"]
    assert result["Oracle"][-1] == "–"


def test_differences_are_marked_where_the_interval_leaves_zero_on_either_side(whole):
    result = tables_of(
        text_of(whole[0], "results.md"), f"Against SFKD and the oracle: {FEEDBACK}"
    )
    assert result["ICODE-MPPI (e)"][2] == r"+5.0 (4.0–6.0) \*"
    assert result["SFKD − contraction"][2] == "−2.0 (−3.0 to −1.0) †"
    assert result["SFKD"] == ["–", "–", "–", "1.25 / 1.25 / 1.25"]


@pytest.mark.parametrize(("p", "mark"), [(0.04, r" \*"), (0.06, "")])
def test_a_difference_is_decided_by_its_corrected_p_and_not_by_its_interval(p, mark):
    sfkd, other = row("sfkd", "measured"), row("icode_mppi", "measured")
    other["difference_to_sfkd"] |= {"p": 0.01, "p_holm": p}
    text = results_markdown(document() | {"rows": [sfkd, other]})
    found = tables_of(text, f"Against SFKD and the oracle: {FEEDBACK}")
    assert found["ICODE-MPPI (e)"][0] == "+5.0 (4.0–6.0)" + mark
    assert "p is above 0.05 with Holm's correction" in text
    assert ("so SFKD is better" if mark else "undecided with Holm's correction") in text


def test_a_quadratic_program_is_compared_with_the_sampling_it_was_compared_with(whole):
    markdown = text_of(whole[0], "results.md")
    own = tables_of(markdown, f"Against SFKD and the oracle: {FEEDBACK}")[
        "Koopman MPC (e)"
    ]
    other = tables_of(
        markdown, "Against SFKD and the oracle: Kinematic vehicle, plain sampling"
    )["Koopman MPC (e)"]
    assert own[2].startswith("+70.0")
    assert own[3] == "5.62 / 5.62 / 5.62"
    assert other == ["–"] * 4


def test_rows_in_path_coordinates_have_the_names_of_their_systems_under_a_title_that_says_so():
    ours = row("sfkd", "measured", sampling="law") | {"system": "sfkd_path"}
    theirs = row("neural_ode", "measured", sampling="law") | {
        "system": "neural_ode_path"
    }
    unbound = row("sfkd_no_contraction", "measured", sampling="law") | {
        "system": "sfkd_path_no_contraction"
    }
    text = results_markdown(document() | {"rows": [ours, unbound, theirs]})
    result = tables_of(
        text,
        "Against SFKD and the oracle: Kinematic vehicle, path coordinates, sampling around their law",
    )
    assert list(result) == ["Row", "SFKD", "SFKD − contraction", "Neural ODE (e)"]
    assert result["Neural ODE (e)"][0].startswith("+")


def test_claims_predictions_and_cost_are_there(whole):
    markdown = text_of(whole[0], "results.md")
    result = tables_of(markdown, f"Claims: {FEEDBACK}")
    assert result["SFKD"][:3] == ["0 / 0 / 0", "1.0 / 1.0 / 1.0", "2.00 / 2.00 / 2.00"]
    assert result["Nominal"][:3] == ["–", "–", "–"]
    result = tables_of(markdown, f"Threshold and planner: {FEEDBACK}")
    assert result["SFKD"] == ["0.1 / 0.2 / 0.2", "3.0", "0 / 0 / 0", "–", "–"]
    assert result["Oracle"][:2] == ["0.1 / 0.1 / 0.2", "–"]
    assert tables_of(markdown, "Prediction without feedback, position error")[
        "SFKD"
    ] == ["0.2", "2.0", "20.0", "100.0"]
    assert tables_of(markdown, "Cost and certificate")["SFKD"] == [
        "9.25",
        "20.50",
        "9.25",
        "20.50",
        "12345",
        "0.9322",
    ]


def test_the_papers_claim_is_beside_ours_with_its_paired_interval(whole):
    markdown = text_of(whole[0], "results.md")
    assert "31 % lower than ICODE-MPPI on S3 (120 against 174 mm)" in markdown
    for name, share, mean, gap in (
        (" (e)", 20, 25, 5),
        (" (no e)", 75, 80, 60),
        (", one step (e)", 50, 40, 20),
    ):
        interval = (
            f"{gap}.0 mm, 95 % interval {gap - 1}.0 to {gap + 1}.0, so SFKD is better."
        )
        text = (
            f"20.0 against {mean}.0 mm, {share} % lower; paired difference {interval}"
        )
        assert markdown.count(f"**SFKD against ICODE-MPPI{name}.** On S3 {text}") == 1
    text = "20.0 against 18.0 mm, 11 % higher; paired difference −2.0 mm, 95 % interval −3.0 to −1.0"
    assert (
        f"**SFKD against SFKD − contraction.** On S3 {text}, so SFKD − contraction is better."
        in markdown
    )
    assert (
        "1.25 on S1, 1.25 on S2, 1.25 on S3 times that of a planner with the true vehicle"
        in markdown
    )


def test_rows_that_beat_sfkd_are_named_and_no_others():
    (setup,) = setups([row(*one) for one in SYSTEMS])
    table, rest = better_rows(setup)
    result = dict(table.rows)
    assert result["S3 RMSE [mm]: 20.0"] == "SFKD − contraction 18.0 †; Oracle 16.0 †"
    assert result["prediction 20 steps ahead [mm]: 100.0"] == "SFKD − contraction 90.0"
    assert "S3 steering rate [rad/s]: 0.054" in rest.text
    assert not any(name.startswith("S3 steering rate") for name in result)
    worst = [row(*one) for one in SYSTEMS if one != ("sfkd", "measured")] + [
        row("sfkd", "measured", factor=20)
    ]
    others = better_rows(setups(worst)[0])[0].rows[0][1]
    assert all(
        line.name in others
        for line in setups(worst)[0].entries
        if line.system != "sfkd"
    )
    assert not any(
        isinstance(block, Table)
        for block in better_rows(setups([row("sfkd", "measured")])[0])
    )


def test_latex_is_balanced_and_bold_marks_the_best_learned_row(whole):
    text = text_of(whole[0], "table1.tex")
    body = re.sub(r"(?m)^%.*$|\\[{}%]", "", text)
    depths = np.cumsum([{"{": 1, "}": -1}.get(letter, 0) for letter in body])
    assert depths.min() == 0
    assert depths[-1] == 0
    assert r"\usepackage{booktabs,graphicx}" in text.splitlines()[0]
    assert (
        text.count(r"\begin{table}")
        == text.count(r"\resizebox")
        == text.count(r"\end{table}")
        == 2
    )
    assert len(set(re.findall(r"\\label\{[^}]*\}", text))) == 2
    assert (
        text.count(r"\begin{tabular}")
        == text.count(r"\end{tabular}")
        == text.count(r"\bottomrule")
        == 2
    )
    assert body.isascii()
    for tabular in text.split(r"\begin{tabular}")[1:]:
        width = len(re.match(r"\{l(r+)\}", tabular)[1])
        lines = [
            line
            for line in tabular.splitlines()
            if line.startswith(("SFKD", "ICODE", "Oracle", "Koopman"))
        ]
        assert {line.count("&") for line in lines} == {width}
    feedback = text.split(r"\end{tabular}")[0]
    bold = {
        line.split(" &")[0] for line in feedback.splitlines() if r"\textbf{18.0" in line
    }
    assert bold == {"SFKD $-$ contraction"}
    assert not re.search(r"(?m)^(Oracle|Nominal).*textbf", text)


def test_the_page_is_one_file_that_asks_for_nothing(table):
    directory, made = table
    page = text_of(directory, "index.html")
    assert made["report"] == str(directory / "report" / "index.html")
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(links) == len(made["figures"])
    assert sum(link.startswith("data:image/gif;base64,") for link in links) == 1
    assert all(link.startswith("data:image/") for link in links)
    assert re.search(r"https?://|url\(|@import|<script", page) is None
    assert len(page.encode()) < 5e6
    assert (
        re.search(
            r"\b(nan|None|null)\b",
            re.sub(r"<style>.*?</style>|base64,[^\"]*", "", page, flags=re.S),
        )
        is None
    )


def test_markdown_depends_on_the_results_alone_and_links_what_is_drawn(whole):
    directory, made = whole
    markdown = text_of(directory, "results.md")
    assert markdown == results_markdown(
        json.loads((directory / "results.json").read_text())
    )
    links = re.findall(r"\]\(([^)]*)\)", markdown)
    assert {
        f"results_files/{Path(figure).name}"
        for figure in made["figures"]
        if figure.endswith("png")
    } == set(links)
    assert all((directory / "report" / link).exists() for link in links)
    assert "data:" not in markdown
    widths = [
        {line.count(" | ") for line in table.splitlines()}
        for table in re.findall(r"(?m)(?:^\|.*\n)+", markdown)
    ]
    assert all(len(width) == 1 for width in widths)


def test_every_figure_is_drawn_once_and_those_of_the_table_not_again_in_its_studies(
    whole, table
):
    of_studies, of_table = (
        [Path(figure).name for figure in made["figures"]] for _, made in (whole, table)
    )
    assert of_studies == [
        "variations_kinematic_feedback_s3.png",
        "figure2_kinematic_feedback.png",
        "rmse_kinematic.png",
    ]
    assert of_table == [
        "rmse_kinematic.png",
        "figure1_kinematic.png",
        "s3_kinematic.gif",
    ]


def test_the_film_is_small_and_moves(table):
    file = Path(
        next(figure for figure in table[1]["figures"] if figure.endswith(".gif"))
    )
    assert file.stat().st_size <= MAX_BYTES
    with Image.open(file) as image:
        assert image.n_frames == 40
        assert image.info["duration"] == 100
        first = np.asarray(image.convert("RGB")).astype(int)
        image.seek(36)
        later = np.asarray(image.convert("RGB")).astype(int)
    assert np.mean(np.abs(first - later).max(axis=2) > 30) > 0.01


def test_figure_1_draws_stored_episodes_and_names_the_missing_ones(whole, tmp_path):
    (setup, _) = setups(document()["rows"])
    figure = deviations(whole[0], setup, "s3")
    drawn = {str(line.get_label()) for axes in figure.axes for line in axes.get_lines()}
    assert {
        "SFKD",
        "Oracle",
        "Nominal",
        "ICODE-MPPI (e)",
        "ICODE-MPPI, one step (e)",
        "Koopman MPC (no e)",
    } <= drawn
    assert not any("Neural ODE" in name for name in drawn)
    assert (
        figure._supxlabel.get_text()
        == "No driven episode of: Neural ODE (e), Neural ODE (no e)."
    )
    assert any(text.get_text() == "μ 0.6\nw −4 m/s" for text in figure.axes[0].texts)
    curve = next(
        line for line in figure.axes[0].get_lines() if line.get_label() == "SFKD"
    )
    assert len(curve.get_xdata()) == 40
    assert figure.axes[0].get_ylim()[1] > np.max(np.abs(curve.get_ydata()))
    assert len(deviations(tmp_path, setup, "s3").axes) == 1


def test_the_arrays_of_a_row_are_where_the_row_says(tmp_path):
    cell(tmp_path, "sfkd", "measured")
    (tmp_path / "cells/kinematic/s3/feedback/sfkd-measured.safetensors").rename(
        tmp_path / "elsewhere.safetensors"
    )
    rows = [row("sfkd", "measured")]
    assert film(tmp_path, rows, tmp_path / "s3.gif", seconds=0.5) is None
    rows = [row("sfkd", "measured", arrays="elsewhere.safetensors")]
    path, names = film(tmp_path, rows, tmp_path / "s3.gif", seconds=0.5)
    assert names == ["SFKD"]
    within, _ = film(
        tmp_path, rows, tmp_path / "corridor.gif", seconds=0.5, corridor=0.1
    )
    assert within.read_bytes() != path.read_bytes()


def test_variations_show_every_row_beside_itself_without_one(whole):
    rows = document()["rows"]
    study = study_of(document())
    (setup, plain) = setups(rows)
    (varied,) = variations(rows, setup, study)
    assert varied.columns == [
        "as it is",
        "environment 0.5 s late",
        "environment 1 s late",
        "sensor noise x 2",
    ]
    assert variations(rows, plain, study) == []
    result = tables_of(
        text_of(whole[0], "results.md"), f"Cost of a variation, S3: {FEEDBACK}"
    )
    assert result["Row"][1] == "environment 0.5 s late \\[mm\\]"
    assert result["Nominal"] == [
        "120.0",
        "180.0 (1.50)",
        "300.0 (2.50)",
        "150.0 (1.25), 2 left",
    ]
    assert set(result) == {"Row", *(line.name for line in setup.entries)}
    figure = variations_figure(varied)
    assert [axes.get_title(loc="left").replace("\n", " ") for axes in figure.axes][
        2
    ] == "sensor noise ×\u00a02"
    for axes, factor in zip(figure.axes, (1.5, 2.5, 1.25), strict=True):
        ends = [
            line.get_xdata()
            for line in axes.get_lines()
            if line.get_gid() and len(line.get_xdata()) == 2
        ]
        assert len(ends) == len(SYSTEMS)
        np.testing.assert_allclose([after / before for before, after in ends], factor)
    assert len({axes.get_xlim() for axes in figure.axes}) == 1


@pytest.mark.parametrize(
    ("system", "env", "name"),
    [
        ("icode", "measured", "ICODE (e)"),
        ("icode_mppi_reads_env", "measured", "ICODE-MPPI, reads e"),
        ("icode_extrinsic", "measured", "ICODE, f(s, u) + G(s, u) e"),
        ("icode_extrinsic", "none", "ICODE, f(s, u) + G(s, u) e (no e)"),
    ],
)
def test_a_row_says_once_that_it_observes_e(system, env, name):
    assert name_of({"system": system, "env": env}) == name


def test_every_training_of_a_row_is_drawn_and_listed():
    trained = {"sfkd": [0.018, 0.022], "oracle": [0.016, 0.016]}
    rows = [
        row(name, "measured", rmse_trainings_m=values)
        for name, values in trained.items()
    ]
    rows.append(row("icode_mppi", "measured"))  # trained once
    markdown = results_markdown({"rows": rows, "config": {"name": "seeds"}})
    result = tables_of(markdown, f"Single trainings: {FEEDBACK}")
    assert result == {
        "Row": ["S3 \\[mm\\], seed 0, 1"],
        "SFKD": ["18.0, 22.0 ± 2.8"],
        "ICODE-MPPI (e)": ["25.0"],
        "Oracle": ["16.0"],
    }
    assert "interval over trainings and episodes" in markdown
    strokes = [
        one
        for one in overview(setups(rows), Study()).axes[0].get_lines()
        if one.get_marker() == "|"
    ]
    np.testing.assert_allclose([one.get_xdata() for one in strokes], [[18.0, 22.0]])
    alone = [row(name, "measured") for name in trained]
    assert "Single trainings" not in results_markdown({"rows": alone})


def test_a_row_that_leaves_the_road_is_written_and_the_others_keep_the_axis():
    rows = [
        row("sfkd", "measured"),
        row("oracle", "measured"),
        row("nominal", "none", factor=60.0),
    ]
    (axes,) = overview(setups(rows), Study()).axes
    assert [text.get_text() for text in axes.texts] == ["7.2 m →"]
    assert axes.get_xlim()[1] < 30.0  # SFKD's 20 mm and their interval, not 7200
    assert "means beyond 1 m are written at the edge" in results_markdown(
        {"rows": rows, "config": {}}
    )
    assert "written at the edge" not in results_markdown(
        {"rows": rows[:2], "config": {}}
    )


def test_a_row_that_estimates_e_stands_beside_itself_with_e_measured():
    estimated = row("sfkd", "measured", factor=2.0) | {
        "env": "estimated",
        "variation": "environment estimated",
    }
    rows = [row("sfkd", "measured"), row("oracle", "measured"), estimated]
    (varied,) = variations(rows, setups(rows)[0], Study())
    assert {name: cells for name, *cells in variations_table(varied).rows} == {
        "SFKD": ["20.0", "40.0 (2.00)"],
        "Oracle": ["16.0", "–"],
    }


def test_a_row_that_only_another_contest_drove_adds_no_scenario():
    rows = [
        row("koopman_mpc", "measured", "s1"),
        row("sfkd", "measured", "s1"),
        row("sfkd", "measured", "s3"),
    ]
    rows.append(row("sfkd", "measured", "s3", sampling="plain"))
    assert [setup.scenarios for setup in setups(rows)] == [["s1", "s3"], ["s3"]]


def test_rows_are_grouped_by_access_to_e_and_sorted_by_rmse(whole):
    (setup, _) = setups(document()["rows"])
    figure = overview([setup], Study())
    shown = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    split = shown.index("observe neither")
    assert shown[0] == "observe friction and wind"
    assert shown[1:4] == ["Oracle", "SFKD − contraction", "SFKD"]
    assert shown[split + 1 :] == [
        "SFKD − fiber",
        "Neural ODE (no e)",
        "ICODE-MPPI (no e)",
        "Nominal",
        "Koopman MPC (no e)",
    ]
    places = [text.get_position()[1] for text in figure.axes[0].get_yticklabels()]
    assert places == sorted(places)
    own = next(
        text for text in figure.axes[0].get_yticklabels() if text.get_text() == "SFKD"
    )
    assert own.get_fontweight() == "bold"


def test_side_forces_are_in_a_table_and_in_a_figure_that_hold_the_same(whole):
    result = tables_of(text_of(whole[0], "results.md"), f"Side forces: {FEEDBACK}")
    assert result["Row"] == [r"RMSE \[mm\] 0 N", r"RMSE \[mm\] 500 N", "Left the lane"]
    assert result["SFKD"] == ["20.0", "–", "2 / 0"]
    forces = forces_of(setups(document()["rows"])[0])
    claimed = {name: cells for name, *cells in forces_tables(forces)[1].rows}
    assert claimed["SFKD"] == ["0 / 0", "10.0 / 10.0", "0 / 50.0", "0 / 0"]
    assert claimed["Nominal"] == ["–", "–", "0 / 50.0", "0 / 0"]
    assert forces.scenario == "s3"
    count = len(forces.entries)
    assert count == len(SYSTEMS) - 2  # the quadratic programs had no side forces
    panels = forces_figure(forces).axes
    shares = [line.get_xdata() for line in panels[1].get_lines() if line.get_gid()]
    np.testing.assert_allclose(shares, [[0.0, 50.0]] * count)
    radii = sorted(
        float(line.get_xdata()[0]) for line in panels[3].get_lines() if line.get_gid()
    )
    np.testing.assert_allclose(radii, [0.2] * count + [2.0])
    assert forces_of(setups(document()["rows"])[1]) is None


def emptied(value, hole):
    """Every number of a row replaced."""
    if isinstance(value, dict):
        return {key: emptied(entry, hole) for key, entry in value.items()}
    if isinstance(value, list):
        return [emptied(entry, hole) for entry in value]
    return (
        hole
        if isinstance(value, int | float) and not isinstance(value, bool)
        else value
    )


@pytest.mark.parametrize("hole", [None, math.nan, math.inf])
def test_what_was_not_measured_is_a_dash_and_never_a_zero(tmp_path, hole):
    results = document(samplings=("feedback",))
    results["rows"] = [
        emptied(entry | {"rmse_trainings_m": [0.1, 0.2]}, hole)
        for entry in results["rows"]
    ]
    markdown = results_markdown(results)
    result = tables_of(markdown, f"Tracking: {FEEDBACK}")
    assert {
        cell
        for name, cells in result.items()
        if name != "Row"
        for cell in cells
        if "±" not in cell
    } == {"–"}
    assert set(tables_of(markdown, "Cost and certificate")["SFKD"]) == {"–"}
    assert re.search(r"\b(nan|inf|None|null)\b", markdown) is None
    text = latex(setups(results["rows"]), study_of(results))
    assert r"\textbf" not in text
    overview(setups(results["rows"]), study_of(results))
    if hole is None:
        (tmp_path / "results.json").write_text(json.dumps(results))
        assert len(write_results_page(tmp_path)["figures"]) == 3


def test_rows_with_next_to_nothing_still_make_a_page(tmp_path):
    bare = {
        "system": "sfkd",
        "env": "measured",
        "scenario": "s3",
        "vehicle": "kinematic",
        "sampling": None,
    }
    (tmp_path / "results.json").write_text(json.dumps({"rows": [bare]}))
    made = write_results_page(tmp_path)
    assert "–" in Path(made["report"]).read_text("utf-8")
    (tmp_path / "results.json").write_text(json.dumps({"rows": []}))
    assert write_results_page(tmp_path)["figures"] == []
    assert not list((tmp_path / "report" / "results_files").iterdir())


def test_failed_rows_are_listed_with_their_reasons(tmp_path):
    markdown = results_markdown(
        document() | {"failed": {"dynamic/r2dn": "loss is not finite"}}
    )
    assert tables_of(markdown, "Rows that failed")["dynamic/r2dn"] == [
        "loss is not finite"
    ]
    with pytest.raises(ArtefactError, match=r"results\.json: missing"):
        write_results_page(tmp_path)


def test_the_page_says_how_to_reproduce_it(whole):
    markdown = text_of(whole[0], "results.md")
    assert "    python -m sfkd_jax.compare +experiment=table1\n" in markdown
    assert "| jax | 0.10.2 |" in markdown
    assert "The last run of the command took 1.5 minutes." in markdown
    assert "training seeds: 0, 1" in markdown


def test_the_same_results_give_the_same_bytes_and_no_stale_figure(whole):
    directory, made = whole
    before = text_of(directory, "index.html")
    (directory / "report" / "results_files" / "old.png").write_bytes(b"")
    assert write_results_page(directory) == made
    assert text_of(directory, "index.html") == before
    assert sorted(
        map(str, (directory / "report" / "results_files").iterdir())
    ) == sorted(made["figures"])


def test_sfkd_is_the_line_that_sees_the_environment():
    rows = [row("sfkd", "measured") | {"env": "none"}, row("sfkd", "measured")]
    assert setups(rows)[0].entry("sfkd").env == "measured"


def test_a_text_that_no_page_has_is_refused():
    with pytest.raises(ValueError, match=r"unknown comparison\.page\.titel; choose of"):
        study_of({}, {"titel": "A table"})
