"""The reference as a plan: lateral moves, obstacles, and what may be committed."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

import sfkd_jax
from sfkd_jax import control
from sfkd_jax import policy as policies
from sfkd_jax.driving import path_following
from sfkd_jax.driving.lanes import Obstacles, circles, clearance, lane_along, padded
from sfkd_jax.driving.path_following.lanes._followers import NEVER, counts_from
from sfkd_jax.driving.path_following.lanes._judging import Situation
from sfkd_jax.driving.path_following.lanes._reference import (
    SPLICE,
    Committed,
    curve,
    road_ahead,
)
from sfkd_jax.driving.paths import (
    Lap,
    Path,
    path_from_curvature,
    path_through,
    point_at,
    quintic,
)
from sfkd_jax.driving.sizes import Scale
from sfkd_jax.info import Claim, ControllerInfo, Reason
from sfkd_jax.types import Controller

MOVE = jit(quintic)
KIND = path_following.Class(
    curvature=0.02,
    turning=0.0025,
    lateral=2.0,
    jerk=2.9,
    speed=(8.0, 10.5),
    half=(2.25, 0.9),
    corridor=0.14,
    heading=0.05,
)
SAMPLES, DT = 200, 0.1


def test_a_lateral_move_joins_its_ends_and_its_derivatives_are_those_of_its_offset():
    start, target, length = jnp.asarray([0.4, -0.05, 0.008]), 2.0, 31.0
    s = np.linspace(0.0, 40.0, 4001, dtype=np.float32)
    move = np.asarray(MOVE(start, target, length, s), np.float64).T
    np.testing.assert_allclose(move[0, :3], start, atol=1e-6)
    np.testing.assert_allclose(move[s >= 31.0], [[2.0, 0, 0, 0]] * 901, atol=2e-6)
    before = move[s < 31.0]
    np.testing.assert_allclose(before[-1, :3], [2.0, 0.0, 0.0], atol=1e-4)
    for order in range(3):
        slope = np.gradient(before[:, order], 0.01)[1:-1]
        np.testing.assert_allclose(slope, before[1:-1, order + 1], atol=2e-3)


def test_distances_from_boxes_circles_and_things_that_move():
    still = circles(jnp.asarray([[3.0, 4.0], [0.0, -2.0]]), 1.0)
    np.testing.assert_allclose(clearance(still, jnp.zeros(2)), [4.0, 1.0], atol=1e-5)
    turned = Obstacles(
        position=jnp.asarray([[[4.0, 0.0], [4.0, 2.0], [4.0, 4.0]]] * 2),
        yaw=jnp.asarray([np.pi / 2, 0.0]),
        half=jnp.asarray([[2.0, 1.0]] * 2),
        radius=jnp.asarray([0.5, 0.0]),
        present=jnp.asarray([True, False]),
    )
    # Beyond its last position it goes on: at step 7 to (4, 14), and its edge to (3, 12).
    for step, distance in ((0.0, 2.5), (0.5, 2.5), (7.0, np.hypot(3.0, 12.0) - 0.5)):
        found = clearance(turned, jnp.zeros(2), step)
        np.testing.assert_allclose(found, [distance, np.inf], atol=1e-5)
    assert clearance(turned, jnp.asarray([4.0, 0.2]))[0] < -1.0


def test_padded_obstacles_are_the_same_in_a_fixed_number_of_rows():
    origin = jnp.zeros(2)
    for count in (0, 1, 3):
        places = jnp.asarray([[3.0, 4.0], [0.0, -2.0], [9.0, 0.0]])[:count]
        few = circles(places, 1.0)
        rows = padded(few, 3)
        assert {leaf.shape[0] for leaf in rows} == {3}
        assert list(rows.present) == [True] * count + [False] * (3 - count)
        np.testing.assert_array_equal(
            clearance(rows, origin)[:count], clearance(few, origin)
        )
        assert np.all(np.isinf(clearance(rows, origin)[count:]))
    with pytest.raises(ValueError, match="3 obstacles do not fit in 2 rows"):
        padded(few, 2)


def test_padded_predictions_go_on_as_they_would_without_the_padding():
    moving = circles(jnp.asarray([[3.0, 4.0], [0.0, -2.0]]), 1.0)
    ends = jnp.asarray([[[3.0, 4.0], [3.5, 4.0]], [[0.0, -2.0], [0.0, -2.0]]])
    moving = moving._replace(position=ends)
    longer = padded(moving, 3, 6)
    assert longer.position.shape == (3, 6, 2)
    for step in (0.5, 4.0, 5.0, 9.0):
        np.testing.assert_allclose(
            clearance(longer, jnp.zeros(2), step)[:2],
            clearance(moving, jnp.zeros(2), step),
            atol=1e-5,
        )
    still = padded(circles(jnp.asarray([[3.0, 4.0]]), 1.0), 1, 3)
    np.testing.assert_array_equal(still.position, [[[3.0, 4.0]] * 3])
    with pytest.raises(ValueError, match="6 predicted positions do not fit in 5"):
        padded(longer, 3, 5)


def test_with_a_capacity_a_lane_is_compiled_once_for_all_numbers_of_obstacles():
    traced = []

    def act(params, state, observation, env, scene):
        traced.append(scene)
        return jnp.sum(scene[1].present), state, scene[1].position

    fixed = policies._calling.with_capacity(Controller(lambda key: key, act), (4, 3))
    for count in (0, 1, 4, 2):
        seen = circles(jnp.arange(2.0 * count).reshape(count, 2), 0.8)
        for steps in (1, 3):
            places = np.repeat(np.asarray(seen.position), steps, axis=1)
            moving = seen._replace(position=places)
            number, _, position = fixed.act(None, 0.0, 0.0, 0.0, (None, moving))
            assert number == count
            assert position.shape == (4, 3, 2)
    assert len(traced) == 1
    with pytest.raises(ValueError, match="5 obstacles do not fit in 4 rows"):
        fixed.act(None, 0.0, 0.0, 0.0, (None, circles(jnp.ones((5, 2)), 0.8)))
    with pytest.raises(ValueError, match="capacity must be"):
        policies._calling.with_capacity(fixed, (4, 0))


def test_two_boxes_are_never_nearer_than_is_said():
    """Against points on their edges; of a circle the distance is exact."""
    rng, half = np.random.default_rng(0), (2.25, 0.9)
    count, edge = 40, np.linspace(-1.0, 1.0, 81)
    outline = np.concatenate(
        [np.stack([edge, side + 0 * edge], 1) for side in (-1.0, 1.0)]
        + [np.stack([side + 0 * edge, edge], 1) for side in (-1.0, 1.0)]
    )
    theirs = rng.uniform(0.0, 3.0, (count, 2)) * (np.arange(count) % 2)[:, None]
    yaw, direction = rng.uniform(-3, 3, count), 0.4
    position, radius = rng.uniform(-12, 12, (count, 2)), rng.uniform(0.0, 1.0, count)

    def around(centre, angle, half):
        turn = np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        return centre + (outline * half) @ turn

    scene = Obstacles(position[:, None], yaw, theirs, radius, np.ones(count, bool))
    faces = np.cos(direction), np.sin(direction)
    found = clearance(
        jax.tree.map(jnp.asarray, scene),
        jnp.zeros(2),
        direction=jnp.asarray(faces),
        half=half,
    )
    for i, said in enumerate(np.asarray(found)):
        pairs = around(np.zeros(2), direction, half)[:, None] - around(
            position[i], yaw[i], theirs[i]
        )
        real = np.linalg.norm(pairs, axis=-1).min() - radius[i]
        if real > -radius[i] + 0.1:
            assert said <= real + 1e-3
            assert i % 2 or said > real - 0.02


@pytest.fixture(scope="module")
def road():
    s = np.arange(700) * 0.5
    bend = 0.006 * np.sin(s / 25.0) * np.clip(s / 20.0, 0.0, 1.0)
    path = jit(partial(path_from_curvature, spacing=0.5))(np.float32(bend))
    return lane_along(path, width=12.0)


def test_curvature_beside_a_road_is_that_of_the_positions(road):
    ahead = road_ahead(road, jnp.asarray(100), 400, (1.0, 1.0))
    move = MOVE(jnp.zeros(3), 3.0, 40.0, 0.5 * jnp.arange(400.0) - 60.0)[:3]
    plan = Committed(jnp.asarray(100), move, jnp.full(400, 100.0))
    along = jax.tree.map(np.asarray, curve(ahead, plan))
    x, y = np.asarray(along.position, np.float64)
    step = np.hypot(np.diff(x), np.diff(y))
    yaw = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    bend = np.diff(yaw) / (0.5 * (step[1:] + step[:-1]))
    smooth = np.convolve(bend, np.ones(5) / 5, "valid")
    off = np.abs(smooth - along.curvature[3:-3])
    # The smoothed one is off where the slope jumps, at both ends of the move.
    assert off.max() < 1e-3
    assert np.sort(off)[-20] < 1e-4
    np.testing.assert_allclose(
        step, 0.25 * (along.stretch[1:] + along.stretch[:-1]), rtol=1e-4
    )
    middle = np.arctan2(*along.direction[::-1])
    np.testing.assert_allclose(0.5 * (middle[1:] + middle[:-1]), yaw, atol=1e-4)


@pytest.mark.parametrize("spacing", [0.1, 0.125, 0.3, 0.5, 2.0])
def test_a_lane_looks_ahead_by_distance_whatever_the_spacing_of_its_path(spacing):
    """Samples lie on a circle; a narrow and slow spot is on both sides of it."""
    angles = np.linspace(0.0, 4.0, 8001)
    points = 60.0 * np.stack([np.sin(angles), 1.0 - np.cos(angles)], axis=1)
    lane = lane_along(path_through(jnp.asarray(points), spacing=spacing), width=8.0)
    s = spacing * np.arange(len(lane.left))
    spot = int(np.argmin(np.abs(s - 40.1)))
    lane = lane._replace(
        left=lane.left.at[spot].set(1.0), speed=lane.speed.at[spot].set(3.0)
    )
    ahead = jit(partial(road_ahead, count=120, accelerations=(9.0, 9.0)))(
        lane, jnp.asarray(20)
    )
    assert 0.5 <= ahead.spacing < 0.7
    at = float(ahead.spacing) * (20 + np.arange(120))
    circle = 60.0 * np.stack([np.sin(at / 60.0), 1.0 - np.cos(at / 60.0)])
    np.testing.assert_allclose(ahead.position, circle, atol=0.01)
    np.testing.assert_allclose(ahead.curvature, 1.0 / 60.0, atol=1e-3)
    near = np.abs(at - s[spot]) < ahead.spacing - 1e-3
    assert near.any()
    np.testing.assert_allclose(np.asarray(ahead.left)[near].min(), 1.0, atol=1e-5)
    assert np.all(np.asarray(ahead.left)[near] <= 4.0)
    assert np.all(np.asarray(ahead.right) == 4.0)
    # Where it is slow, and nowhere faster than it can brake from to there.
    np.testing.assert_allclose(ahead.wanted.min(), 9.0, atol=1e-4)
    beyond = np.abs(at - s[spot]) > max(spacing, ahead.spacing) + 1e-3
    np.testing.assert_array_equal(np.asarray(ahead.left)[beyond], 4.0)


def test_who_follows_in_the_track_counts_when_he_leaves_it():
    """On a straight road and on a lap, the car at 30 m and 1 m aside."""
    angle = np.linspace(0.0, 2 * np.pi, 4000, endpoint=False)
    ring = 40.0 * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    straight = path_through(jnp.asarray([[0.0, 0.0], [200.0, 0.0]]))
    lap = path_through(jnp.asarray(ring), closed=True)
    steps = np.arange(20)
    rows = {  # distance along, distance aside, step from which on it counts
        "follows": (10.0 + 1.5 * steps, 1.0 + 0.0 * steps, NEVER),
        "overtakes": (10.0 + 1.5 * steps, 1.0 + 0.4 * steps, 6),
        "beside": (29.0 + steps, 1.0 + 0.0 * steps, 0),
        "ahead": (38.0 + steps, 1.0 + 0.0 * steps, 0),
        "in the next lane": (10.0 + 1.5 * steps, 4.0 + 0.0 * steps, 0),
    }
    for path in (straight, lap):
        places = []
        for along, aside, _ in rows.values():
            points = np.asarray(jax.vmap(partial(point_at, path))(jnp.asarray(along)))
            normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
            places.append(points[:, :2] + aside[:, None] * normal)
        others = circles(jnp.asarray(places)[:, 0], 1.0)
        others = others._replace(position=jnp.asarray(places))
        found = counts_from(
            path,
            others,
            jnp.asarray(30.0),
            jnp.asarray(1.0),
            KIND,
            samples=100,
            spacing=0.5,
        )
        # Aside by 0.4 m a step: 1 + 0.9 + 0.26 m of room are left at step 6.
        np.testing.assert_array_equal(found, [row[2] for row in rows.values()])


def follower():
    """A controller that reports the window it is given, and a certain corridor."""

    def act(params, state, observation, env, reference):
        claim = Claim(bound=jnp.asarray(KIND.corridor), reason=Reason.CERTIFIED)
        info = ControllerInfo(claim=claim)
        return jnp.zeros(2), state, info

    return Controller(lambda key: jnp.zeros(()), act)


def settings_with(planner, kind=KIND, **settings):
    """The settings of a controller in a lane."""
    task = path_following.Manoeuvres.scaled(kind, DT)
    length, speed = kind.scale
    noise = (1.5 * length, 10.0 * length, 1.5 * length, 10.0 * length, speed)
    search = {"horizon": 1, "noise_std": noise, "noise": "white"}
    return path_following.InLane(
        inner=follower(),
        planner=planner(task.task(), **search, **settings),
        manoeuvres=task,
        horizon=20,
        view=100.0 * length,
        spacing=0.5 * length,
    )


def lane_with(planner, kind=KIND, **settings):
    """The controller of a lane, and its step as one program."""
    driver = settings_with(planner, kind, **settings).controller()
    return driver, jit(driver.act)


@pytest.fixture(scope="module")
def lane():
    return lane_with(control.mppi, num_samples=100, effective_samples=5.0)


def nine(obstacles):
    """With others that are not present, so that the drives are one program."""
    missing = 9 - len(obstacles.present)
    return jax.tree.map(
        lambda leaf: np.pad(leaf, [(0, missing)] + (np.ndim(leaf) - 1) * [(0, 0)]),
        obstacles,
    )


def drive(lane, road, seen, steps, *, speed=10.0, friction=0.9):
    """A car that is always where its reference says; `seen` gives what it sees."""
    driver, act = lane
    state = driver.init(jax.random.key(1))
    car = np.array([0.0, 0.0, 0.0, speed], np.float32)
    rows = []
    for number in range(steps):
        scene = (road, nine(seen(number, car)))
        _, state, info = act(None, state, car, jnp.asarray([friction, 0.0]), scene)
        rows.append((car, state, jax.tree.map(np.asarray, info)))
        car = rows[-1][2].lane.reference[0]
    return rows


POSTS = np.array([[40.0, 0.4], [85.0, -0.6], [130.0, 0.0], [175.0, 1.2]])


def beside(road, places):
    """Positions [m] at places (s, offset)."""
    points = np.asarray(road.path.points)[(places[:, 0] * 2).astype(int)]
    normal = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], 1)
    return jnp.asarray(points[:, :2] + places[:, 1:] * normal)


CLEARANCE = jit(partial(clearance, half=KIND.half))


def room(car, posts):
    """Distance of a car from the nearest of them [m]."""
    faces = np.float32([np.cos(car[2]), np.sin(car[2])])
    return float(CLEARANCE(posts, np.float32(car[:2]), direction=faces).min())


@pytest.mark.parametrize("planner", ["mppi", "cem"])
def test_it_drives_round_posts_on_a_smooth_reference_of_its_class(lane, road, planner):
    if planner == "cem":
        lane = lane_with(control.cem, num_samples=50, iterations=2, elites=5)
    posts = circles(beside(road, POSTS), 0.8)

    def seen(number, car):
        near = np.linalg.norm(np.asarray(posts.position)[:, 0] - car[:2], axis=1) < 60.0
        return posts._replace(present=jnp.asarray(near))

    rows = drive(lane, road, seen, 180)
    assert all(bool(info.lane.admissible) for _, _, info in rows)
    cars = np.stack([car for car, _, _ in rows]).astype(np.float64)
    rooms = [room(car, posts) for car in cars]
    claims = np.array([info.lane.clearance for _, _, info in rows])
    assert min(rooms) > KIND.margin
    # What is claimed is about a car anywhere in the corridor.
    visible = [room(car, seen(0, car)) for car in cars]
    assert np.all(claims <= np.array(visible) + 1e-3)
    assert np.mean(cars[:, 3]) > 9.7
    steps = np.hypot(*np.diff(cars[:, :2], axis=0).T)
    bend = np.diff(np.unwrap(cars[:, 2])) / steps
    assert np.abs(bend).max() < KIND.curvature
    assert np.abs(np.diff(bend)).max() < 1.5 * KIND.turning
    for (_, before, _), (_, after, _) in pairwise(rows):
        moved = int(after.committed.index - before.committed.index)
        # Nothing changes up to the splice, and there all is continuous.
        np.testing.assert_allclose(
            after.committed.move[:, : SPLICE + 1],
            before.committed.move[:, moved : moved + SPLICE + 1],
            atol=1e-5,
        )


def test_a_small_vehicle_drives_the_same_manoeuvre_in_its_own_units(lane, road):
    """An eighth of the lengths and of the speeds, up to posts and to a stop."""
    small = 0.125
    kind = replace(
        KIND,
        curvature=KIND.curvature / small,
        turning=KIND.turning / small**2,
        lateral=KIND.lateral * small,
        jerk=KIND.jerk * small,
        speed=(8.0 * small, 10.5 * small),
        half=(2.25 * small, 0.9 * small),
        corridor=0.14 * small,
        acceleration=small,
        deceleration=small,
        braking=6.0 * small,
        scale=Scale(small, small),
    )
    points = road.path.points * jnp.asarray([small, small, 1.0, 1.0 / small])
    lanes = {
        1.0: (lane, road),
        small: (
            lane_with(control.mppi, kind, num_samples=100, effective_samples=5.0),
            lane_along(Path(points, 0.5 * small), width=12.0 * small, speed=10 * small),
        ),
    }
    wall = np.array([[100.0, d] for d in np.arange(-6.0, 6.1, 1.5)])
    places = beside(road, np.concatenate([POSTS[:2], wall[:7]]))
    driven = []
    for scale, (driver, street) in lanes.items():
        posts = circles(places * scale, 0.8 * scale)

        def seen(number, car, posts=posts):
            return posts

        # Their grip is so large that only the class limits what they do.
        rows = drive(driver, street, seen, 110, speed=10.0 * scale, friction=0.9)
        units = np.array([scale, scale, 1.0, scale])
        driven.append(np.stack([car for car, _, _ in rows]) / units)
    np.testing.assert_allclose(driven[1], driven[0], atol=0.02)
    assert driven[0][-1, 3] < 9.0


@pytest.mark.parametrize("wall", ["one", "many"])
def test_where_nothing_is_admissible_it_stops_and_goes_on_later(lane, road, wall):
    """In front of what nothing can pass; far enough to turn from what one could."""
    places = np.array([[70.0, d] for d in np.arange(-6.0, 6.1, 1.5)])
    one, wall = wall == "one", circles(beside(road, places), 0.8)
    goes = places[:, 1] <= (9.0 if one else 0.0)
    if one:
        boxes = jnp.tile(jnp.asarray([0.8, 6.0]), (9, 1))
        middle = jnp.arange(9) == 4
        wall = wall._replace(half=boxes, radius=jnp.zeros(9), present=middle)
    stood = []

    def seen(number, car):
        return wall._replace(present=wall.present & ((number < 150) | ~goes))

    rows = drive(lane, road, seen, 200, friction=0.6)
    for number, (car, _, info) in enumerate(rows[:150]):
        assert room(car, wall) > 0.5
        assert bool(info.lane.stopping) or number == 0
        stood.append(car[3])
    assert stood[-1] == 0.0
    near, far = (0.7, 2.5) if one else (12.0, 40.0)
    assert near < room(rows[149][0], wall) < far
    assert np.diff(stood).min() > -0.7 * 9.81 * 0.6 * DT - 0.05
    assert rows[-1][0][3] > 1.5
    assert not bool(rows[-1][2].lane.stopping)


def test_somebody_who_crosses_is_passed_where_he_is_then(lane, road):
    """At 1.5 m/s, predicted at every step: he would be on the centre line with it."""
    steps = np.arange(160.0)
    at = np.stack([np.full(160, 62.0), 9.3 - 0.15 * steps], 1)
    walk = np.asarray(beside(road, at))

    def seen(number, car, ahead=60):
        return circles(jnp.asarray(walk[number : number + 1]), 0.4)._replace(
            position=jnp.asarray(walk[None, number : number + ahead])
        )

    rows = drive(lane, road, seen, 95)
    for number, (car, _, info) in enumerate(rows):
        real = room(car, seen(number, car, 1))
        assert real > KIND.margin
        assert info.lane.clearance <= real + 1e-3
    cars = np.stack([car for car, _, _ in rows])
    assert cars[-1, 0] > 75.0


def test_ways_round_lead_from_one_side_of_an_obstacle_to_the_other_of_the_next():
    lane = lane_along(path_from_curvature(jnp.zeros(400), spacing=0.5), width=8.0)
    ahead, count = road_ahead(lane, jnp.asarray(0), 200, (1.0, 1.0)), 200
    straight = Committed(jnp.asarray(0), jnp.zeros((3, count)), jnp.full(count, 100.0))
    task = path_following.Manoeuvres(kind=KIND, dt=DT)
    posts = circles(jnp.asarray([[40.0, 1.2], [85.0, -1.2], [-20.0, 0.0]]), 0.8)
    place, grip = jnp.asarray(2.0), jnp.asarray(0.9 * 9.81)
    all_count = jnp.zeros(3)
    scene = Situation(ahead, straight, posts, all_count, place, grip, jnp.asarray(True))
    rows = jit(task.ways_round)(scene)
    step = partial(task.step, jnp.asarray(task.weights), scene, jnp.zeros(()))
    judged = jit(jax.vmap(step))(rows)
    assert judged.state.shape == (18,)
    best = task.reference(scene, rows[jnp.argmin(judged.state)])
    assert jnp.min(judged.state) == 0.0
    assert best.move[0, 80] < -0.5
    assert best.move[0, 170] > 0.5


def test_what_appears_too_near_to_stop_is_evaded_without_a_claim(lane, road):
    """At friction 0.3 it stops in 18 m, and sees somebody on its way at 15 m."""
    person = circles(beside(road, np.array([[55.0, 0.1]])), 0.3)

    def seen(number, car):
        near = np.linalg.norm(np.asarray(person.position)[0, 0] - car[:2]) < 15.0
        return person._replace(present=jnp.full(1, near))

    rows = drive(lane, road, seen, 90, friction=0.3)
    assert min(room(car, person) for car, _, _ in rows) > 0.2
    evading = np.array([info.lane.evading for _, _, info in rows])
    assert 2 < evading.sum() < 30
    claims = np.array([info.lane.clearance for _, _, info in rows])
    assert np.isnan(claims[evading]).all()
    for _, _, info in np.array(rows, object)[evading]:
        assert info.claim.reason == Reason.EVADING
        assert np.isnan(info.claim.bound)
    # The last reference of its own class again, and some time to follow it.
    assert not np.isnan(claims[-10:]).any()
    assert not any(info.healthy for _, _, info in np.array(rows, object)[evading])
    cars = np.stack([car for car, _, _ in rows]).astype(np.float64)
    turned = np.diff(np.unwrap(cars[:, 2])) / DT
    pull = np.hypot(turned * cars[1:, 3], np.diff(cars[:, 3]) / DT)
    assert pull.max() < 0.95 * 9.81 * 0.3
    assert cars[-1, 3] > 8.0


def cars(along, aside, speed, steps=20):
    """One car on a straight road, predicted at its speed."""
    places = [[along + DT * speed * step, aside] for step in range(steps)]
    one = circles(jnp.zeros((1, 2)), 0.0)
    half = jnp.asarray([KIND.half])
    return one._replace(position=jnp.asarray([places]), half=half)


@pytest.fixture(scope="module")
def straight():
    return lane_along(path_through(jnp.asarray([[0.0, 0.0], [500.0, 0.0]])), width=4.0)


def test_a_follower_who_would_drive_through_it_does_not_stop_the_car(lane, straight):
    """He is 20 m behind, 5 m/s faster, and slows at the last moment."""

    def seen(number, car):
        along = min(-20.0 + DT * 15.0 * number, float(car[0]) - 5.0)
        return cars(along, 0.0, 15.0)

    for car, _, info in drive(lane, straight, seen, 60):
        assert car[3] == pytest.approx(10.0, abs=0.05)
        assert abs(info.lane.offset) < 0.05
        assert not info.lane.stopping | info.lane.evading
        assert info.lane.clearance == np.inf


@pytest.mark.parametrize("speed", [10.0, 9.0])
def test_a_car_ahead_that_drives_is_followed_and_not_waited_for(lane, straight, speed):
    """It is predicted for 2 s. The distance becomes one second of driving."""

    def place(number):
        return 17.0 + DT * speed * number

    rows = drive(
        lane, straight, lambda number, car: cars(place(number), 0.0, speed), 200
    )
    for number, (car, _, info) in enumerate(rows):
        assert car[3] > speed - 1.0
        assert not info.lane.evading
        assert place(number) - car[0] > 2 * KIND.half[0] + 8.0
        assert number < 100 or info.lane.admissible
    assert np.mean([car[3] for car, _, _ in rows[100:]]) > speed - 0.3


def test_a_car_ahead_that_brakes_suddenly_is_not_hit(lane, straight):
    """It was followed at 9 m/s, and brakes with 6 m/s² unannounced."""
    places = [20.0]
    speeds = [9.0]
    for number in range(160):
        speeds.append(max(speeds[-1] - 6.0 * DT * (number > 100), 0.0))
        places.append(places[-1] + DT * speeds[-1])
    rows = drive(
        lane,
        straight,
        lambda number, car: cars(places[number], 0.0, speeds[number]),
        160,
    )
    gaps = [
        at - car[0] - 2 * KIND.half[0]
        for at, (car, _, _) in zip(places, rows, strict=False)
    ]
    assert gaps[100] > 8.0
    assert min(gaps) > KIND.margin
    assert rows[-1][0][3] == 0.0


@pytest.mark.parametrize(("width", "narrow"), [(2.25, True), (2.4, False)])
def test_a_lane_too_narrow_for_the_corridor_stops_and_says_so(
    lane, straight, width, narrow
):
    """2.32 m are needed: the width, the corridor to each side, what corners swing."""
    tight = straight._replace(left=0.0 * straight.left + width / 2)
    tight = tight._replace(right=tight.left)
    nothing = circles(jnp.zeros((0, 2)), 0.8)
    rows = drive(lane, tight, lambda *_: nothing, 40)
    room = 0.5 * width - KIND.half[1] - KIND.margin
    for _, _, info in rows:
        assert bool(info.lane.stopping) == narrow
        assert bool(info.lane.admissible) != narrow
        assert info.lane.edge == pytest.approx(room, abs=0.01)
    assert (rows[-1][0][3] == 0.0) == narrow


WHEELBASE = 2.7


@pytest.fixture(scope="module")
def reversing():
    driver = path_following.Reversing(
        lane=settings_with(control.mppi, num_samples=100, effective_samples=5.0),
        wheelbase=WHEELBASE,
        low=(-0.5, -6.0),
        high=(0.5, 3.0),
        patience=1.0,
    ).controller()
    return driver, jit(driver.act)


def backed_up(car, control):
    """A car without slip after a control step, u_2 is an acceleration."""
    x, y, yaw, speed = car
    steering, drive = np.asarray(control, np.float64)
    after = speed + DT * drive
    way = 0.5 * DT * (speed + after)
    turned = way * np.tan(steering) / WHEELBASE
    x += way * np.cos(yaw + 0.5 * turned)
    y += way * np.sin(yaw + 0.5 * turned)
    return np.float32([x, y, yaw + turned, after])


def drive_back(reversing, road, posts, steps, car):
    """A car that is where its reference says, if it neither stands nor backs up."""
    driver, act = reversing
    state = driver.init(jax.random.key(1))
    rows = []
    env = jnp.asarray([0.9, 0.0])
    for _ in range(steps):
        command, state, info = act(None, state, car, env, (road, nine(posts)))
        rows.append((car, info))
        ahead = np.asarray(info.lane.reference[0])
        forwards = ahead if ahead[3] > 0.0 else car
        car = backed_up(car, command) if info.lane.reversing else forwards
    return rows


def test_a_car_too_near_to_turn_backs_up_along_its_lane_and_drives_round(
    reversing, straight
):
    """It stands 2.5 m before a post, aside and turned, in a lane of 10 m."""
    wide = straight._replace(left=3.0 * straight.left, right=3.0 * straight.right)
    post = circles(jnp.asarray([[65.0 + 2.5 + 0.8, 0.2]]), 0.8)
    start = np.float32([65.0 - KIND.half[0], 0.6, 0.1, 0.0])
    rows = drive_back(reversing, wide, post, 290, start)
    back = np.array([bool(info.lane.reversing) for _, info in rows])
    cars = np.stack([car for car, _ in rows])
    assert not back[:9].any()
    # Once, and until it stands.
    assert np.sum(np.diff(back.astype(int)) == 1) == 1
    ended = np.flatnonzero(back)[-1] + 1
    assert -0.3 < cars[ended, 3] <= 0.0
    assert 3.0 < cars[0, 0] - cars[ended, 0] < 30.0
    assert cars[ended, 1] == pytest.approx(0.6, abs=0.3)
    assert abs(cars[ended, 2]) < 0.05
    assert cars[-1, 0] > 80.0
    assert min(room(car, post) for car in cars) > KIND.margin
    for _, info in np.array(rows, object)[back]:
        assert info.claim.reason == Reason.REVERSING
        assert np.isnan(info.claim.bound)
    # The errors of the certified law decay first.
    assert all(info.claim.reason == Reason.EVADING for _, info in rows[ended:][:18])
    assert rows[-1][1].claim.holds


@pytest.mark.parametrize("where", ["behind", "start", "free"])
def test_it_does_not_back_up_into_what_is_behind_or_without_need(
    reversing, straight, where
):
    """Something near behind, the start of its path, or nothing that stops it."""
    along = 3.0 if where == "start" else 65.0
    posts = circles(jnp.asarray([[along + 4.0, 0.0], [along - 4.0, 0.0]]), 0.8)
    present = jnp.asarray([where != "free", where == "behind"])
    posts = posts._replace(present=present)
    rows = drive_back(
        reversing, straight, posts, 40, np.float32([along, 0.0, 0.0, 0.0])
    )
    assert not any(info.lane.reversing for _, info in rows)
    assert (rows[-1][0][0] > along + 1.0) == (where == "free")


@pytest.mark.parametrize("attack", ["inside", "nan", "edge"])
def test_what_is_attacked_is_not_admitted(lane, road, attack):
    none = circles(beside(road, POSTS[:1]), 0.8)
    none = none._replace(present=jnp.zeros(1, bool))
    rows = drive(lane, road, lambda *_: none, 4)
    act = lane[1]
    car, state, info = rows[-1]
    assert bool(info.lane.admissible)
    place = car[:2] + (np.nan if attack == "nan" else 0.0)
    posts, lane_now = circles(jnp.asarray(place)[None], 0.8), road
    if attack == "edge":
        posts, lane_now = none, road._replace(left=jnp.full(700, 0.5))
    before = state
    _, state, info = act(
        None, state, car, jnp.asarray([0.9, 0.0]), (lane_now, nine(posts))
    )
    assert not bool(info.lane.admissible)
    assert bool(info.lane.stopping)
    assert bool(info.healthy) == (attack != "nan")
    assert np.isnan(info.lane.clearance) if attack == "nan" else True
    assert np.all(np.isfinite(info.lane.reference))
    assert info.lane.reference[-1, 3] < 2.0
    # It brakes where it is, and does not swerve.
    moved = int(state.committed.index - before.committed.index)
    np.testing.assert_allclose(
        state.committed.move[:100],
        before.committed.move[moved : moved + 100],
        atol=1e-6,
    )


def test_a_batch_of_laps_is_each_of_them_and_one_program(lane):
    angle = np.linspace(0.0, 2 * np.pi, 2000, endpoint=False)
    path = path_through(
        jnp.asarray(80.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)), closed=True
    )
    assert isinstance(path, Lap)
    driver, traced = lane[0], []

    def step(*inputs):
        traced.append(inputs)
        return driver.act(*inputs)

    act, track = jit(step), lane_along(path, width=9.0, speed=9.0)
    rows = drive(
        (driver, act),
        track,
        lambda *_: circles(jnp.asarray([[80.0, 80.5]]), 0.8),
        600,
        speed=9.0,
    )
    assert len(traced) == 1
    cars = np.stack([car for car, _, _ in rows])
    radius = np.hypot(cars[:, 0], cars[:, 1] - 80.0)
    assert np.all(np.abs(radius - 80.0) < 4.0)
    assert np.diff(np.unwrap(cars[:, 2])).min() > -0.02
    states = jax.tree.map(lambda *leaf: jnp.stack(leaf), rows[10][1], rows[300][1])
    scene = track, circles(jnp.asarray([[80.0, 80.5]]), 0.8)
    where = jnp.stack([rows[11][0], rows[301][0]])
    batch = jit(
        jax.vmap(
            lambda state, car: driver.act(
                None, state, car, jnp.asarray([0.9, 0.0]), scene
            )
        )
    )
    _, _, info = batch(states, where)
    for one, number in enumerate((11, 301)):
        np.testing.assert_allclose(
            info.lane.reference[one], rows[number][2].lane.reference, atol=2e-3
        )


@pytest.mark.parametrize("name", ["dynamic_path", "kinematic_path"])
def test_a_shipped_policy_drives_in_a_lane_of_its_own_class(name, road):
    policy = sfkd_jax.load(name)
    driver, size = policy.in_lane(), len(policy.vehicle.state_names)
    posts, at = circles(beside(road, POSTS), 0.8), jnp.zeros(size)

    def told(lane, seen=posts):
        """Only traced: what is missing or of another shape fails here."""
        start, scene = driver.init(jax.random.key(0)), (lane, seen)
        return driver.act(policy.params, start, at, jnp.zeros(2), scene)[2]

    info = jax.eval_shape(told, road)
    assert info.lane.reference.shape == (policy.interface["horizon"], 4)
    shapes = {leaf.shape for leaf in jax.tree.leaves(info.lane[1:])}
    assert shapes == {info.claim.bound.shape} == {()}
    nothing = circles(jnp.zeros((0, 2)), 0.8)
    assert jax.eval_shape(told, road, nothing).lane.reference.shape[1] == 4
    with pytest.raises(ValueError, match=r"of a lane have the shape \(700,\)"):
        jax.eval_shape(told, road._replace(left=jnp.ones(3)))
    with pytest.raises(ValueError, match="no certified corridor"):
        sfkd_jax.load("dynamic").in_lane()
