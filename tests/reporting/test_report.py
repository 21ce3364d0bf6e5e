import html
import json
import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import ClassVar

import matplotlib
import numpy as np
import pytest
from helpers import write_policy
from PIL import Image

from sfkd_jax.evaluation.formats import upper
from sfkd_jax.evaluation.metrics import METRICS, Metric
from sfkd_jax.paper import beside_the_paper
from sfkd_jax.paper._side_forces import violations
from sfkd_jax.reporting import write_report
from sfkd_jax.reporting._certificate import tube_on_drive
from sfkd_jax.reporting.scene import scenes_of
from sfkd_jax.store import ArtefactError, read_arrays, write_arrays

STEPS, DT, EPISODES, SPEED = 600, 0.1, 4, 10.0
LEVELS = ((0.9, 0.0), (0.6, 4.0), (0.3, 8.0), (0.6, -4.0))
SYSTEMS = {
    "sfkd": 0.09,
    "oracle": 0.04,
    "nominal": 0.33,
}  # how far a gust pushes each, in metres


def road():
    s = np.arange(1400) * 0.5
    blend = np.clip(s / 20, 0, 1) ** 2
    curvature = blend * (
        0.012 * np.sin(2 * np.pi * s / 90) + 0.01 * np.sin(2 * np.pi * s / 151 + 1.0)
    )
    yaw = np.cumsum(curvature) * 0.5
    x, y = np.cumsum(np.cos(yaw)) * 0.5, np.cumsum(np.sin(yaw)) * 0.5
    return np.stack([x, y, yaw, curvature], axis=1)


def drive(rng, path, envs, gain):
    """A damped response of the lateral deviation to curvature and wind, and the state
    that belongs to it.
    """
    lateral, rate, rows, steer = 0.0, 0.0, [], []
    for step in range(STEPS):
        friction, wind = envs[step]
        push = gain * (
            wind / 8
            + 0.3 * (0.9 - friction) * np.sign(path[20 * (step // 10) % 1300, 3])
        )
        rate += (
            DT * (6.0 * (push - lateral) - 3.5 * rate)
            + gain * 0.02 * rng.standard_normal()
        )
        lateral += DT * rate
        rows.append(lateral)
        steer.append(
            2.7 * path[2 * step + 8, 3]
            - 0.12 * lateral
            - 0.05 * rate
            + 0.004 * rng.standard_normal()
        )
    lateral = np.array(rows)
    here = path[2 * np.arange(STEPS + 1)]
    offset = np.concatenate([[0.0], lateral])
    x, y = (
        here[:, 0] - offset * np.sin(here[:, 2]),
        here[:, 1] + offset * np.cos(here[:, 2]),
    )
    states = np.stack([x, y, here[:, 2], np.full(STEPS + 1, SPEED)], axis=1)
    controls = np.stack([steer, 0.2 * rng.standard_normal(STEPS)], axis=1)
    return lateral, states, controls


@cache
def episodes():
    rng = np.random.default_rng(0)
    roads = np.stack([road()] * EPISODES)
    visit = np.arange(STEPS) // round(3.0 / DT)
    envs = []
    for _ in range(EPISODES):
        sides = rng.choice([-1.0, 1.0], visit[-1] + 1)
        levels = np.array(LEVELS)[visit % 4]
        envs.append(np.stack([levels[:, 0], levels[:, 1] * sides[visit]], axis=1))
    arrays = {"dt": np.float64(DT), "s3/envs": np.array(envs), "s3/path": roads}
    for name, gain in SYSTEMS.items():
        driven = [drive(rng, roads[i], envs[i], gain) for i in range(EPISODES)]
        for kind, values in zip(
            ("lateral", "states", "controls"), zip(*driven, strict=True), strict=True
        ):
            arrays[f"{name}/s3/{kind}"] = np.array(values, dtype=np.float32)
    return arrays


def score(system, scenario, mean, std, ratio, **more):
    env = "none" if system == "nominal" else "measured"
    rmse = {
        "mean": mean,
        "std": std,
        "ci95": [mean - 0.002, mean + 0.002],
        "median": mean,
        "p95": mean + 0.01,
    }
    difference = {"mean": mean - 0.034, "ci95": [mean - 0.036, mean - 0.032]}
    return {
        "system": system, "model": system, "controller": "mppi", "sampling": "feedback", "env": env,
        "scenario": scenario, "vehicle": "kinematic", "seeds": [0], "episodes": EPISODES, "episode_s": 60.0,
        "rmse_m": rmse, "max_deviation_m": 4 * mean, "rmse_after_switch_m": 1.2 * mean,
        "smoothness_rad_per_s": 0.081, "violation": {"v0": 0, "v1": None, "v1_radius_m": None, "v2": 0.0},
        "departures": 0, "ess": 41.7, "act_ms": {"p50": 3.21, "p99": 4.5}, "ratio_to_oracle": ratio,
        "difference_to_sfkd": None if system == "sfkd" else difference, "params": 12345,
    } | more  # fmt: skip


def documents():
    rows = [
        *(
            score(*row)
            for row in (
                ("oracle", "s3", 0.0163, 0.002, 1.0),
                ("nominal", "s3", 0.12, 0.021, 7.36),
            )
        ),
        score("sfkd", "s3", 0.0342, 0.006, 2.1),
        *(
            score(*row)
            for row in (
                ("sfkd", "s1", 0.014, 0.001, 1.0),
                ("oracle", "s1", 0.014, 0.001, 1.0),
            )
        ),
    ]
    ahead = list(range(1, 21))
    radii = [0.0123 * (1 - 0.9321**k) / (1 - 0.9321) for k in ahead]
    bound = {
        "value": 0.0123,
        "level": 0.95,
        "trajectories": 400,
        "coverage": 0.957,
        "coverage_ci95": [0.93, 0.98],
    }
    boxes = {
        "state": [[0.0], [15.0]],
        "control": [[-0.4, 0.0], [0.45, 14.0]],
        "env": [[0.3, -8], [0.9, 8]],
    }
    certificate = {
        "valid": True, "reason": None, "mode": "joint", "scope": "construction", "alpha": 0.93207,
        "alpha_separate": 0.95, "rho": 0.9, "beta": 0.05, "kappa": 1.0, "decoder_lipschitz": 2.5,
        "transport_lipschitz": 1.0, "tightness": 1.18, "attack": 0.79, "weights_sha256": "ab" * 32,
        "tube": {"latent": radii, "physical": {"position_m": [9.0, 0.8765]}, "ultimate": 0.18115},
        "d_bar": bound, "boxes": boxes, "seconds": 3.2,
    }  # fmt: skip
    settings = {
        "experiment": "s3", "seed": 0, "vehicle": {"name": "kinematic", "inner_loop": "speed", "dt": 0.1},
        "model": {"name": "sfkd", "system": "sfkd", "rank": 32, "alpha_max": 0.995, "hidden": [64, 64]},
        "training": {"steps": 4000, "batch": 256, "learning_rate": 3e-3}, "dataset": {"segments": 8000},
        "controller": {"name": "mppi", "samples": 1500, "horizon": 20, "temperature": None},
    }  # fmt: skip
    errors = {
        "steps": ahead, "dt": 0.1, "trajectories": 320,
        "position_rmse_m": [0.0011 * k**2 for k in ahead], "longitudinal_rmse_m": [k**2 / 1e3 for k in ahead],
        "lateral_rmse_m": [0.0004 * k**2 for k in ahead], "yaw_rmse_rad": [0.0009 * k for k in ahead],
        "speed_rmse_m_per_s": [0.004 * k for k in ahead],
    }  # fmt: skip
    return {
        "policy.json": {
            "settings": settings,
            "versions": {"python": "3.11.9", "jax": "0.10.2"},
        },
        "open_loop.json": errors,
        "certificate.json": certificate,
        "results.json": {"rows": rows, "config": {}, "versions": {}, "seconds": 60.0},
    }


def metrics():
    rng = np.random.default_rng(1)
    for step in range(50, 4001, 50):
        loss = 0.02 + 3.0 * np.exp(-step / 500) * np.exp(0.15 * rng.standard_normal())
        line = {
            "step": step,
            "seconds": step * 0.05,
            "loss": loss,
            "learning_rate": 3e-3,
            "alpha": 0.93,
        }
        yield line | ({"validation_loss": 1.1 * loss} if step % 500 == 0 else {})


def write_run(run, **changes):
    """A whole run; `results={...}` replaces results.json, `results=None` leaves it out."""
    run.mkdir(parents=True, exist_ok=True)
    for name, document in documents().items():
        document = changes.get(name.removesuffix(".json"), document)
        if document is not None and name == "policy.json":
            write_policy(run, document)
        elif document is not None:
            (run / name).write_text(json.dumps(document))
    if "metrics" not in changes:
        (run / "metrics.jsonl").write_text(
            "".join(json.dumps(line) + "\n" for line in metrics())
        )
    if "episodes" not in changes:
        write_arrays(
            run / "episodes.safetensors", episodes(), kind="episodes", config={}
        )
    return run


def text_of(page):
    """What a reader sees of a page, spaces made plain."""
    return " ".join(
        html.unescape(
            re.sub(r"<style>.*?</style>|<[^>]+>", " ", page, flags=re.S)
        ).split()
    )


def report_of(run):
    made = write_report(run, studies=beside_the_paper)
    return Path(made["report"]).read_text("utf-8"), made


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return report_of(write_run(tmp_path_factory.mktemp("whole")))


class Balanced(HTMLParser):
    """Checks that every element is closed in order, and collects what could make a
    request.
    """

    VOID: ClassVar = {"meta", "img", "br"}

    def __init__(self):
        super().__init__()
        self.open, self.links, self.tags = [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [
            value
            for name, value in attrs
            if name in ("src", "href", "srcset", "action", "data")
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_every_section_and_number_is_there(whole):
    page = text_of(whole[0])
    for heading in (
        "How it drives", "What is certified", "How it predicts", "How it was trained", "How to make it again",
        "Settings", "Versions", "Scenario S1", "Scenario S3",
    ):  # fmt: skip
        assert heading in page
    assert "missing" not in page
    for number in (
        "0.034 ± 0.006", "0.032 to 0.036", "0.137", "2.10", "0.120 ± 0.021", "7.36", "0.086", "0.081",
        "0.0840 to 0.0880", "0.9321", "0.1812", "0.0275", "0.1100", "0.4400", "0.957", "0.930 to 0.980",
        "position [m] 0.8765", "steering −0.4 to 0.45 rad, acceleration or commanded speed 0 to 14",
        "speed 0 to 15 m/s", "friction 0.3 to 0.9, side wind −8 to 8 m/s", "4000 steps", "jax 0.10.2",
        "learning_rate 0.003", "Control step, median 3.2 ms", "Effective samples", "42 3.21 4.50",
        "a new control is due every 100 ms",
    ):  # fmt: skip
        assert number in page, number
    assert page.count("python -m sfkd_jax.train +experiment=s3 seed=0") == 1
    assert "Proved." in page
    assert "Measured, not proved." in page
    assert "Nothing is claimed outside the boxes" in page


def test_the_papers_figure_is_named_as_such_and_only_where_it_has_one(whole):
    page = text_of(whole[0])
    assert "0.120 ± 0.018 m reported by the paper, other simulator" in page
    assert page.count("reported by the paper") == 1


def test_markdown_says_the_same(whole):
    text = Path(whole[1]["report"]).with_name("report.md").read_text("utf-8")
    assert "| **SFKD** | **0.034 ± 0.006** |" in text
    for target in re.findall(r"\]\((figures/[^)]+)\)", text):
        assert (
            Path(whole[1]["report"])
            .with_name("figures")
            .joinpath(Path(target).name)
            .exists()
        )
    assert "    python -m sfkd_jax.train +experiment=s3 seed=0" in text
    widths = [
        {line.count(" | ") for line in table.splitlines()}
        for table in re.findall(r"(?m)(?:^\|.*\n)+", text)
    ]
    assert widths
    assert all(len(width) == 1 for width in widths)


def test_the_page_is_one_file_that_asks_for_nothing(whole):
    page, made = whole
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert not parser.tags & {"script", "link", "iframe", "object", "base", "form"}
    assert len(parser.links) == len(made["figures"])
    assert all(link.startswith("data:image/png;base64,") for link in parser.links)
    assert re.search(r"https?://|url\(|@import", page) is None
    assert "default-src 'none'" in page
    assert 'name="viewport"' in page
    assert "@media print" in page
    assert len(page) < 5e6


def test_figures_are_pictures(whole):
    names = [Path(figure).name for figure in whole[1]["figures"]]
    assert names == [
        "deviation_s3.png", "episodes_s3.png", "track_s3.png", "steering_s3.png", "tube.png",
        "tube_on_drive.png", "open_loop.png", "learning.png",
    ]  # fmt: skip
    for figure in whole[1]["figures"]:
        with Image.open(figure) as image:
            pixels = np.asarray(image.convert("RGB"))
        assert pixels.shape[0] > 300, figure
        assert pixels.shape[1] > 900, figure
        assert len({tuple(pixel) for pixel in pixels[::7, ::5].reshape(-1, 3)}) > 20, (
            figure
        )


def test_the_same_run_gives_the_same_bytes_and_no_stale_figure(tmp_path):
    run = write_run(tmp_path)
    first = report_of(run)[0]
    (run / "report" / "figures" / "old.png").write_bytes(b"")
    assert report_of(run)[0] == first
    assert not (run / "report" / "figures" / "old.png").exists()


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("metrics.jsonl", "train"), ("open_loop.json", "train"), ("certificate.json", "certify"),
        ("results.json", "evaluate"), ("episodes.safetensors", "evaluate"),
    ],
)  # fmt: skip
def test_a_missing_input_is_named_with_the_command_that_makes_it(
    tmp_path, name, command
):
    run = write_run(tmp_path)
    (run / name).unlink()
    page = text_of(report_of(run)[0])
    assert f"{name} is missing" in page
    assert page.count(" is missing from this run") == 1
    assert f"that makes it: python -m sfkd_jax.{command} +experiment=s3 seed=0" in page


def test_a_policy_alone_is_enough_and_no_policy_is_refused(tmp_path):
    with pytest.raises(ArtefactError, match=r"sfkd_jax\.train"):
        write_report(tmp_path)
    settings = documents()["policy.json"]["settings"] | {
        "experiment": "default",
        "seed": 3,
    }
    settings["model"] = {"name": "sfkd", "system": "sfkd_soft"}
    write_policy(tmp_path, {"config": settings})
    page, made = report_of(tmp_path)
    assert made["figures"] == []
    assert text_of(page).count(" is missing from this run") == 5
    assert "python -m sfkd_jax.train model=sfkd_soft seed=3" in text_of(page)


def nulled(value):
    """The same document with every number null, as what is not finite is written."""
    if isinstance(value, dict):
        return {
            key: entry if key in ("episodes", "steps") else nulled(entry)
            for key, entry in value.items()
        }
    if isinstance(value, list):
        return [nulled(entry) for entry in value]
    return value if isinstance(value, str | bool) else None


@pytest.mark.parametrize("name", ["results", "certificate", "open_loop"])
def test_nulls_read_as_an_en_dash(tmp_path, name):
    document = nulled(documents()[f"{name}.json"])
    page = text_of(report_of(write_run(tmp_path, episodes=None, **{name: document}))[0])
    assert "–" in page
    assert re.search(r"\b(nan|inf|None|null)\b", page) is None


def test_absent_keys_and_empty_lists_do_not_stop_a_report(tmp_path):
    rows = [
        {"system": "sfkd", "scenario": "s3"},
        {"system": "koopman_mpc", "scenario": "s3", "sampling": None},
    ]
    certificate = {
        "valid": False,
        "reason": "alpha = 1.02 is not below 1",
        "alpha": 1.02,
    }
    run = write_run(
        tmp_path,
        results={"rows": rows},
        certificate=certificate,
        open_loop={"steps": []},
    )
    page = text_of(report_of(run)[0])
    assert (
        "Nothing is proved. No contraction is certified for these weights: alpha = 1.02 is not below 1."
        in page
    )
    assert "It has no valid certificate." in page
    assert "Certified α" not in page
    assert "Koopman MPC" in page
    assert "open_loop.json is missing" in page


def test_a_certificate_of_other_weights_is_not_believed(tmp_path):
    mine = documents()["policy.json"] | {"sha256": "ab" * 32}
    page = text_of(report_of(write_run(tmp_path, episodes=None, policy=mine))[0])
    assert "Certified α 0.9321" in page
    page = text_of(
        report_of(
            write_run(tmp_path, episodes=None, policy=mine | {"sha256": "cd" * 32})
        )[0]
    )
    assert "Nothing is proved." in page
    assert "about other weights" in page
    assert "0.9321" not in page


def test_text_of_others_is_escaped(tmp_path):
    hostile = "<script>alert(1)</script>\"'&|](http://x.example)"
    documents_ = documents()
    policy = documents_["policy.json"]
    policy["settings"] |= {"experiment": hostile, "note": hostile, hostile: 1}
    policy["settings"]["vehicle"]["name"] = hostile
    policy["versions"][hostile] = hostile
    rows = [
        score(hostile, hostile, 0.1, 0.01, 1.0, vehicle=hostile),
        *documents_["results.json"]["rows"],
    ]
    certificate = documents_["certificate.json"] | {"mode": hostile, "scope": hostile}
    page, made = report_of(
        write_run(
            tmp_path, policy=policy, results={"rows": rows}, certificate=certificate
        )
    )
    assert "<script" not in page
    assert hostile in html.unescape(page)
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert all(link.startswith("data:") for link in parser.links)
    text = Path(made["report"]).with_name("report.md").read_text("utf-8")
    prose = re.sub(r"(?m)^    .*$", "", text)  # indented: code, taken literally
    assert "<script" not in prose
    assert re.search(r"(?<!\\)\]\(http", prose) is None


def test_names_are_not_formulas(tmp_path):
    run, name = write_run(tmp_path), "$\\frac{"
    arrays = dict(episodes())
    arrays |= {
        f"{name}/s3/{part}": arrays[f"oracle/s3/{part}"]
        for part in ("lateral", "states", "controls")
    }
    arrays |= {f"a$x_$b/{name}/lateral": arrays["oracle/s3/lateral"][:, :50]}
    write_arrays(run / "episodes.safetensors", arrays, kind="episodes", config={})
    assert len(report_of(run)[1]["figures"]) == 9


def test_naive_baselines_stand_beside_the_model(tmp_path):
    errors = documents()["open_loop.json"]
    naive = {"position_rmse_m": [0.01 * k for k in errors["steps"]]}
    errors |= {"baselines": {"constant_velocity": naive, "kinematic_bicycle": {}}}
    made = report_of(write_run(tmp_path, episodes=None, open_loop=errors))[1]
    text = Path(made["report"]).with_name("report.md").read_text("utf-8")
    head = "| Steps ahead | Model | Constant velocity | Kinematic bicycle |"
    assert head in text
    assert "| 20 | 0.4400 | 0.2000 | – |" in text


def test_a_metric_of_the_table_is_a_column_of_the_page(tmp_path, monkeypatch):
    new = Metric("largest_steering_rad", "Largest steering", "rad", "tracking")
    monkeypatch.setattr("sfkd_jax.evaluation.metrics.METRICS", (*METRICS, new))
    rows = documents()["results.json"]["rows"]
    for row in rows:
        row["largest_steering_rad"] = 0.23456
    made = report_of(write_run(tmp_path, episodes=None, results={"rows": rows}))[1]
    text = Path(made["report"]).with_name("report.md").read_text("utf-8")
    assert r"Largest steering \[rad\]" in text
    assert "0.235" in text


def test_a_cut_off_log_a_lost_vehicle_and_one_short_episode(tmp_path):
    run = write_run(tmp_path)
    with (run / "metrics.jsonl").open("a") as log:
        log.write('{"step": 4050, "lo')
    archive, _ = read_arrays(run / "episodes.safetensors", kind="episodes")
    arrays = {
        name: values[:1] if values.ndim else values for name, values in archive.items()
    }
    for part in ("lateral", "states", "controls"):
        arrays[f"nominal/s3/{part}"] = arrays[f"nominal/s3/{part}"].copy()
        arrays[f"nominal/s3/{part}"][:, 90:] = np.nan
    arrays |= {
        "icode/s1/lateral": arrays["sfkd/s3/lateral"][:, :40],
        "someone/s1/lateral": np.zeros((0, 40)),
    }
    write_arrays(run / "episodes.safetensors", arrays, kind="episodes", config={})
    page, made = report_of(run)
    assert "4000 steps" in text_of(page)
    assert "deviation_s1.png" in {Path(figure).name for figure in made["figures"]}


def test_a_baseline_that_wins_is_named(tmp_path):
    rows = [
        *documents()["results.json"]["rows"],
        score("icode", "s3", 0.021, 0.001, 1.3),
    ]
    page = text_of(
        report_of(write_run(tmp_path, episodes=None, results={"rows": rows}))[0]
    )
    assert "ICODE does better here, with 0.021 m." in page


def test_feedback_and_plain_sampling_are_not_mixed(tmp_path):
    rows = documents()["results.json"]["rows"]
    rows += [
        row | {"sampling": "plain", "rmse_m": {"mean": 0.068}}
        for row in rows
        if row["system"] == "sfkd"
    ]
    page = text_of(
        report_of(write_run(tmp_path, episodes=None, results={"rows": rows}))[0]
    )
    assert "plain sampling" in page
    assert "to a lateral RMSE of 0.034 m" in page


def test_the_tube_is_drawn_about_the_states_that_follow_one_that_was_driven(tmp_path):
    write_arrays(
        tmp_path / "episodes.safetensors", episodes(), kind="episodes", config={}
    )
    (scene,) = scenes_of(tmp_path)
    radii = [0.1, 0.4, 0.9, 1.6, 2.5]
    above, below = tube_on_drive(scene, "sfkd", radii, [0.01, None, 0.02]).axes
    discs = {disc.radius: np.array(disc.center) for disc in above.patches}
    assert sorted(discs) == radii
    (way,) = [
        line.get_xydata()
        for line in above.get_lines()
        if len(line.get_xydata()) == 1 + len(radii)
    ]
    np.testing.assert_allclose([discs[radius] for radius in radii], way[1:])
    np.testing.assert_allclose(way[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(way[-1, 1], 0.0, atol=1e-6)
    steps = np.linalg.norm(np.diff(scene.states["sfkd"][:, :2], axis=0), axis=1)
    assert np.min(np.abs(steps - np.linalg.norm(way[1] - way[0]))) < 1e-4
    proved, measured = (line.get_ydata() for line in below.get_lines())
    np.testing.assert_array_equal(proved, radii)
    np.testing.assert_array_equal(measured, [0.01, np.nan, 0.02, np.nan, np.nan])
    assert len(tube_on_drive(scene, "sfkd", [1.0] * 9, []).axes) == 2


def test_the_command_is_the_one_that_was_typed_where_it_was_kept(tmp_path):
    rows = documents()["results.json"]["rows"]
    typed = "python -m sfkd_jax.train +experiment=s3 evaluation.episodes=4"
    for command, shown in (
        (typed, 1),
        (typed.replace("train", "evaluate"), 2),
        (None, 1),
    ):
        results = {"rows": rows, "config": {"command": command}}
        page, _ = report_of(write_run(tmp_path, episodes=None, results=results))
        code = [
            html.unescape(text) for text in re.findall(r"<pre><code>(.*?)</code>", page)
        ]
        items = [
            text
            for text in code
            if ".train" in text or ".evaluate +experiment=s3 evaluation" in text
        ]
        assert len(items) == shown
        assert items[-1] == (
            command or "python -m sfkd_jax.train +experiment=s3 seed=0"
        )


def test_two_rows_of_a_system_are_told_apart(tmp_path):
    rows = documents()["results.json"]["rows"]
    rows = [*rows, score("sfkd", "s3", 0.05, 0.01, 3.0, env="estimated")]
    made = report_of(write_run(tmp_path, episodes=None, results={"rows": rows}))[1]
    text = Path(made["report"]).with_name("report.md").read_text("utf-8")
    assert "| SFKD (e estimated) | 0.050 ± 0.010 |" in text
    assert "| **SFKD** | **0.034 ± 0.006** |" in text


def violated(row, certified, radius, shares):
    """The row as it is after drives under side forces: share of V1 (conformal) by
    force.
    """
    kind = "certified" if certified else "conformal"
    violation = {
        "v0": 0.0 if certified else None, "v1": 0.021 if certified else shares[0], "v1_tube": kind,
        "v1_radius_m": 14.2 * radius if certified else radius, "v1_conformal": shares[0],
        "v1_conformal_radius_m": radius, "v1_level": 0.95, "v2": 0.003, "v2_threshold_m": 6.83, "segments": 96,
    }  # fmt: skip
    runs = [
        {"force_n": force, "rmse_m": {"mean": 0.1}, "v0": violation["v0"], "v1": 0.5 * share, "v1_conformal": share,
         "v2": 0.1 * share, "departures": 0}
        for force, share in zip((0.0, 250.0, 500.0, 1000.0), shares, strict=True)
    ]  # fmt: skip
    return row | {"violation": violation, "disturbed": runs}


def pushed_rows():
    rows = {
        row["system"]: row
        for row in documents()["results.json"]["rows"]
        if row["scenario"] == "s3"
    }
    return [
        violated(rows["sfkd"], True, 0.137, (0.0625, 0.4, 0.98, 1.0)),
        violated(rows["nominal"], False, 7.91, (0.0, 0.0, 0.01, 0.02)),
        violated(rows["oracle"], False, 0.001, (0.0, 1.0, 1.0, 1.0)),
    ]


def test_violations_under_side_forces_are_drawn_and_written(tmp_path):
    page, made = report_of(write_run(tmp_path, results={"rows": pushed_rows()}))
    text = text_of(page)
    assert "figure2.png" in {Path(figure).name for figure in made["figures"]}
    for words in (
        "Violations: Scenario S3",
        "certified tube",
        "conformal tube",
        "6.83 m",
        "96 segments",
        "0.95",
    ):
        assert words in text, words
    assert re.search(r"SFKD 0 2\.1 1\.945 6\.2 0\.137 0\.3", text)
    assert re.search(r"Oracle – – – 0 0\.001 0\.3", text)


def test_figure_2_holds_what_the_rows_hold():
    rows = pushed_rows()
    tubes, common, widths = violations(rows).axes
    lines = {line.get_label(): line.get_xydata() for line in tubes.get_lines()}
    forces = [0.0, 250.0, 500.0, 1000.0]
    for label, key in (
        ("SFKD", "v1_conformal"),
        ("_SFKD, certified tube", "v1"),
        ("_SFKD, theorem (V0)", "v0"),
    ):
        expected = [
            [force, run[key]]
            for force, run in zip(forces, rows[0]["disturbed"], strict=True)
        ]
        np.testing.assert_array_equal(lines[label], expected)
    assert {"Nominal", "Oracle"} <= set(lines)
    assert not {"_Oracle, certified tube", "_Nominal, theorem (V0)"} & set(lines)
    assert any(np.allclose(line.get_ydata(), 0.05) for line in tubes.get_lines())
    np.testing.assert_array_equal(
        common.get_lines()[2].get_ydata(), [0.0, 0.1, 0.1, 0.1]
    )
    shown = sorted(float(line.get_xdata()[0]) for line in widths.get_lines())
    np.testing.assert_allclose(shown, [0.001, 0.137, 14.2 * 0.137, 7.91])
    assert [tick.get_text() for tick in widths.get_yticklabels()] == [
        "SFKD",
        "Nominal",
        "Oracle",
    ]


def test_figure_2_survives_nulls_and_rows_that_were_not_pushed(tmp_path):
    rows = nulled(pushed_rows())
    for row in rows:
        row["violation"]["segments"] = 96
    rows += [
        score("icode", "s3", 0.03, 0.001, 1.3),
        violated(score("r2dn", "s1", 0.1, 0.01, 2.0), False, 0.1, (0.0,) * 4),
    ]
    page, made = report_of(write_run(tmp_path, episodes=None, results={"rows": rows}))
    assert [Path(figure).name for figure in made["figures"]][:2] == [
        "figure2.png",
        "figure2_2.png",
    ]
    assert re.search(r"\b(nan|inf|None|null)\b", text_of(page)) is None


def test_drawing_leaves_matplotlib_as_it_was(tmp_path):
    before, backend = (
        dict(matplotlib.rcParams),
        matplotlib.rcParams._get_backend_or_none(),
    )
    write_report(write_run(tmp_path))
    assert matplotlib.rcParams._get_backend_or_none() == backend
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.93207, "0.9321"),
        (0.99999999, "0.99999999"),
        (0.95, "0.95"),
        (1.02, "1.02"),
        (None, "–"),
        (np.inf, "–"),
    ],
)
def test_an_upper_bound_is_rounded_up_and_never_to_one(value, words):
    assert upper(value) == words
