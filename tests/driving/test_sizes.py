"""What is as large as the vehicle: bodies, lanes and obstacles, relative to a car."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving import plants
from sfkd_jax.driving.paths import path_from_curvature
from sfkd_jax.driving.scenarios import BOX, DriveClass, in_view, scenario
from sfkd_jax.driving.scenarios._scenarios import random_course
from sfkd_jax.driving.simulation.metrics import LANE_HALF_WIDTH, room_in_lane
from sfkd_jax.driving.sizes import CAR, CAR_SPEED, CAR_WHEELBASE, scale_of


def test_the_car_has_a_scale_of_one_to_the_last_bit():
    assert scale_of(CAR_WHEELBASE, CAR_SPEED) == CAR
    assert DriveClass().speed[1] == CAR_SPEED
    for factory in plants.FACTORIES.values():
        assert factory().wheelbase == CAR_WHEELBASE
        assert factory().size == (4.5, 2.0)
    assert plants.own(wheelbase=CAR_WHEELBASE).size == (4.5, 2.0)
    assert room_in_lane((4.5, 2.0)) == LANE_HALF_WIDTH - 0.9


@pytest.mark.parametrize("scale", [0.1, 0.5])
def test_a_small_vehicle_has_a_small_body_and_a_lane_of_its_own(scale):
    body = plants.own(wheelbase=scale * CAR_WHEELBASE).size
    np.testing.assert_allclose(body, (scale * 4.5, scale * 2.0))
    np.testing.assert_allclose(room_in_lane(body), scale * 0.85)


def test_a_long_vehicle_drives_on_the_roads_of_cars():
    body = plants.own(wheelbase=9.0).size
    np.testing.assert_allclose(body, (15.0, 2.0))
    assert room_in_lane(body) == room_in_lane((4.5, 2.0))


def test_obstacles_of_a_small_vehicle_are_a_course_in_its_own_units():
    scale = 0.125
    road = path_from_curvature(jnp.zeros(1001), spacing=0.5)
    # Paths have samples 0.5 m apart, whatever drives on them.
    short = path_from_curvature(jnp.zeros(126), spacing=0.5)
    key = jax.random.key(5)
    car = random_course(key, road)
    small = random_course(key, short, scale=scale)
    count = len(small.along)
    np.testing.assert_allclose(small.along, scale * car.along[:count], rtol=1e-5)
    np.testing.assert_allclose(small.view, scale * car.view[:count])
    np.testing.assert_allclose(small.lane.left[0], scale * car.lane.left[0])
    np.testing.assert_allclose(small.obstacles.radius[0], scale * 0.8)
    for place in (0.0, 150.0, 300.0):
        of_car = in_view(car, jnp.asarray(place))
        of_small = in_view(small, jnp.asarray(scale * place))
        np.testing.assert_array_equal(of_small.present, of_car.present)
        seen = np.asarray(of_car.present)
        np.testing.assert_allclose(
            of_small.position[seen], scale * of_car.position[seen], rtol=1e-4, atol=1e-4
        )


def test_a_short_road_bends_soon():
    """Of a robot, whose whole episode is shorter than the run-up of a car."""
    options = {"name": "s3", "duration": 20.0, "speed": 0.8, "state_size": 4, "dt": 0.1}
    box = {"env_low": BOX[0], "env_high": BOX[1], "wavelengths": (9.0, 30.0)}
    bends = {}
    for scale in (1.0, 0.185):
        road = scenario(**options, **box, peak_curvature=0.1, scale=scale)
        path = road(jax.random.key(0)).path
        bends[scale] = np.abs(path.points[:20, 3]).max()
    assert bends[0.185] > 2.0 * bends[1.0]
