"""Ranges: a wrong value of any setting of any option is refused in one line."""

import copy
import dataclasses
import math
import random
import re
from functools import cache

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import build
from sfkd_jax.cli import config, groups, messages, ranges
from sfkd_jax.pipeline import dry_run
from sfkd_jax.ranges import Interval

MODELS = (
    "sfkd",
    "koopman_mpc",
    "control_synth",
    "icode",
    "icode_mppi",
    "neural_ode",
    "r2dn",
)
OPTIONS = (
    *(f"model={name}" for name in MODELS),
    "controller=cem",
    "controller=gradient",
    "controller=koopman_mpc",
    "vehicle=dynamic",
    "vehicle=own",
    "dataset=files",
    "dataset=path",
    "comparison=paper",
)
SIGNED = {
    "vehicle.wind_lever",
    "vehicle.control_low",
    "vehicle.control_high",
    "dataset.env_low",
    "dataset.env_high",
}
SIGNED |= {"evaluation.env_sensor.bias"}
"""Settings whose numbers may be negative."""
FREE = {"evaluation.variation", "comparison.paper", "comparison.controllers", "hydra"}
SAMPLE = 160
UNKNOWN = {
    "vehicle.name": "boat",
    "vehicle.inner_loop": "torque",
    "scenario.name": "s9",
    "model.name": "sfdk",
    "model.frame": "boddy",
    "model.residual": "some",
    "model.budget": "all",
    "controller.planner": "mpppi",
    "controller.sampling": "none",
    "controller.mppi.noise": "brown",
    "controller.mppi.risk": "most",
    "certification.mode": "both",
    "evaluation.systems": ["self", "oracel"],
    "env_source": "guessed",
}
TOGETHER = {
    "dataset.shares": [0.5, 0.5, 0.5, 0.5],
    "training.window": 51,
    "dataset.env_low": [0.95, -8.0],
    "model.rank": 7,
    "controller.mppi.effective_samples": 1501.0,
    "controller.mppi.smoothing_window": 4,
    "controller.cem.elites": 501,
    "dataset.speed": [13.0, 7.0],
}
"""Each is in its range, but contradicts the other settings."""


@cache
def composed(option):
    config.register()
    with initialize_config_dir(config.conf_path(), version_base="1.3"):
        return compose("config", overrides=[option])


def leaves(settings, above=""):
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def container(option):
    return OmegaConf.to_container(composed(option), resolve=True)


def names(option):
    return dict(leaves(container(option)))


def check(name, value):
    settings = copy.deepcopy(composed("model=sfkd"))
    OmegaConf.update(settings, name, value, force_add=True)
    ranges.check(settings, groups.root_schema())


def use(settings):
    """What `train` does before anything is made."""
    plant = build.build_vehicle(settings["vehicle"])
    build.build_scenario(
        settings["scenario"], plant, duration=settings["evaluation"]["episode_s"]
    )
    dry_run.check_settings(settings, plant)


def refusal(option, name, value):
    """The line with which a setting is refused, by its type or its value; None if it
    is accepted.
    """
    settings = composed(option)
    before = OmegaConf.select(settings, name)
    before = OmegaConf.to_container(before) if OmegaConf.is_config(before) else before
    try:
        OmegaConf.update(settings, name, value)
        use(config.plain_settings(settings))
    except OmegaConfBaseException as reason:
        return f"{name}: {messages.one_line(reason)}"
    except ValueError as reason:
        return str(reason)
    else:
        return None
    finally:
        OmegaConf.update(settings, name, before, merge=False)


def impossible(name, value):
    """Values that a setting cannot have, whatever its annotation states: of another
    type, not finite, or below 0.
    """
    sample = value[0] if isinstance(value, list) and value else value
    if value == []:
        return ["word", [math.nan], [{"a": 1}]]
    if isinstance(value, bool):
        return ["perhaps", 2.5, [True], None]
    if isinstance(sample, str):
        return [[], ["a"], None] if not isinstance(value, list) else ["word", [""], 7]
    numbers = ["many", math.nan, math.inf, -math.inf, 1e39, {"a": 1}]
    numbers += [] if name in SIGNED else [-1]
    numbers += [2.5, 10**12] if isinstance(sample, int) else []
    return (
        [[number] * len(value) for number in numbers] + [7, "word"]
        if isinstance(value, list)
        else [*numbers, []]
    )


def wrong():
    """Name and value of every wrong setting of every option, each name once, then a
    sample of them.
    """
    cases = {}
    for option in OPTIONS:
        for name, value in names(option).items():
            if (
                name.partition(".")[0] in ("comparison", "report")
                or value in (None, "???")
                or name in FREE
            ):
                continue
            cases |= {
                (name, repr(one)): (option, name, one)
                for one in impossible(name, value)
            }
    return random.Random(0).sample(list(cases.values()), SAMPLE)


def test_settings_of_the_wrong_type_or_size_are_refused_in_one_line_that_names_them():
    accepted, odd = [], []
    for option, name, value in wrong():
        line = refusal(option, name, value)
        accepted += [(name, value)] if line is None else []
        odd += (
            [(name, value, line)]
            if line and ("\n" in line or name.split(".")[-1] not in line)
            else []
        )
    assert accepted == []
    assert odd == []


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_choice_is_refused_before_anything_is_made(name):
    line = refusal("model=sfkd", name, UNKNOWN[name])
    assert line
    assert "\n" not in line
    value = UNKNOWN[name]
    assert (value if isinstance(value, str) else value[-1]) in line


@pytest.mark.parametrize("name", TOGETHER)
def test_settings_that_contradict_others_are_refused_before_anything_is_made(name):
    planner = {"controller.cem.elites": "controller=cem"}.get(name, "model=sfkd")
    line = refusal(planner, name, TOGETHER[name])
    assert line
    assert "\n" not in line
    assert re.search(
        name.split(".")[-1].replace("env_low", "env_low|environments"), line
    )


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("training.batch", 0, "training.batch must be in [1, inf), got 0"),
        ("dataset.segments", -5, "dataset.segments must be in [4, inf), got -5"),
        ("certification.level", 1.5, "certification.level must be in (0, 1), got 1.5"),
        (
            "controller.mppi.num_samples",
            0,
            "controller.mppi.num_samples must be in [1, inf), got 0",
        ),
        ("evaluation.episodes", 0, "evaluation.episodes must be in [1, inf), got 0"),
        ("scenario.speed", math.nan, "scenario.speed must be in (0, inf), got nan"),
        (
            "scenario.wavelengths",
            [50.0],
            "scenario.wavelengths must be 2 entries, got [50.0]",
        ),
        (
            "scenario.wavelengths",
            [160.0, 50.0],
            "scenario.wavelengths must be in rising order, got [160.0, 50.0]",
        ),
        (
            "model.residual_hidden",
            [],
            "model.residual_hidden must be at least one entry, got []",
        ),
        ("seed", "abc", "seed must be a whole number, got 'abc'"),
        ("seed", True, "seed must be a whole number, got True"),
        ("name", 5, "name must be words, got 5"),
        ("name", " ", "name must be words, not nothing, got ' '"),
        ("root", None, "root must be set, got None"),
        ("demo", 5, "demo.episodes must be set, got None"),
        (
            "evaluation.episode_s",
            1.0,
            "evaluation.episode_s must be in (2, inf), got 1.0",
        ),
        (
            "comparison.seeds",
            [-1],
            "comparison.seeds must be in [0, inf) each, got [-1]",
        ),
        ("comparison.share", 5, "comparison.share must be 2 entries, got 5"),
        ("comparison.rows.sfkd", 5, "comparison.rows.sfkd must be words, got 5"),
    ],
)
def test_the_line_says_what_a_setting_must_be_and_what_it_is(name, value, says):
    assert refusal("comparison=paper", name, value) == says


def fields(schema, above):
    for entry in dataclasses.fields(schema):
        if dataclasses.is_dataclass(entry.type):
            yield from fields(entry.type, f"{above}.{entry.name}")
        else:
            yield f"{above}.{entry.name}", entry.metadata["rule"]


def rules():
    listed = {
        f"{group}/{name}": schema
        for group, schemas in groups.schemas().items()
        for name, schema in schemas.items()
    }
    return [
        pair
        for option, schema in (listed | {"": groups.root_schema()}).items()
        for pair in fields(schema, option)
    ]


def test_every_setting_states_what_it_may_be():
    free = [name for name, rule in rules() if rule.kind is None and rule.values is None]
    assert free == []


def test_every_interval_excludes_a_number_that_its_kind_would_allow_or_allows_more():
    """An annotation that states the default would say nothing."""
    stated = {rule.interval for _, rule in rules() if rule.interval}
    assert {Interval("(0, inf)"), Interval("(0, 1)"), Interval("[2, inf)")} <= stated
    assert [
        name
        for name, rule in rules()
        if rule.interval and rule.interval == ranges.DEFAULT[rule.kind]
    ] == []


@pytest.mark.parametrize(
    "name",
    ["../../x", "a/../b", "/tmp/x", "a//b", "a/", "./a", "a\\b", "a\0b", "a\nb", ".."],
)
@pytest.mark.parametrize("setting", ["name", "model.system", "comparison.policies"])
def test_a_run_stays_below_the_root(setting, name):
    with pytest.raises(
        ValueError, match=rf"^{re.escape(setting)} must be a path below root"
    ) as refused:
        check(setting, name)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "name",
    [
        "smoke",
        "a/b",
        "tune/learning_rate=0.003,consistency=0.001",
        "Läufe 2",
        "a..b",
        ".a",
    ],
)
def test_names_with_folders_and_settings_in_them_are_names(name):
    check("name", name)


def test_the_keys_of_a_comparison_are_names_of_files():
    check("comparison.rows", {"noise 0.1 and 2 m/s": "model=sfkd"})
    with pytest.raises(
        ValueError, match=r"comparison\.rows must have keys that are names of files"
    ):
        check("comparison.rows", {" ../../x": "model=sfkd"})
