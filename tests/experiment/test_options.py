"""Every option of every group composes, builds, and is refused when it is wrong."""

from pathlib import Path

import jax
import pytest
from composing import run, settings
from helpers import any_law, space
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import assembly, models, paper
from sfkd_jax.driving import plants
from sfkd_jax.experiment import command, evaluating

CONF = Path(command.conf_path())
OPTIONS = [
    (file.parent.name, file.stem)
    for file in sorted(CONF.glob("*/*.yaml"))
    if file.parent.name != "hydra"
]
LIMITS = ("vehicle.control_low=[-0.4,-3.0]", "vehicle.control_high=[0.4,2.0]")
GIVEN = {"own": LIMITS, "logged": LIMITS}
GIVEN |= {"simulator": ("vehicle.env=tests.driving.plants.simulators:Faulty",)}


def of(group):
    return [name for folder, name in OPTIONS if folder == group]


TOGETHER = {
    "first": "dataset=path training=path comparison=table1 scenario=s1 evaluation=standard",
    "second": "dataset=tiny training=standard comparison=none scenario=s2 export=standard",
    "third": "training=state_model environment=none scenario=s3 evaluation=benchmark "
    "tubes=standard",
    "estimated": "environment=estimated comparison=benchmark scenario=obstacles "
    "dataset=path_with_margin",
    "measured": "environment=measured comparison=benchmark_path dataset=standard",
    "logs": "dataset=files dataset.path=logs environment=logged certification=standard",
}
"""Options that go together: a composition takes a third of a second."""
TOGETHER |= {name: f"+experiment={name}" for name in of("experiment")}


def test_every_option_is_composed_here():
    """Models, controllers and vehicles are composed where they are built."""
    words = {word.lstrip("+") for words in TOGETHER.values() for word in words.split()}
    built = ("model", "controller", "vehicle")
    assert {
        f"{group}={option}" for group, option in OPTIONS if group not in built
    } <= words


@pytest.mark.parametrize("name", TOGETHER)
def test_every_option_composes_and_is_within_the_ranges(name):
    assert settings(*TOGETHER[name].split()).seed == 0


@pytest.mark.parametrize("option", of("model"))
def test_every_model_builds_and_names_its_system(option):
    own = ("model.factory=sfkd_jax.models:neural_ode",) if option == "own" else ()
    chosen = settings(f"model={option}", *own).model
    assert chosen.system == option.removesuffix("_tiny")
    assembly.build_model(chosen, space(), plants.kinematic())


@pytest.mark.parametrize(
    ("vehicle", "controller"),
    [(vehicle, "mppi_path") for vehicle in of("vehicle")]
    + [("dynamic", controller) for controller in of("controller")],
)
def test_every_controller_builds_on_every_vehicle(vehicle, controller):
    given = GIVEN.get(vehicle, ())
    chosen = settings(f"vehicle={vehicle}", f"controller={controller}", *given)
    plant = assembly.build_vehicle(chosen.vehicle)
    along = chosen.controller.sampling == "law"
    law = any_law(len(plant.state_names) - 1) if along else None
    model = assembly.reference_systems(plant, law)["oracle"].model
    if chosen.controller.planner == "koopman_mpc":  # it needs a linear predictor
        model = paper.koopman(space(len(plant.state_names) - 3))
    controller = assembly.build_controller(chosen.controller, model, plant, law=law)
    state = jax.eval_shape(controller.init, jax.random.key(0))
    # It starts with a plan of two seconds for steering and acceleration.
    assert (20, 2) in [leaf.shape for leaf in jax.tree.leaves(state)]


def test_every_learned_model_and_every_planner_has_an_option_file():
    assert set(models.FACTORIES | paper.MODELS) <= set(of("model"))
    assert set(assembly.PLANNERS) <= set(of("controller"))


@pytest.mark.parametrize(
    ("override", "says"), [("model=sfdk", "sfkd_no_fiber"), ("model.rnk=3", "rnk")]
)
def test_a_wrong_option_is_refused_by_name(override, says):
    with pytest.raises((HydraException, OmegaConfBaseException), match=says):
        settings(override)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["environment.source=guessed"], "measured, estimated, none"),
        (["environment=estimated", "model=sfkd_no_fiber"], "reads the environment"),
        (["environment=estimated", "environment.high=[0.3,-8]"], "is always"),
        (
            ["dataset=files", "dataset.path=x", "environment=estimated"],
            "logs train none; pass environment.source=measured or none",
        ),
        (["environment.roles=[friction]"], "environment.roles needs one of friction,"),
        (["environment.roles=[friction,friction]"], "and friction once at most"),
        (["environment.roles=[friction,gust]"], "got friction, gust"),
    ],
)
def test_an_environment_that_nobody_can_learn_of_is_refused(overrides, says):
    with pytest.raises(ValueError, match=says):
        settings(*overrides)


def test_what_an_entry_of_e_is_can_be_stated_and_is_read_from_known_names_alone():
    stated = settings("environment.roles=[side_force,friction]").environment
    assert plants.roles_of(("w", "mu"), stated.roles) == ("side_force", "friction")
    assert settings().environment.roles == ()
    names = ("friction [-]", "lateral wind [m/s]", "mass [kg]", "slope", "grip")
    known = ("friction", "side_force", "mass", "other", "other")
    assert plants.roles_of(names) == known


def test_a_root_may_begin_at_home():
    assert settings("root='~/x'").root == str(Path.home() / "x")


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


def test_a_planner_without_its_settings_is_refused():
    with pytest.raises(ValueError, match="choose the option controller=cem"):
        settings("controller.planner=cem")


def test_only_a_system_with_a_corridor_drives_round_obstacles():
    chosen = run("+experiment=s3_body", "scenario=obstacles")
    system = assembly.reference_systems(chosen.plant)["oracle"]
    with pytest.raises(ValueError, match=r"certified corridor, and oracle has none"):
        evaluating.SystemEvaluation(chosen, "oracle", system)
