"""Defaults follow the size and the speed of a vehicle of the user's own."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composing import composed, settings

from sfkd_jax import assembly
from sfkd_jax.driving import plants
from sfkd_jax.driving.corridor import closed_loop
from sfkd_jax.driving.corridor._margins import delay_margin, linearised
from sfkd_jax.driving.path_following import derive_path_law
from sfkd_jax.experiment import scaling
from sfkd_jax.experiment.options import parse_settings
from sfkd_jax.settings import arguments
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
    """A quarter of the length at the same gravity: speeds shrink with the root of it."""
    small = own(2.7 / 4)
    car = own(2.7)
    length, speed = 0.25, 0.5
    for name, how in scaling.SCALED.items():
        if scaling._get(car, name) is None:
            continue
        # Its loop would be twice as fast as that of a car, and is 1/0.6 times as fast.
        factor = how.factor(scaling.Scale(length, speed, 1.0, 1.0 / length, 1.2))
        theirs = np.asarray(scaling._get(car, name))
        ours = np.asarray(scaling._get(small, name))
        wanted = theirs * factor
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
    chosen = own(wheelbase, dataset, limits=words)
    drives = chosen.dataset
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
    # S3 asks for no more than the class has.
    roads = chosen.scenario
    assert roads.speed**2 * roads.peak_curvature <= 1.01 * drives.lateral_acceleration
    # The roads use the curvature that they may have, at some of the speeds.
    assert drives.lateral_acceleration / speed[0] ** 2 >= drives.peak_curvature


def delay_margins(law_settings, wheelbase, dt):
    """How much later the commands of a law may act on a straight road [s], by speed."""
    share = wheelbase / 2.7
    bicycle = plants.kinematic(
        dt=dt, front_length=1.2 * share, rear_length=1.5 * share, drag=0.0
    )
    box = {"env_low": (0.8, -1.0), "env_high": (0.9, 1.0)}
    options = arguments(law_settings, derive_path_law) | box | {"points": (3, 4, 2)}
    law = jax.jit(partial(derive_path_law, bicycle.nominal, coordinates=3, **options))()
    # The textbook bicycle, whose tyres do not slip.
    bicycle = bicycle._replace(step=bicycle.nominal)
    model = assembly.reference_systems(bicycle, law)["oracle"].model
    loop = closed_loop(bicycle, model, {}, law, (0.01,) * 4)
    straight = jnp.asarray([0.0, 0.85, 0.0])

    sharpest = jnp.asarray(0.01 / wheelbase)

    def margin(speed):
        return delay_margin(linearised(loop, speed, sharpest, straight))

    speeds = jnp.linspace(*law_settings.speed, 4)
    return dt * np.asarray(jax.jit(partial(jax.lax.map, margin))(speeds))


def test_the_law_of_a_small_fast_car_tolerates_a_share_of_the_delay_of_a_car():
    """Delays are in seconds, and do not shrink with a vehicle."""
    of_car = delay_margins(own(2.7).dataset.law, 2.7, 0.1)
    small = own(0.32, SPEED).dataset.law
    softer = delay_margins(small, 0.32, 0.05)
    assert np.all(softer >= scaling.FASTEST_LOOP * of_car - 0.005)
    assert np.all(softer >= 0.06)
    # Lengths and speeds alone would make its loop faster.
    stiffer = own(0.32, SPEED, f"dataset.law.curvature={3900 * (0.32 / 2.7) ** 2}")
    assert np.all(delay_margins(stiffer.dataset.law, 0.32, 0.05) < 0.7 * softer)


def test_a_softer_law_has_a_smaller_perturbation_and_there_is_none_without_a_law():
    small = own(0.32, SPEED).dataset
    assert small.law.perturbation[0] < 0.02 / 2
    shares = np.divide(small.steering_excitation, own(2.7).dataset.steering_excitation)
    # A steady ν moves the vehicle as far as a car, in lengths of its own.
    np.testing.assert_allclose(shares, small.law.perturbation[0] / 0.02, rtol=5e-3)
    softness = (small.law.curvature / (3900 * (0.32 / 2.7) ** 2)) ** 0.25
    np.testing.assert_allclose(softness, 0.6 * 4.0 / 12.0 * 2.7 / 0.32, rtol=5e-3)
    np.testing.assert_allclose(shares, softness**-2, rtol=5e-3)
    words = ("vehicle=own", STEP, "vehicle.wheelbase=0.32", *CAR, SPEED)
    bodies = settings("+experiment=s3_body", *words)
    in_world = settings("+experiment=s3_body").dataset.steering_excitation
    assert bodies.dataset.steering_excitation == in_world


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
