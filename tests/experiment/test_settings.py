"""A wrong value of any setting of any option is refused in one line that names it."""

import math

import pytest
from composing import plain_settings, settings
from helpers import put

from sfkd_jax import assembly
from sfkd_jax.experiment import stages
from sfkd_jax.experiment.options import parse_settings
from sfkd_jax.experiment.run import Run
from sfkd_jax.ranges import Bounds, Positive, Span
from sfkd_jax.settings import arguments, parse, replace, schema
from sfkd_jax.store import plain

OPTIONS = (
    *(f"model={name}" for name in assembly.MODELS if name != "own"),
    *(f"controller={name}" for name in assembly.PLANNERS),
    "vehicle=dynamic",
    "dataset=path",
)


def factory(model, *, size: int = 3, gain: Positive, span: Span = (1.0, 2.0)):
    return model, size, gain, span


def other(*, low: Bounds = (), high: Bounds = (), gain: int = 7):
    return low, high, gain


def test_a_schema_has_the_keyword_arguments_and_the_first_factory_defines_a_name():
    kind = schema("Kind", object, factory, other, skip=("size",))
    made = parse(kind, {"gain": 2.0, "span": [1, 4]})
    assert plain(made) == {"gain": 2.0, "span": [1, 4], "low": [], "high": []}
    assert made.span == (1, 4)
    assert arguments(made, factory) == {"gain": 2.0, "span": (1, 4)}
    assert parse(kind, made) is made
    assert replace(made, gain=3.0).gain == 3.0
    with pytest.raises(AttributeError):
        made.gain = 3.0


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({}, "of.gain must be set"),
        ({"gain": 0.0}, r"of.gain must be in \(0, inf\), got 0.0"),
        ({"gain": math.nan}, r"of.gain must be in \(0, inf\), got nan"),
        ({"gain": 1e39}, r"of.gain must be in \(0, inf\)"),
        ({"gain": True}, "of.gain must be a number, got True"),
        ({"gain": None}, "of.gain must be set, got None"),
        ({"gain": 1.0, "span": [2.0]}, "of.span must be 2 entries"),
        ({"gain": 1.0, "span": [2.0, 1.0]}, "of.span must be in rising order"),
        ({"gain": 1.0, "size": 2.5}, "of.size must be a whole number"),
        ({"gain": 1.0, "sise": 2}, "unknown setting of.sise; did you mean of.size?"),
        ({"gain": 1.0, "low": [2.0], "high": [1.0]}, "of.low must not lie above"),
        ({"gain": 1.0, "low": [2.0], "high": [3.0, 4.0]}, "of.low must not"),
        ([], "of must be settings by name"),
    ],
)
def test_the_line_says_what_a_setting_must_be_and_what_it_is(values, says):
    with pytest.raises(ValueError, match=says) as refused:
        parse(schema("Kind", object, factory, other), values, "of.")
    assert "\n" not in str(refused.value)


def use(name, value):
    """What `train` does before anything is made."""
    chosen = parse_settings(put(plain_settings(), name, value))
    run = Run.of(chosen)
    assembly.build_scenario(chosen.scenario, run.plant, duration=10.0)
    stages.check_settings(run)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vehicle.name", "boat"),
        ("scenario.name", "s9"),
        ("model.name", "sfdk"),
        ("controller.planner", "mpppi"),
        ("controller.sampling", "none"),
        ("controller.mppi.noise", "brown"),
        ("evaluation.systems", ["self", "oracel"]),
        ("dataset.shares", [0.5, 0.5, 0.5, 0.5]),
        ("training.window", 51),
        ("model.lift", "states"),
        ("controller.mppi.smoothing_window", 4),
        ("dataset.speed", [13.0, 7.0]),
    ],
)
def test_what_nothing_can_use_is_refused_before_anything_is_made(name, value):
    """An unknown choice, or a value that contradicts the other settings."""
    last = name.split(".")[-1]
    says = f"{last}|{value}" if isinstance(value, str) else last
    with pytest.raises(ValueError, match=says) as refused:
        use(name, value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("setting", ["name", "model.system", "comparison.policies"])
def test_a_run_stays_below_the_root(setting):
    for name in ("../x", "a/../b", "/tmp/x", "a//b", "a\\b", "a\0b"):
        with pytest.raises(ValueError, match=f"{setting} must be a path below root"):
            use(setting, name)


def test_plain_settings_come_back_as_the_same_objects():
    for option in OPTIONS:
        assert parse_settings(plain_settings(option)) == settings(option)
