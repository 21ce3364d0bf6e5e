"""The command line: the program sfkd, help, versions, mistyped settings, completion."""

import json
import shutil
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from sfkd_jax import __main__ as program
from sfkd_jax import __version__, build, certify, generate
from sfkd_jax.cli import completion, config, entry, help, messages, options
from sfkd_jax.cli.commands import COMMANDS, summary

ROOT = Path(__file__).parents[1]


def run(monkeypatch, capsys, main, *arguments):
    """The exit status of a command in this process, and its lines on both streams."""
    monkeypatch.setattr("sys.argv", ["sfkd", *arguments])
    try:
        main()
        status = 0
    except SystemExit as ended:
        status = ended.code
    printed = capsys.readouterr()
    return status, printed.out.splitlines(), printed.err.splitlines()


@cache
def composed(*overrides):
    config.register()
    with initialize_config_dir(config.conf_path(), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def refusal(*overrides):
    """The line about settings that cannot be composed or are unknown."""
    with pytest.raises((HydraException, ValueError)) as refused:
        config.plain_settings(composed(*overrides))
    if isinstance(refused.value, HydraException):
        return messages.one_line(refused.value, overrides)
    return str(refused.value)


def test_the_program_is_installed_under_its_name():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["scripts"] == {"sfkd": "sfkd_jax.__main__:main"}


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_without_a_command_the_commands_are_listed(monkeypatch, capsys, arguments):
    status, out, _ = run(monkeypatch, capsys, program.main, *arguments)
    assert status == 0
    for command in COMMANDS:
        (line,) = [line for line in out if line.split()[:1] == [command]]
        assert line.endswith(summary(command))
        assert summary(command).endswith(".")
    assert max(map(len, out)) <= help.WIDTH


def test_every_command_of_the_package_is_listed():
    files = (ROOT / "src" / "sfkd_jax").glob("*.py")
    runs = {file.stem for file in files if "hydra_command(run)()" in file.read_text()}
    assert runs == set(COMMANDS)


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (program.main, ("--version",)),
        (program.main, ("train", "--version")),
        (entry.hydra_command(generate.run), ("--version",)),
    ],
)
def test_the_version_is_that_of_the_package(monkeypatch, capsys, main, arguments):
    status, out, _ = run(monkeypatch, capsys, main, *arguments)
    assert (status, out) == (0, [f"sfkd_jax {__version__}"])


def test_the_program_runs_a_command_as_its_module_does(monkeypatch, capsys):
    for module in ("hydra.core.utils", "hydra._internal.hydra"):
        # It would close the handlers of the tests.
        monkeypatch.setattr(f"{module}.configure_log", lambda *_: None)
    monkeypatch.setattr(generate, "run", lambda settings: {"seed": settings["seed"]})
    status, out, err = run(monkeypatch, capsys, program.main, "generate", "seed=7")
    assert (status, json.loads(out[-1]), err) == (0, {"seed": 7}, [])


def test_an_unknown_command_is_one_line(monkeypatch, capsys):
    status, _, _ = run(monkeypatch, capsys, program.main, "trian")
    assert (
        status == "sfkd_jax: unknown command trian; did you mean train? sfkd lists them"
    )


@pytest.mark.parametrize("main", [program.main, None])
def test_help_is_a_page_with_every_option_and_no_schema(monkeypatch, capsys, main):
    arguments = ("generate", "--help") if main else ("+experiment=s3", "--help")
    start = main or entry.hydra_command(generate.run)
    status, out, _ = run(monkeypatch, capsys, start, *arguments)
    assert status == 0
    assert len(out) <= 45
    assert max(map(len, out)) <= help.WIDTH
    page = "\n".join(out)
    assert "schema" not in page
    assert summary("generate") in page
    words = page.replace("*", " ").split()
    for group in (*options.GROUPS, "experiment"):
        assert options.options(group)
        assert set(options.options(group)) <= set(words)
    assert "kinematic*" in page


def test_every_group_of_options_is_described():
    folders = {
        file.name for file in Path(config.conf_path()).iterdir() if file.is_dir()
    }
    described = {*options.GROUPS, options.EXPERIMENT, "hydra"}
    assert {name for name in folders if not name.startswith("_")} == described
    assert set(options.defaults()) == set(options.GROUPS)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("training.stepps=3", "did you mean training.steps?"),
        ("+training.stepps=3", "did you mean training.steps?"),
        ("traning.steps=3 modle=sfkd", "did you mean training.steps?"),
        ("modle=sfkd", "unknown setting modle; did you mean model?"),
        ("vehicle=dynamc", "vehicle=dynamc; did you mean dynamic?"),
        ("+experiment=s33", "+experiment=s33; did you mean s3?"),
        ("experiment=s3", "did you mean +experiment?"),
        (
            "controller=cem controller.mppi.num_samples=3",
            "did you mean controller.cem.num_samples?",
        ),
    ],
)
def test_a_mistyped_setting_is_refused_with_what_was_meant(overrides, says):
    line = refusal(*overrides.split())
    assert says in line
    assert "\n" not in line
    assert "append" not in line


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("stepps", "; did you mean dataset.steps or training.steps?"),
        ("experimant", "; did you mean +experiment?"),
        ("controler.mppi.horizon", "; did you mean controller.mppi.horizon?"),
        ("sead", "; did you mean seed?"),
        ("xyz", ""),
    ],
)
def test_the_closest_name_is_suggested(name, hint):
    known = list(messages.setting_names(OmegaConf.to_container(composed())))
    assert messages.unknown_setting(name, known) == f"unknown setting {name}{hint}"


def test_a_mistyped_setting_is_one_line_of_a_command(monkeypatch, capsys):
    status, out, err = run(
        monkeypatch, capsys, entry.hydra_command(generate.run), "training.stepps=3"
    )
    assert (status, out) == (1, [])
    assert err == [
        "sfkd_jax: unknown setting training.stepps; did you mean training.steps?"
    ]


@pytest.mark.parametrize("planner", build.PLANNERS)
def test_a_controller_has_the_settings_of_its_own_planner(planner):
    settings = composed(f"controller={planner}").controller
    assert set(build.PLANNERS) & set(settings) == {planner} == {settings.planner}


def test_a_planner_without_its_settings_is_refused():
    settings = config.plain_settings(composed("controller.planner=cem"))
    plant = build.build_vehicle(settings["vehicle"])
    model = build.reference_systems(plant)["oracle"].model
    with pytest.raises(ValueError, match="choose the option controller=cem"):
        build.build_controller(settings["controller"], model, plant)


def test_certify_announces_the_training_that_it_starts(monkeypatch, capsys, tmp_path):
    def stop(settings):
        raise ValueError("training begins")

    monkeypatch.setattr(certify.stages, "ensure_policy", stop)
    overrides = ("+experiment=s3", f"root={tmp_path}")
    with pytest.raises(ValueError, match="training begins"):
        certify.run(config.plain_settings(composed(*overrides)))
    (line,) = capsys.readouterr().err.splitlines()
    assert "s3/sfkd_path/seed=0 holds no trained policy" in line
    assert "at most 4000 steps, about 4 min on two cores" in line


def names(settings, above=""):
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from names(value, f"{above}{key}.")
        else:
            yield f"{above}{key}="


def test_completion_knows_every_option_and_every_setting():
    words = completion.words()
    assert len(words) == len(set(words))
    settings = OmegaConf.to_container(composed())
    assert {
        name
        for name in names(settings)
        if not name.startswith(("comparison.variations.", "comparison.page."))
    } <= set(words)
    assert {"+experiment=s3", "model=sfkd_path", "dataset.law.curvature="} <= set(words)
    assert not [word for word in words if "schema" in word]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_tab_key_completes_commands_options_and_parts_of_names():
    lines = [
        ("sfkd tr", ["train"]),
        ("sfkd train vehicle=dyn", ["dynamic", "dynamic_speed"]),
        ("sfkd train +experiment=smo", ["smoke"]),
        ("sfkd train seed=1 training.ste", ["training.steps="]),
        ("sfkd train training.lo", ["training.loss.", "training.log_every="]),
        ("sfkd train contr", ["controller=", "controller."]),
    ]
    asks = "\n".join(
        f"COMP_LINE={line!r} COMP_POINT={len(line)}; _sfkd 2>/dev/null; "
        'echo "${COMPREPLY[@]}"'
        for line, _ in lines
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", f"{completion.script(['bash'])}\n{asks}"],
        capture_output=True,
        text=True,
        check=True,
    )
    replies = [sorted(reply.split()) for reply in done.stdout.splitlines()]
    assert replies == [sorted(expected) for _, expected in lines]


def test_completion_of_another_shell_prints_its_usage(monkeypatch, capsys):
    _, out, _ = run(monkeypatch, capsys, program.main, "completion", "fish")
    assert out == completion.USAGE.splitlines()
