"""Every picture of the pages has a maker, which draws it from committed files."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from benchmarks import adaptation_figure, recovery_figures
from benchmarks.device import SETTLED
from experiments import paper_figures
from sfkd_jax.report import style

ROOT = Path(__file__).parents[1]
SUFFIXES = {".gif", ".jpg", ".jpeg", ".png", ".svg", ".webp"}
POLICY = "src/sfkd_jax/pretrained/dynamic_path"


class Maker(NamedTuple):
    """What draws a picture.

    Attributes:
        command: that draws it, from the root of the repository.
        source: committed file or folder that it is drawn from.
        draw: content of the source -> the figure; None where the command has to drive.
    """

    command: str
    source: str
    draw: Callable | None = None


MAKERS = {
    "adaptation.png": Maker(
        "python -m benchmarks.adaptation_figure",
        "benchmarks/adaptation_run.json",
        adaptation_figure.draw,
    ),
    "drone.gif": Maker(
        "python -m experiments.drone runs/systems/quadrotor --write",
        "experiments/drone.json",
    ),
    "figures/figure1.png": Maker(
        "python -m experiments.paper_figures",
        "experiments/figure1.json",
        paper_figures.figure1,
    ),
    "figures/figure2.png": Maker(
        "python -m experiments.paper_figures",
        "experiments/figure2.json",
        paper_figures.figure2,
    ),
    "lane.gif": Maker("python examples/lane.py --film docs/lane.gif", POLICY),
    "recovery.gif": Maker("python -m benchmarks.recovery_figures film", POLICY),
    "recovery.png": Maker(
        "python -m benchmarks.recovery_figures basin",
        "benchmarks/recovery.json",
        recovery_figures.basin,
    ),
    "viewer.png": Maker(
        "python -m experiments.viewer_page",
        "src/sfkd_jax/pretrained/kinematic_path",
    ),
}
"""Picture below docs/ -> its maker."""
WRITTEN_BY_HAND = {"certificate.svg", "commands.svg", "control-step.svg"}
"""Pictures that are their own source: text that one edits."""
REDRAWN = [name for name, maker in MAKERS.items() if maker.draw]


def pictures():
    """The pictures below docs/."""
    docs = ROOT / "docs"
    files = [path for path in docs.rglob("*") if path.suffix.lower() in SUFFIXES]
    return {path.relative_to(docs).as_posix() for path in files}


def script_of(command):
    """The file that a command runs."""
    if module := re.match(r"python -m ([\w.]+)", command):
        return ROOT / f"{module[1].replace('.', '/')}.py"
    return ROOT / command.split()[1]


def test_every_picture_has_a_maker_or_is_written_by_hand():
    assert pictures() == MAKERS.keys() | WRITTEN_BY_HAND


@pytest.mark.parametrize("name", MAKERS)
def test_the_script_names_the_picture_and_its_source_exists(name):
    maker = MAKERS[name]
    assert Path(name).name in script_of(maker.command).read_text("utf-8")
    assert (ROOT / maker.source).exists()


@pytest.mark.parametrize("name", REDRAWN)
def test_a_picture_drawn_again_from_its_source_is_the_same(name, tmp_path):
    maker = MAKERS[name]
    source = json.loads((ROOT / maker.source).read_text("utf-8"))
    again = style.save(tmp_path / "again.png", maker.draw, source)
    with Image.open(again) as drawn, Image.open(ROOT / "docs" / name) as committed:
        np.testing.assert_array_equal(np.asarray(drawn), np.asarray(committed))


def test_what_the_page_says_about_the_picture_of_adaptation():
    run = json.loads(adaptation_figure.RUN.read_text("utf-8"))
    without, adapting = run["rows"]
    words = " ".join((ROOT / "docs" / "adaptation.md").read_text("utf-8").split())
    before, after = (
        np.sqrt(np.mean(np.square(row["lateral_mm"][SETTLED:])))
        for row in (without, adapting)
    )
    assert f"{before:.1f} mm without adaptation and {after:.1f} mm with it" in words
    error = np.abs(np.subtract(run["force_n"], adapting["estimate_n"]))
    inside = np.mean(error <= 2.0 * np.asarray(adapting["deviation_n"]))
    assert f"in {inside:.0%} of the steps".replace("%", " %") in words


@pytest.mark.parametrize("name", sorted(WRITTEN_BY_HAND))
def test_a_picture_written_by_hand_says_what_it_shows(name):
    root = ElementTree.parse(ROOT / "docs" / name).getroot()
    words = {child.tag.split("}")[1]: child.text for child in root}
    assert words["title"]
    assert words["desc"]
