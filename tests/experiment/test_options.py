"""Every option of every group composes, builds, and is refused when it is wrong."""

from pathlib import Path

import pytest
from composing import composed, settings
from helpers import any_law, space
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import build, models, plants
from sfkd_jax.experiment import command

CONF = Path(command.conf_path())
OPTIONS = [
    (file.parent.name, file.stem)
    for file in sorted(CONF.glob("*/*.yaml"))
    if file.parent.name != "hydra"
]
LIMITS = ("vehicle.control_low=[-0.4,-3.0]", "vehicle.control_high=[0.4,2.0]")


def of(group):
    return [name for folder, name in OPTIONS if folder == group]


def test_there_are_few_and_short_option_files():
    assert len(list(CONF.rglob("*.yaml"))) <= 65
    for file in CONF.glob("*/*.yaml"):
        # Rows of a comparison and what was tuned for them take a line each.
        most = 80 if file.parent.name == "comparison" else 30
        assert len(file.read_text().splitlines()) <= most


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_is_within_the_ranges(group, option):
    prefix = "+" if group == "experiment" else ""
    own = ("model.factory=a:b",) if option == "own" and group == "model" else ()
    logs = ("dataset.path=logs",) if (group, option) == ("dataset", "files") else ()
    assert settings(f"{prefix}{group}={option}", *own, *logs).seed == 0


@pytest.mark.parametrize("option", of("model"))
def test_every_model_builds_and_names_its_system(option):
    own = ("model.factory=sfkd_jax.models:neural_ode",) if option == "own" else ()
    chosen = settings(f"model={option}", *own).model
    assert chosen.system == option.removesuffix("_tiny")
    build.build_model(chosen, space(), plants.kinematic())


@pytest.mark.parametrize("vehicle", of("vehicle"))
@pytest.mark.parametrize("controller", of("controller"))
def test_every_controller_builds_for_every_vehicle(vehicle, controller):
    limits = LIMITS if vehicle == "own" else ()
    chosen = settings(f"vehicle={vehicle}", f"controller={controller}", *limits)
    plant = build.build_vehicle(chosen.vehicle)
    along = chosen.controller.sampling == "law"
    law = any_law(len(plant.state_names) - 1) if along else None
    model = build.reference_systems(plant, law)["oracle"].model
    if chosen.controller.planner == "koopman_mpc":  # it needs a linear predictor
        model = models.FACTORIES["koopman_mpc"](space(len(plant.state_names) - 3))
    build.build_controller(chosen.controller, model, plant, law=law)


def test_every_learned_model_and_every_planner_has_an_option_file():
    assert set(models.FACTORIES) <= set(of("model"))
    assert set(build.PLANNERS) <= set(of("controller"))


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("+experiment=s9", "s1"),
        ("model=sfdk", "sfkd_no_fiber"),
        ("model.rnk=3", "rnk"),
        ("model.rank=abc", "abc"),
        ("modle.rank=3", "modle"),
        ("training.loss.growht=1", "growht"),
    ],
)
def test_a_wrong_option_is_refused_by_name(override, says):
    with pytest.raises((HydraException, OmegaConfBaseException), match=says):
        settings(override)


def test_an_added_setting_that_does_not_exist_is_refused_with_what_was_meant():
    with pytest.raises(ValueError, match=r"did you mean training.steps"):
        settings("+training.stepps=3")


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["environment.source=guessed"], "measured, estimated, none"),
        (["environment=estimated", "model=sfkd_no_fiber"], "reads the environment"),
    ],
)
def test_an_environment_that_nobody_can_learn_of_is_refused(overrides, says):
    with pytest.raises(ValueError, match=says):
        settings(*overrides)


def test_without_an_environment_no_model_reads_one():
    assert settings().model.environment
    assert not settings("environment=none").model.environment


def test_logs_are_of_a_robot_of_ones_own_unless_a_plant_is_named():
    logs = ("dataset=files", "dataset.path=logs")
    names = settings(*logs, "dataset.columns.state=[x,y,psi,v]").vehicle.state_names
    assert names == ("x", "y", "psi", "v")
    assert settings(*logs).vehicle.name == "own"
    assert settings(*logs).environment.low is None
    assert settings(*logs, "vehicle=dynamic").vehicle.name == "dynamic"


@pytest.mark.parametrize("planner", build.PLANNERS)
def test_a_controller_has_the_settings_of_its_own_planner(planner):
    chosen = composed(f"controller={planner}").controller
    assert set(build.PLANNERS) & set(chosen) == {planner} == {chosen.planner}


def test_a_planner_without_its_settings_is_refused():
    with pytest.raises(ValueError, match="choose the option controller=cem"):
        settings("controller.planner=cem")
