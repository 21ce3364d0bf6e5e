"""The live viewer: its drive keeps clear of what is dragged, and its page is served."""

import socket
import sys
import threading
import time
import urllib.request

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sfkd_jax
from sfkd_jax import viewer
from sfkd_jax.driving.paths import point_at
from sfkd_jax.driving.scenarios import beside
from sfkd_jax.viewer import _nodes as nodes

FAR = np.array([[1e3, 1e3]] * 6)


@pytest.fixture(scope="module")
def drive():
    return viewer.live_drive(sfkd_jax.load("kinematic_path"))


@pytest.fixture(scope="module")
def start(drive):
    return drive.start(jax.random.key(0))


def steps(drive, state, user_input, count):
    """The moments of some control steps with the same user input, and the state after."""
    moments = []
    for _ in range(count):
        state, moment = drive.step(state, user_input)
        moments.append(moment)
    return state, moments


def dragged(drive, state, ahead, aside):
    """The first obstacle is put ahead of the car, all others are far away."""
    along = state.loop.progress + jnp.asarray([ahead])
    place = beside(drive.lane.path, along, jnp.asarray([aside]))
    return np.concatenate([place, FAR[1:]])


def test_what_is_drawn_is_where_the_car_is_and_inside_its_corridor(drive, start):
    _, moments = steps(drive, start, drive.first_input, 12)
    for moment in moments:
        body, *windows = moment.scene.car
        x, y, yaw = moment.pose
        length, width = drive.policy.vehicle.size
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        from_middle = body - np.array([[x], [y]])
        assert np.ptp(ahead @ from_middle) == pytest.approx(length, abs=1e-4)
        left = np.array([-ahead[1], ahead[0]])
        assert np.ptp(left @ from_middle) == pytest.approx(width, abs=1e-4)
        assert all(np.ptp(ahead @ window) < 0.3 * length for window in windows)
        assert np.isfinite(moment.bound)
        assert abs(moment.deviation) < moment.bound
    # The middle of the car is between the edges of the corridor beside it.
    one, other = moment.scene.corridor
    nearest = np.argmin(np.hypot(*(moment.scene.reference - moment.pose[:2, None])))
    across = one[:, nearest] - other[:, nearest]
    assert np.hypot(*across) == pytest.approx(2.0 * moment.bound, abs=1e-3)
    share = (moment.pose[:2] - other[:, nearest]) @ across / (across @ across)
    assert 0.0 < share < 1.0


def test_the_road_passes_below_a_camera_that_stands(drive, start):
    state, moments = steps(drive, start, drive.first_input, 12)
    centre = point_at(drive.lane.path, state.loop.progress)
    np.testing.assert_allclose(moments[-1].centre, centre[:3], atol=1e-4)
    assert moments[-1].candidates.shape[0] == len(moments[-1].admissible)
    assert moments[-1].admissible.any()


def test_admissible_candidates_keep_clear_of_obstacles_and_others_do_not(drive, start):
    _, moments = steps(drive, start, drive.first_input, 40)
    moment = moments[-1]
    middles = drive.first_input.obstacles[:, :, None]
    gaps = np.hypot(*np.moveaxis(moment.candidates[:, None] - middles, 2, 0))
    nearest = gaps.min(axis=(1, 2))
    # A circle of radius 0.8 m, half the width of the car, and the corridor.
    needed = 0.8 + 0.5 * drive.policy.vehicle.size.width + moment.bound
    assert moment.admissible.any()
    assert (nearest[moment.admissible] > needed).all()
    assert (nearest[~moment.admissible] < needed).any()


@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_an_obstacle_that_is_dragged_onto_the_road_is_not_hit(drive, start, aside):
    user_input = drive.first_input._replace(obstacles=FAR)
    state, _ = steps(drive, start, user_input, 10)
    user_input = user_input._replace(obstacles=dragged(drive, state, 40.0, aside))
    state, moments = steps(drive, state, user_input, 60)
    assert state.nearest > 0.1
    offsets = [np.hypot(*(m.pose - m.centre)[:2]) for m in moments]
    # It has gone round, or it stands.
    passed = float(state.loop.progress) > 65.0
    assert (passed and max(offsets) > 1.5) or moments[-1].speed < 0.1


def test_a_wall_across_the_road_stops_the_car_until_it_is_dragged_away(drive, start):
    user_input = drive.first_input._replace(obstacles=FAR)
    state, _ = steps(drive, start, user_input, 5)
    along = state.loop.progress + jnp.full(6, 45.0)
    wall = np.asarray(beside(drive.lane.path, along, jnp.linspace(-5.0, 5.0, 6)))
    state, moments = steps(drive, state, user_input._replace(obstacles=wall), 90)
    assert state.nearest > 0.0
    assert moments[-1].speed < 0.1
    assert moments[-1].braking
    _, moments = steps(drive, state, user_input, 40)
    assert moments[-1].speed > 3.0


def test_meshes_are_closed_and_face_outwards():
    square = np.array([[0.0, 2.0, 2.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    vertices, faces = nodes.area(square, 0.5)
    one, two, three = vertices[faces.T]
    normals = np.cross(two - one, three - one)
    assert 0.5 * normals[:, 2].sum() == pytest.approx(2.0)
    vertices, faces = nodes.strip(square[:, [3, 2]], square[:, :2], 0.0)
    one, two, three = vertices[faces.T]
    assert 0.5 * np.cross(two - one, three - one)[:, 2].sum() == pytest.approx(2.0)
    # The volume below the lid: the sides face outwards as well.
    vertices, faces = nodes.prism(square, 0.0, 3.0)
    one, two, three = vertices[faces.T]
    sides = np.cross(two - one, three - one)[2:]
    middles = ((one + two + three) / 3.0)[2:] - [1.0, 0.5, 1.5]
    assert (np.sum(sides * middles, axis=1) > 0.0).all()
    assert len(faces) == 2 + 8


def test_the_page_is_served_while_the_car_drives(drive, capsys):
    pages = []

    def fetch(address, panel):
        del panel
        with urllib.request.urlopen(address) as answer:
            pages.append((answer.status, answer.read()))

    with viewer.served(0) as server:
        document = viewer.show(server, drive, steps=3, started=fetch)
        shown = server.scene.get_handle_by_name
        assert shown("/world/corridor").visible
        assert shown("/world/road").color != shown("/world/ground").color
        place = shown("/world/obstacle_5").position[:2]
        np.testing.assert_allclose(place, drive.first_input.obstacles[5], atol=1e-3)
        assert not shown("/wind").visible
    assert document["steps"] == 3
    assert 0.0 < document["max_deviation_m"] < 0.3
    status, page = pages[0]
    assert status == 200
    assert b"<html" in page
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(document["address"])
    assert capsys.readouterr().out == ""


def test_a_paused_car_waits_and_a_restarted_one_begins_anew(drive):
    panels = []

    def pause(address, panel):
        del address
        panels.append(panel)
        panel.toggle_pause()
        assert panel.pause.label == "Go on"
        threading.Timer(1.0, panel.toggle_pause).start()

    def restart(address, panel):
        del address
        threading.Timer(0.5, panel.restarted.set).start()

    with viewer.served(0) as server:
        began = time.monotonic()
        document = viewer.show(server, drive, steps=2, started=pause)
        assert time.monotonic() - began > 1.0
        assert document["steps"] == 2
        assert document["driven_s"] == pytest.approx(0.2)
        assert panels[0].pause.label == "Pause"
    with viewer.served(0) as server:
        document = viewer.show(server, drive, steps=20, started=restart)
    assert document["steps"] == 20
    assert document["driven_s"] < 1.8


def test_the_sliders_reach_the_car(drive, start):
    with viewer.served(0) as server:
        panel = viewer.Panel(server, drive, drive.first_input)
        friction, wind = panel.env
        friction.value = 0.3
        wind.value = -8.0
        panel.speed.value = 5.0
        user_input = panel.user_input(FAR)
    np.testing.assert_allclose(user_input.env, [0.3, -8.0])
    state, moments = steps(drive, start, user_input, 30)
    assert moments[-1].speed < 8.0
    assert state.largest < moments[-1].bound


def test_a_port_in_use_and_a_missing_package_are_one_line(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(
                ValueError, match=rf"demo\.port={port} .*in use.*"
            ) as refusal,
            viewer.served(port),
        ):
            pass
    assert "\n" not in str(refusal.value)
    monkeypatch.setitem(sys.modules, "viser", None)
    with (
        pytest.raises(ValueError, match=r'pip install "sfkd-jax\[viewer\]"'),
        viewer.served(0),
    ):
        pass
