"""Figures of the corridor: hostile planners, and the width against speed."""

import numpy as np
import pytest
from PIL import Image

from sfkd_jax.paper import draw_hostile
from sfkd_jax.paper._hostile import Hostile, hostile
from sfkd_jax.paper._speed import against_speed


def hostile_drives():
    random, steps = np.random.default_rng(0), 60
    free = np.zeros((2, steps))
    free[0, 10:], free[1, 20:] = np.linspace(0.0, 9.0, steps - 10), np.nan
    envs = np.repeat([[0.9, 0.0], [0.3, 8.0]], steps // 2, axis=0)
    saved = {
        name: 0.05 * random.standard_normal((2, steps)) for name in ("worst", "random")
    }
    about = {
        "dt": 0.1,
        "envs": envs,
        "lane": 0.85,
        "onset": np.array([10, 20]),
        "name": "full lock",
    }
    return about | {"kept": saved, "held": np.zeros((2, steps)), "free": free}


def test_hostile_planners_are_drawn_until_they_leave_and_the_corridor_is_to_scale(
    tmp_path,
):
    drives = hostile_drives()
    figure = hostile(Hostile(width=0.1, tube=0.05, **drives))
    inside, lost = figure.axes[:2]
    edges = {
        round(float(line.get_ydata()[0]), 6)
        for line in inside.get_lines()
        if len(set(line.get_ydata())) == 1
    }
    assert {-0.15, 0.15} <= edges
    left, broken = (
        line
        for line in lost.get_lines()
        if line.get_label().lstrip("_") == "without the shield"
    )
    assert np.max(left.get_ydata()) < 3.0
    assert len(broken.get_ydata()) == 1
    switched = {
        float(line.get_xdata()[0])
        for line in lost.get_lines()
        if len(set(line.get_xdata())) == 1
    }
    assert 3.0 in switched
    directory = draw_hostile(tmp_path / "figure.png", width=0.1, tube=0.05, **drives)
    with Image.open(directory) as image:
        assert image.size[0] > 900


def test_the_figure_about_speed_draws_every_cell_and_the_room():
    cells = [
        {"friction": friction, "speed": speed, "corridor_m": 0.01 * speed / friction}
        for friction in (0.9, 0.3)
        for speed in (10.0, 8.0)
    ]
    figure = against_speed({"one": cells, "other": cells[:2]}, 0.25)
    one, other = figure.axes
    drawn = {
        line.get_label(): (list(line.get_xdata()), list(line.get_ydata()))
        for line in one.get_lines()
    }
    assert drawn["friction 0.3"] == (
        [8.0, 10.0],
        pytest.approx([0.08 / 0.3, 0.1 / 0.3]),
    )
    assert drawn["friction 0.9"] == (
        [8.0, 10.0],
        pytest.approx([0.08 / 0.9, 0.1 / 0.9]),
    )
    for axes, count in ((one, 2), (other, 1)):
        lines = axes.get_lines()
        assert len(lines) == count + 1
        assert set(lines[-1].get_ydata()) == {0.25}
        assert axes.get_ylim()[1] > 0.1 / 0.3
