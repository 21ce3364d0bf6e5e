"""Every option of every group composes, builds, and is refused when it is wrong."""

from pathlib import Path

import pytest
from helpers import any_law, space
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import build, models, plants
from sfkd_jax.cli import config

CONF = Path(config.conf_path())
GROUPS = sorted(
    folder.name
    for folder in CONF.iterdir()
    if folder.is_dir() and not folder.name.startswith("_")
)
OPTIONS = [
    (group, file.stem)
    for group in GROUPS
    for file in sorted((CONF / group).glob("*.yaml"))
]
MODELS = [name for group, name in OPTIONS if group == "model"]


def composed(*overrides: str) -> DictConfig:
    config.register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def settings(*overrides: str) -> dict:
    return OmegaConf.to_container(composed(*overrides), resolve=True)


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_is_within_the_ranges(group, option):
    prefix = "+" if group == "experiment" else ""
    plain = config.plain_settings(composed(f"{prefix}{group}={option}"))
    assert plain["seed"] == 0


@pytest.mark.parametrize("option", MODELS)
def test_every_model_option_builds_and_names_its_system(option):
    plain = settings(f"model={option}")
    if option == "own":
        plain["model"]["factory"] = "sfkd_jax.models:neural_ode"
    assert plain["model"]["system"] == option.removesuffix("_tiny")
    build.build_model(plain["model"], space(), plants.kinematic())


@pytest.mark.parametrize(
    "vehicle", [name for group, name in OPTIONS if group == "vehicle"]
)
@pytest.mark.parametrize(
    "controller", [name for group, name in OPTIONS if group == "controller"]
)
def test_every_controller_builds_for_every_vehicle(vehicle, controller):
    limits = (
        ("vehicle.control_low=[-0.4,-3.0]", "vehicle.control_high=[0.4,2.0]")
        if vehicle == "own"
        else ()
    )
    plain = settings(f"vehicle={vehicle}", f"controller={controller}", *limits)
    plant = build.build_vehicle(plain["vehicle"])
    law = (
        any_law(len(plant.state_names) - 1)
        if plain["controller"]["sampling"] == "law"
        else None
    )
    model = build.reference_systems(plant, law)["oracle"].model
    if (
        plain["controller"]["planner"] == "koopman_mpc"
    ):  # the only planner that needs a linear predictor
        model = models.FACTORIES["koopman_mpc"](space(len(plant.state_names) - 3))
    build.build_controller(plain["controller"], model, plant, law=law)
    build.build_scenario(plain["scenario"], plant, duration=6.0)


def test_every_learned_model_has_an_option_file():
    assert set(models.FACTORIES) <= set(MODELS)


def test_option_files_stay_short():
    assert all(
        len((CONF / group / f"{name}.yaml").read_text().splitlines()) <= 30
        for group, name in OPTIONS
        if name != "tuned"  # a line per row and vehicle, written by a program
    )


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


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["env_source=guessed"], "measured, estimated, none"),
        (["env_source=estimated", "model=sfkd_no_fiber"], "reads the environment"),
    ],
)
def test_an_environment_that_nobody_can_learn_of_is_refused(overrides, says):
    with pytest.raises(ValueError, match=says):
        config.plain_settings(composed(*overrides))


def test_without_an_environment_no_model_reads_one():
    assert config.plain_settings(composed())["model"]["environment"]
    assert not config.plain_settings(composed("env_source=none"))["model"][
        "environment"
    ]


def test_logs_are_of_a_robot_of_ones_own_unless_a_plant_is_named():
    columns = "dataset.columns.state=[x,y,heading,speed,rate]"
    assert settings("dataset=files", columns)["vehicle"]["state_names"] == [
        "x",
        "y",
        "heading",
        "speed",
        "rate",
    ]
    assert settings("dataset=files")["vehicle"]["name"] == "own"
    assert settings("dataset=files", "vehicle=dynamic")["vehicle"]["name"] == "dynamic"
