"""A row of the benchmark from outside the package: examples/own_model.py."""

import json
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest
from helpers import last_line, run_command

import sfkd_jax
from sfkd_jax import assembly, models
from sfkd_jax.store import ArtefactError
from sfkd_jax.types import Space

EXAMPLE = (Path(__file__).parents[1] / "examples" / "own_model.py").read_text("utf-8")
SPACE = Space(*(part(size) for size in (1, 2, 2, 3) for part in (jnp.zeros, jnp.ones)))


STATE_MODEL = """
from sfkd_jax.models import state_model
def make(space):
    return state_model(lambda key: {{}}, lambda p, e: e, lambda e, x, u: {})
"""


def nothing(state, control, env):
    return jnp.zeros_like(state)


def named(monkeypatch, tmp_path, source, **settings):
    """The model of a factory in a new module."""
    name = f"made_{abs(hash(source))}"
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    factory = settings.pop("factory", f"{name}:make")
    return models.own(SPACE, nominal=nothing, factory=factory, **settings)


@pytest.mark.exhaustive
def test_a_stranger_adds_a_row_as_the_example_says(tmp_path):
    """The example on fewer data; a changed name of the function fails before anything
    is trained.
    """
    (tmp_path / "own_model.py").write_text(EXAMPLE)
    row = "model=own model.factory=own_model:corrected_bicycle model.system=mine"
    words = ["+experiment=benchmark", "name=mine"]
    words += [f"+comparison.rows.mine='{row} training=state_model'"]
    small = (
        "comparison.vehicles=[dynamic]",
        "comparison.seeds=[0]",
        "evaluation.episodes=2",
    )
    small += ("evaluation.episode_s=12",)
    small += ("comparison.controllers={mppi: [s3]}", "comparison.only=[oracle,mine]")
    small += ("dataset=tiny", "training.steps=50", "training.save_every=50")
    small += ("controller.mppi.num_samples=32", "evaluation.systems=[self]")
    wrong = [word.replace("corrected_bicycle", "bicycle") for word in words]
    refused = run_command("compare", *wrong, *small, cwd=tmp_path)
    assert "model.factory=own_model:bicycle" in refused.stderr
    assert "training mine" not in refused.stderr
    done = last_line(run_command("compare", *words, *small, cwd=tmp_path))
    rows = json.loads((tmp_path / done["results"]).read_text())["rows"]
    assert {row["system"] for row in rows} == {"oracle", "mine"}
    run = next((tmp_path / "runs").rglob("policy.safetensors"))
    with pytest.raises(ArtefactError, match="import own_model first"):
        sfkd_jax.load(run)
    assert "own_model" not in sys.modules


def test_options_and_what_is_offered_reach_the_factory(monkeypatch, tmp_path):
    source = (
        "from sfkd_jax.models import state_model\n"
        "def make(space, *, dt, gain):\n"
        "    return state_model(lambda key: {}, lambda p, e: e,\n"
        "                       lambda e, x, u: x + dt * gain * e[0])\n"
    )
    model = named(monkeypatch, tmp_path, source, dt=0.5, options={"gain": 4.0})
    state, control, env = jnp.zeros(4), jnp.zeros(2), jnp.asarray([3.0, 0.0])
    assert model.step(model.fiber({}, env), state, control)[0] == 6.0
    blind = named(
        monkeypatch, tmp_path, source, options={"gain": 4.0}, environment=False
    )
    assert blind.step(blind.fiber({}, env), state, control)[0] == 0.0


@pytest.mark.parametrize(
    ("source", "settings", "says"),
    [
        ("def make(space): return 3", {}, "returned int, not"),
        ("def make(space): return 3", {"options": {"a": 1}}, "argument 'a'"),
        ("def other(space): return 3", {}, "has no attribute 'make'"),
        ("", {"factory": "nowhere_at_all:make"}, "No module named"),
        ("def make(space): return {}['a']", {}, "KeyError: 'a'"),
        (STATE_MODEL.format("x @ u"), {}, "TypeError: .*contracting"),
        (STATE_MODEL.format("x[1:]"), {}, r"a state of \(4,\) one of \(3,\)"),
    ],
)
def test_a_factory_that_makes_no_model_is_one_line(
    monkeypatch, tmp_path, source, settings, says
):
    with pytest.raises(ValueError, match=says) as refusal:
        named(monkeypatch, tmp_path, source, **settings)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("factory", ["os:system", "importlib.util:find_spec"])
def test_a_stored_model_cannot_name_a_function_of_python(factory):
    """These modules are imported in every process, so that alone is no consent."""
    with pytest.raises(ValueError, match="Python's own"):
        assembly.check_imported({"model": {"factory": factory}})


@pytest.mark.parametrize("settings", [None, [], {}, {"model": None}, {"model": {}}])
def test_settings_without_a_factory_name_no_code(settings):
    assembly.check_imported(settings)
