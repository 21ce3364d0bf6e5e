"""A film of given drives: the corridor to scale, and who leaves is drawn until then."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from sfkd_jax.paper import draw_film
from sfkd_jax.reporting._film import draw_strip
from sfkd_jax.reporting.film import MAX_BYTES, Car, Film, draw_road

STEPS, DT, CORRIDOR = 12, 0.1, 0.2
SWITCHED = 6


def driven(lateral):
    """Deviation and states at 10 m/s along x."""
    offset = np.concatenate([[0.0], lateral])
    states = np.stack(
        [np.arange(STEPS + 1.0), offset, 0.0 * offset, np.full(STEPS + 1, 10.0)], axis=1
    )
    return lateral, states


def drives(lost):
    points = np.zeros((200, 4))
    points[:, 0] = 0.5 * np.arange(len(points))
    envs = np.repeat([[0.9, 0.0], [0.3, 8.0]], SWITCHED, axis=0)
    cars = {"kept": driven(np.full(STEPS, 0.1)), "lost": driven(lost)}
    return {
        "title": "S3",
        "dt": DT,
        "points": points,
        "envs": envs,
        "corridor": CORRIDOR,
        "cars": cars,
    }


def departing():
    """Leaves its lane at 0.7 s and is not finite from 0.9 s on."""
    lateral = np.concatenate([np.zeros(4), -0.2 * np.arange(1, 1 + STEPS - 4) ** 2])
    lateral[8:] = np.nan
    return lateral


def shown(about):
    return Film(
        **about
        | {
            "cars": [
                Car(name, "#0b57b0", *drive) for name, drive in about["cars"].items()
            ]
        }
    )


def test_a_car_is_drawn_until_it_leaves_and_its_lane_is_said_to_be_left():
    axes, film = Figure().subplots(), shown(drives(departing()))
    assert film.widening(STEPS) == 10
    move = draw_road(axes, film, STEPS)
    saved, lost = (patch for patch in axes.patches if len(patch.get_xy()) == 6)
    *_, name = axes.texts[:2]
    visible = []
    for step in range(STEPS):
        move(step)
        visible.append(lost.get_visible())
        assert saved.get_visible()
        assert np.all(np.isfinite(lost.get_xy()))
    assert visible == [True] * 5 + [False] * (STEPS - 5)
    assert name.get_text() == "lost\nleft its lane (0.85 m) at 0.7 s"


def test_the_corridor_is_to_the_scale_of_the_deviations():
    (above, below), film = Figure().subplots(2), shown(drives(departing()))
    draw_road(above, film, STEPS)(3)
    bands = [
        patch
        for patch in above.patches
        if isinstance(patch, Polygon) and len(patch.get_xy()) > 6
    ]
    heights = sorted(tuple(sorted(set(band.get_xy()[:, 1].round(6)))) for band in bands)
    assert np.ptp(heights, axis=1) == pytest.approx(2 * 10 * CORRIDOR)
    draw_strip(below, film, STEPS)(STEPS - 1)
    level = {
        float(line.get_ydata()[0])
        for line in below.get_lines()
        if len(set(line.get_ydata())) == 1
    }
    assert {-CORRIDOR, CORRIDOR} <= level
    assert CORRIDOR < below.get_ylim()[1] < 2 * CORRIDOR


def test_the_scale_keeps_a_wide_corridor_and_every_car_that_stays_in_its_lane():
    stays = np.linspace(0.0, 0.65, STEPS)
    assert shown(drives(stays)).widening(STEPS) == 5
    assert shown(drives(stays) | {"corridor": 0.85}).widening(STEPS) == 4
    assert shown(drives(np.full(STEPS, 1e3)) | {"corridor": None}).widening(STEPS) == 10


def test_the_film_of_a_car_that_is_lost_is_small_and_moves(tmp_path):
    directory = draw_film(tmp_path / "film.gif", **drives(departing()))
    assert directory.stat().st_size <= MAX_BYTES
    with Image.open(directory) as image:
        assert image.n_frames == STEPS
        frames = []
        for frame in (0, STEPS - 1):
            image.seek(frame)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
    assert np.mean(np.abs(frames[0] - frames[1]).max(axis=2) > 30) > 0.01
