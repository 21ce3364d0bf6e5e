"""The pages of a run and of a comparison."""

import html
import itertools
import json
import re
from types import SimpleNamespace

import jax.numpy as jnp
import matplotlib
import numpy as np
import pages_of_runs as made
import pytest
from PIL import Image, ImageSequence

from sfkd_jax.driving.lanes import Obstacles, lane_along
from sfkd_jax.driving.paths import path_through
from sfkd_jax.driving.simulation import Episode
from sfkd_jax.driving.simulation.metrics import METRICS, Metric
from sfkd_jax.report import figures, style, tables
from sfkd_jax.report.episodes import Episodes, by_road, of_rows
from sfkd_jax.report.film import Film, film_of
from sfkd_jax.report.lane_film import LaneFilm
from sfkd_jax.report.pages import to_latex
from sfkd_jax.report.run import write_report, write_results_page
from sfkd_jax.store import ArtefactError


@pytest.fixture(scope="module")
def run_page(tmp_path_factory):
    run = made.write_run(tmp_path_factory.mktemp("run"))
    write_report(run)
    return run / "report"


@pytest.fixture(scope="module")
def comparison_page(tmp_path_factory):
    directory = made.write_comparison(tmp_path_factory.mktemp("comparison"))
    write_results_page(directory)
    return directory / "report"


@pytest.fixture
def no_figures(monkeypatch):
    """For tests about words and numbers."""

    def save(path, draw, *inputs):
        path.write_bytes(b"no image")
        return path

    monkeypatch.setattr(style, "save", save)
    monkeypatch.setattr("sfkd_jax.report.run.film_of", lambda *_: None)


def words(home):
    """What a page says, with a bar between its cells."""
    text = (home / "index.html").read_text()
    return html.unescape(re.sub(r"(\s*<[^>]+>\s*)+", " | ", text))


# ---- every page


def test_pages_refer_to_themselves_and_to_films_beside_them(run_page, comparison_page):
    for home in (run_page, comparison_page):
        text = (home / "index.html").read_text()
        found = re.findall(r'(?:src|href)="(?!data:image/png;)([^"]*)', text)
        assert found
        for name in found:
            assert re.fullmatch(r"figures/film(_\d)?\.gif", name)
            assert (home / name).exists()
        assert text.count("<img") == len(re.findall(r'<img alt="[^"]+"', text))
        assert "<script" not in text


def test_the_same_files_give_the_same_bytes_whatever_the_user_set(tmp_path, run_page):
    again = made.write_run(tmp_path / "run")
    with matplotlib.rc_context({"axes.grid": False, "font.size": 3}):
        write_report(again)
    for old in run_page.rglob("*.*"):
        assert (again / "report" / old.relative_to(run_page)).read_bytes() == (
            old.read_bytes()
        ), old.name


def test_a_new_metric_is_on_every_page(tmp_path, monkeypatch, no_figures):
    """It has a table of its own, of which no page has heard."""
    new = Metric(
        "novelty", "Novelty", "kg", "a new table", lambda value: f"{value} new"
    )
    monkeypatch.setattr(tables, "METRICS", (*METRICS, new))
    own = [made.row("sfkd", novelty=7), made.row("oracle", novelty=8)]
    run = made.write_run(tmp_path / "run", episodes=False, results={"rows": own})
    compared = made.write_comparison(tmp_path / "compared", episodes=False, rows=own)
    write_report(run)
    write_results_page(compared)
    for page in ("run/report", "compared/report"):
        text = (tmp_path / page / "index.html").read_text()
        assert "Novelty [kg]" in text
        assert "7 new" in text


HOSTILE = "<b>$\\frac|*a*_[x](y)</b>"


def test_hostile_names_are_text_on_every_page(tmp_path):
    odd = made.row("sfkd") | {
        "system": HOSTILE,
        "vehicle": HOSTILE,
        "scenario": HOSTILE,
    }
    settings = {"experiment": HOSTILE, "model": {"system": HOSTILE}}
    run = made.write_run(
        tmp_path / "run",
        episodes=False,
        policy={"config": settings},
        results={"rows": [odd]},
    )
    compared = made.write_comparison(
        tmp_path / "compared", episodes=False, rows=[odd], name=HOSTILE
    )
    write_report(run)
    write_results_page(compared)
    for page in (run / "report/index.html", compared / "report/index.html"):
        assert "<b>" not in page.read_text()
        assert "&lt;b&gt;" in page.read_text()
    table = (compared / "report/table1.tex").read_text()
    assert r"<b>\$\textbackslash frac" in table


def test_enemy_numbers_become_dashes_or_numbers(tmp_path):
    odd = [
        made.row("sfkd", rmse_m={"mean": value, "std": value, "ci95": [value, value]},
                 max_deviation_m=value, inner_loop=str(value))
        for value in (None, 1e308, 5e-324, 0.0, -0.1, "x")
    ]  # fmt: skip
    run = made.write_run(tmp_path / "r", episodes=False, results={"rows": odd})
    write_report(run)
    compared = made.write_comparison(tmp_path / "c", episodes=False, rows=odd)
    write_results_page(compared)
    for page in (run, compared):
        text = (page / "report/index.html").read_text()
        assert not re.search(r"<td>[^<]*\b(nan|inf)\b", text)


# ---- the page of a run


def test_the_certificate_is_in_words_and_numbers_that_never_round_down(run_page):
    text = words(run_page)
    for cell in (
        "| Contraction of one step, α | 0.9321 | proved |",
        "| 0.1431 | measured, unsigned |",
        "| One-step error d̄ [latent] | 0.0123 | measured, unsigned |",
        "| Asymptotic bound d̄ / (1 − α) [latent] | 0.1812 | proved from d̄ |",
        "| env: lateral wind [m/s] | −8 | 8 |",
        "| 8 to 10.5 |",
        "| command | python -m sfkd_jax.train |",
    ):
        assert cell in text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"valid": False, "reason": "ρ is 1.2"}, "ρ is 1.2"),
        ({"alpha": 1.0}, "no reason"),
        ({"weights": "cd" * 32}, "other weights"),
    ],
)
def test_what_is_not_certified_is_said(tmp_path, no_figures, change, reason):
    run = made.write_run(
        tmp_path, episodes=False, certificate=made.certificate(**change)
    )
    write_report(run)
    text = words(run / "report")
    assert "No contraction is certified" in text
    assert reason in text
    assert "0.1431" not in text


def test_the_page_believes_no_signature_that_it_has_not_checked(tmp_path, no_figures):
    signature = {"public_key": "ab" * 32, "value": "00"}
    run = made.write_run(
        tmp_path, episodes=False, certificate=made.certificate(signature=signature)
    )
    write_report(run)
    text = words(run / "report")
    assert f"measured, signed by {'ab' * 32} |" not in text
    assert "which is not checked" in text or "measured, unsigned: the signature" in text


def test_a_page_of_a_new_run_names_the_commands_that_come_next(tmp_path, no_figures):
    run = made.write_run(
        tmp_path, episodes=False, results=None, certificate=None, open_loop=None
    )
    write_report(run)
    text = words(run / "report")
    for command in ("evaluate", "certify", "train"):
        assert f"python -m sfkd_jax.{command} makes it" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"open_loop": {"steps": ["one"]}}, "open_loop.json"),
        ({"results": {"rows": "word"}}, "results.json: malformed"),
        ({"results": {"rows": [1]}}, "results.json: malformed"),
        ({"results": {"rows": 7}}, "results.json: malformed"),
    ],
)
def test_a_file_that_does_not_fit_is_named(tmp_path, changes, message):
    with pytest.raises(ArtefactError, match=r"policy\.safetensors is missing"):
        write_report(tmp_path)
    run = made.write_run(tmp_path, episodes=False, **changes)
    with pytest.raises(ArtefactError, match=re.escape(message)):
        write_report(run)


def test_a_row_cannot_name_arrays_outside_its_folder(tmp_path):
    own = [made.row("sfkd", arrays="../outside.safetensors")]
    directory = made.write_comparison(tmp_path, episodes=False, rows=own)
    with pytest.raises(ArtefactError, match="outside this folder"):
        write_results_page(directory)


# ---- figures and films


def groups(tmp_path, **lateral):
    run = made.write_run(tmp_path)
    rows = json.loads((run / "results.json").read_text())["rows"]
    (group,) = by_road(of_rows(run, rows))
    return [one._replace(**lateral) for one in group]


def test_a_system_that_leaves_the_road_does_not_flatten_the_others(tmp_path):
    figure = figures.first_episode(
        [one._replace(lateral=100 * one.lateral) if one.system == "nominal" else one
         for one in groups(tmp_path)]
    )  # fmt: skip
    assert figure.axes[0].get_ylim()[1] < 3.0


def test_figures_of_states_that_are_not_finite(tmp_path):
    group = groups(tmp_path)
    broken = group[0].lateral.copy()
    broken[:, 40:] = np.nan
    group[0] = group[0]._replace(lateral=broken)
    style.save(tmp_path / "a.png", figures.first_episode, group)
    errors = figures.first_episode(group).axes[0]
    missing = [np.isnan(line.get_ydata()) for line in errors.lines]
    (broken_line,) = (one for one in missing if one.any())
    # It is drawn until it breaks, and does not set the scale.
    assert broken_line[40:].all()
    assert not broken_line[:40].any()
    assert np.isfinite(errors.get_ylim()).all()


def film(size, corridor=None, cars=1, **changes):
    one = made.arrays(size) | changes
    first = (one[name][0] for name in ("states", "envs", "path"))
    car = Episodes(made.row("sfkd"), made.DT, one["lateral"], *first)
    return Film([car] * cars, made.STEPS, corridor)


def test_a_film_runs_in_real_time_and_is_small(tmp_path):
    path = film_of(tmp_path / "a.gif", film(0.05).cars, 0.1)
    with Image.open(path) as image:
        assert image.n_frames == made.STEPS / 2
        assert image.info["duration"] == 200
        assert image.info["loop"] == 0
        # The car drives and the wind turns: no frame is like the one before.
        frames = [
            np.asarray(one.convert("RGB")) for one in ImageSequence.Iterator(image)
        ]
    assert all(np.any(a != b) for a, b in itertools.pairwise(frames))
    assert path.stat().st_size < 2e6


def test_a_film_of_cars_that_leave_or_break(tmp_path):
    states, lateral = made.arrays()["states"], np.zeros((1, made.STEPS))
    states[:, 10:], lateral[:, 9:] = np.nan, np.nan
    nominal = film(2.0, states=states, lateral=lateral).cars[0]
    nominal = nominal._replace(row=made.row("nominal", "none"))
    assert film_of(tmp_path / "a.gif", [*film(2.0).cars, nominal])


def test_a_film_of_a_lane_shows_what_stands_in_it_and_when_it_brakes():
    def pixels(present=True, slower=0.0):
        """How many of the last frame are an obstacle, and how many are orange."""
        path = path_through(jnp.asarray([[0.0, 0.0], [60.0, 0.0]]))
        box = Obstacles(
            jnp.asarray([[[15.0, 1.0]]]),
            *(jnp.asarray(one) for one in ([0.3], [[2.0, 1.0]], [0.5], [present])),
        )
        steps, ahead = 4, np.arange(1.0, 21.0)
        window = np.stack([ahead, 0 * ahead, 0 * ahead, 10 - slower * ahead], axis=1)
        along = np.arange(steps)[:, None, None] * np.eye(4)[0]
        signals = {"reference": window + along}
        signals |= dict.fromkeys(("corridor", "clearance"), np.full(steps, 0.12))
        states = np.arange(5)[:, None] * np.eye(7)[0] + 10.0 * np.eye(7)[3]
        road = SimpleNamespace(envs=np.full((steps, 2), [0.3, 8.0]))
        road.course = lane_along(path, width=8.0), box
        made = Episode(states, 0, 0, np.arange(1.0, 5.0), signals)
        *_, last = LaneFilm(road, made, dt=0.1, car=(2.25, 1.0)).frames()
        colours = (0x57, 0x60, 0x6A), (0xD5, 0x5E, 0x00)
        return [np.all(np.asarray(last) == one, axis=2).sum() for one in colours]

    (solid, calm), (none, _), (_, braking) = pixels(), pixels(False), pixels(slower=0.2)
    assert solid > none + 500
    assert braking > calm + 20


# ---- the page of a comparison


def test_rows_that_do_not_sample_are_compared_with_every_search():
    plain = [made.row("sfkd", sampling="plain"), made.row("oracle", sampling="plain")]
    around = [made.row("sfkd"), made.row("oracle")]
    program = made.row("koopman_mpc")
    made_of = tables.grouped([*plain, program, *around], ("inner_loop", "sampling"))
    names = [[tables.name_of(row) for row in group] for group in made_of]
    assert names == [["SFKD", "Koopman MPC (e)", "Oracle"]] * 2
    assert [group[0]["sampling"] for group in made_of] == ["feedback", "plain"]
    assert tables.grouped([program], ("sampling",)) == [[program]]


@pytest.mark.parametrize(
    ("record", "side"),
    [
        ({"mean": 1.0, "ci95": [0.5, 1.5], "p_holm": 0.049}, 1),
        ({"mean": -1.0, "ci95": [-1.5, -0.5], "p_holm": 0.049}, -1),
        ({"mean": 1.0, "ci95": [0.5, 1.5], "p_holm": 0.05}, 0),
        ({"mean": -1.0, "ci95": [-1.5, -0.5]}, -1),
        ({"mean": 1.0, "ci95": [-0.5, 1.5]}, 0),
        ({"mean": float("nan"), "ci95": [0.5, 1.5]}, 0),
        (None, 0),
    ],
)
def test_a_mark_needs_a_corrected_p_value(record, side):
    assert tables.side(record) == side
    cell = tables.rmse_cell(made.row("oracle", difference_to_sfkd=record))
    assert cell.endswith({1: ") *", -1: ") †", 0: ")"}[side])


def test_printed_numbers_and_failures_are_on_the_page(tmp_path, no_figures):
    paper = {"columns": ["rmse_s3_m", "violation_rate"], "sfkd": [0.12, 0.03]}
    directory = made.write_comparison(
        tmp_path, episodes=False, comparison={"paper": paper}
    )
    document = json.loads((directory / "results.json").read_text())
    document["failed"] = {"kinematic/icode": "diverged at step 7"}
    (directory / "results.json").write_text(json.dumps(document))
    write_results_page(directory)
    text = words(directory / "report")
    assert "| SFKD | 0.12 | 0.03 |" in text
    assert "diverged at step 7" in text


def test_latex_has_a_cell_for_every_column_and_balanced_braces(comparison_page):
    table = (comparison_page / "table1.tex").read_text()
    assert table.count("{") == table.count("}")
    body = re.search(r"\\midrule\n(.*)\\bottomrule", table, re.S)
    assert body is not None
    lines = body[1].strip().splitlines()
    assert len(lines) == len(made.RMSE)
    assert {line.count("&") for line in lines} == {4}
    assert r"\multicolumn{2}{c}{kinematic}" in table
    assert to_latex([]).count("tabular") == 0
