"""Defaults follow the size and the speed of a vehicle of the user's own."""

import numpy as np
import pytest
from composing import composed, settings

from sfkd_jax.experiment import scaling
from sfkd_jax.experiment.options import parse_settings
from sfkd_jax.store import plain

STEP = "vehicle.step=somewhere:step"
CAR = ("vehicle.control_low=[-0.5,-6]", "vehicle.control_high=[0.5,3]")
SPEED = "dataset.speed=[1.5,4.0]"


def own(wheelbase, *words, limits=CAR):
    words = ("vehicle=own", STEP, f"vehicle.wheelbase={wheelbase}", *limits, *words)
    return settings("+experiment=s3", *words)


def unscaled(*words):
    return own(2.7, *words, "scaled=false")


def test_a_car_keeps_every_default_to_the_last_bit():
    assert scaling.scale_of(own(2.7).vehicle) == scaling.Scale()
    assert own(2.7).dataset == unscaled().dataset
    assert own(2.7).training == unscaled().training
    assert own(2.7).controller == unscaled().controller
    assert own(2.7).scenario == unscaled().scenario
    assert own(2.7).evaluation == unscaled().evaluation
    for option in ("vehicle=kinematic", "vehicle=dynamic vehicle.front_length=0.1"):
        words = ("+experiment=s3", *option.split())
        values = parse_settings(plain(settings(*words)))
        assert settings(*words, "scaled=false").dataset == values.dataset


def test_two_vehicles_of_one_shape_have_the_same_problem_in_their_own_units():
    """Half the length at the same gravity: speeds shrink with the root of it."""
    small = own(2.7 / 4)
    car = own(2.7)
    length, speed = 0.25, 0.5
    for name, how in scaling.SCALED.items():
        if scaling._get(car, name) is None:
            continue
        factor = how.factor(scaling.Scale(length, speed, 1.0, 1.0 / length))
        theirs = np.asarray(scaling._get(car, name))
        ours = np.asarray(scaling._get(small, name))
        wanted = theirs * factor
        if how.entry is not None:
            wanted[1 - how.entry] = theirs[1 - how.entry]
        np.testing.assert_allclose(ours, wanted, rtol=5e-3, err_msg=name)
    drives = small.dataset
    # What has no unit is the same: way of a turn in wavelengths, sharpness of a bend.
    for vehicle in (drives, car.dataset):
        np.testing.assert_allclose(
            vehicle.peak_curvature * vehicle.wavelengths[0], 0.05 * 50.0, rtol=5e-3
        )
        grip = vehicle.speed[1] ** 2 / vehicle.lateral_acceleration
        np.testing.assert_allclose(grip * vehicle.peak_curvature, 3.6, rtol=5e-3)


def test_what_was_typed_stays_and_the_rest_follows_the_speed_that_was_typed():
    chosen = own(0.32, SPEED, "dataset.law.lateral=7", "training.loss.tube=[0.1]")
    assert chosen.dataset.speed == (1.5, 4.0)
    assert chosen.dataset.law.speed == (1.5, 4.0)
    assert chosen.dataset.law.lateral == 7.0
    assert chosen.scenario.speed == 3.33
    assert chosen.training.loss.size == 0.119
    as_typed = unscaled(SPEED)
    assert as_typed.dataset.peak_curvature == 0.05
    assert as_typed.dataset.speed == (1.5, 4.0)
    # An option of a group is no setting: its values are defaults as well.
    assert own(0.32, "dataset=path").dataset.wavelengths == (5.93, 23.7)


@pytest.mark.parametrize(
    ("wheelbase", "speed", "limits"),
    [
        (0.32, (1.5, 4.0), ([-0.4, -2.5], [0.4, 5.0])),
        (9.0, (4.0, 20.0), ([-0.6, -3.5], [0.6, 0.9])),
        (0.5, (0.2, 1.0), ([-0.7, -1.0], [0.7, 1.0])),
    ],
)
def test_a_car_at_a_tenth_a_truck_and_a_robot_stay_within_their_limits(
    wheelbase, speed, limits
):
    low, high = limits
    words = (
        f"vehicle.control_low={low}".replace(" ", ""),
        f"vehicle.control_high={high}".replace(" ", ""),
    )
    dataset = f"dataset.speed={list(speed)}".replace(" ", "")
    drives = own(wheelbase, dataset, limits=words).dataset
    law = drives.law
    tightest = np.tan(high[0]) / wheelbase
    assert drives.peak_curvature <= tightest / 3
    # Three quarters of what the weaker of engine and brake reaches.
    assert 0 < drives.acceleration <= 0.75 * min(-low[1], high[1])
    assert law.speed == drives.speed == speed
    # The law is tabled beyond its class of roads, as that of a car.
    np.testing.assert_allclose(
        law.lateral_acceleration / drives.lateral_acceleration, 1.1, rtol=0.02
    )
    assert drives.lateral_acceleration <= 2.0
    # The roads use the curvature that they may have, at some of the speeds.
    assert drives.lateral_acceleration / speed[0] ** 2 >= drives.peak_curvature


def test_a_simulator_states_its_speeds_and_its_sensors_follow_its_size():
    words = (
        "+experiment=s3",
        "vehicle=simulator",
        "vehicle.env=tests.driving.plants.simulators:Small",
    )
    chosen = settings(*words)
    assert chosen.dataset.speed == (0.5, 3.0)
    assert chosen.dataset.law.speed == (0.5, 3.0)
    noise = chosen.evaluation.observation_noise
    assert noise["p_x"] == 0.0015
    assert noise["yaw"] is None
    line = scaling.summary(chosen)
    for name in (*scaling.SCALED, "evaluation.observation_noise.p_x"):
        value = scaling._get(chosen, name)
        assert f"{name}=" in line or value is None
    assert "\n" not in line
    typed = settings(*words, "evaluation.observation_noise.p_x=0.5")
    assert typed.evaluation.observation_noise["p_x"] == 0.5
    assert scaling.summary(settings(*words, "scaled=false")) is None


def test_every_setting_that_follows_the_vehicle_is_one():
    options = {"controller.cem": "cem", "controller.gradient": "gradient"}
    for name in scaling.SCALED:
        controller = options.get(name.rpartition(".")[0])
        words = (f"controller={controller}",) if controller else ()
        value = scaling._get(settings("+experiment=s3", *words), name)
        assert value is not None, name
    assert composed("+experiment=s3").scaled is True
