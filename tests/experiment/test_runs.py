"""Run directories, data sets and certificates: what is kept, and what is refused."""

import json

import numpy as np
import pytest
from composing import run, settings
from helpers import dataset

from sfkd_jax.experiment import dataset_files, stages
from sfkd_jax.experiment.run import Run
from sfkd_jax.settings import replace
from sfkd_jax.store import ArtefactError, write_json


@pytest.mark.parametrize("name", ["[a]", "trial=[1,2]"])
def test_a_path_that_checkpoints_cannot_be_read_from_is_refused_at_once(tmp_path, name):
    with pytest.raises(ValueError, match=r"cannot be read back from a path with \[ \]"):
        Run.of(replace(settings(), root=str(tmp_path), name=name)).claim()
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_kept_nothing_does_not_block_its_correction(tmp_path):
    """A first attempt with a mistake records its settings before it fails."""
    first = replace(settings(), root=str(tmp_path), name="a=0.1,b=c d")
    second = replace(first, training=replace(first.training, steps=25))
    Run.of(first).claim()
    Run.of(second).claim()
    recorded = Run.of(second).directory / "settings.json"
    assert json.loads(recorded.read_text())["training"]["steps"] == 25
    (recorded.parent / "checkpoints" / "25").mkdir(parents=True)
    Run.of(second).claim()
    with pytest.raises(ArtefactError, match=r"training.steps was 25, is now 4000"):
        Run.of(first).claim()


def test_a_data_set_comes_back_with_the_scenario_of_every_segment(tmp_path):
    source, made = run(f"root={tmp_path}").source, dataset(count=20, steps=8)
    dataset_files.write(source.path, made, source.config)
    stored = source.dataset
    for part, labels in made.scenarios.items():
        np.testing.assert_array_equal(stored.scenarios[part], labels)
        assert len(labels) == len(getattr(stored, part).controls)


@pytest.fixture
def certified(monkeypatch, tmp_path):
    """How often a policy is certified where a certificate records some settings."""
    made = []
    monkeypatch.setattr(stages, "certify_policy", made.append)
    monkeypatch.setattr(Run, "policy", None)

    def count(recorded, *overrides):
        first = run(f"root={tmp_path}", *recorded)
        first.directory.mkdir(parents=True, exist_ok=True)
        first.policy_path.touch()
        document = {
            "valid": True,
            "provenance": {"settings": stages._recorded_certification(first)},
        }
        write_json(first.certificate_path, document)
        made.clear()
        stages.ensure_certificate(run(f"root={tmp_path}", *overrides))
        return len(made)

    return count


def test_a_certificate_with_the_same_settings_is_kept(certified):
    assert certified(()) == certified((), "certification.renew=true") == 0
    # Who signs it changes nothing of what is claimed.
    assert certified((), "certification.signing_key=key.pem") == 0


@pytest.mark.parametrize(
    "change",
    [
        "certification.level=0.8",
        "certification.corridor.runs=99",
        "latency.controls=[0.1]",
    ],
)
def test_one_with_other_settings_is_made_again(certified, change):
    """Otherwise cells would be driven with it and filed under the new settings."""
    assert certified((), change) == 1


ALONG = ("+experiment=s3",)
PATH_MODELS = {
    "sfkd": ("model=sfkd_path",),
    "free": ("model=sfkd_path", "model.residual=free", "model.learn_alpha=false"),
    "neural_ode": ("model=neural_ode", "model.frame=path", "training=state_model"),
}


def check(*overrides):
    stages.check_settings(run(*ALONG, *overrides))


@pytest.mark.parametrize("name", PATH_MODELS)
def test_every_path_model_builds_with_its_planner(name):
    check(*PATH_MODELS[name])


def test_latency_is_of_every_sensor_and_control_or_of_all():
    """Another number, or one that no buffer holds, is refused before anything is made."""
    assert run(*ALONG, "latency.sensors=[0.1]").latency.sensors == (0.1,) * 4
    with pytest.raises(ValueError, match=r"latency\.sensors needs one number or 4"):
        check("latency.sensors=[0.1,0.2]")
    with pytest.raises(ValueError, match="must be in"):
        check("latency.controls=[3.0]")
    with pytest.raises(ValueError, match="latency needs a model in path coordinates"):
        stages.check_settings(run("+experiment=s3_body", "latency.controls=[0.1]"))


def test_a_law_alone_is_a_system_along_a_path_only():
    alone = "evaluation.systems=[law,law_nominal,law_plant]"
    check(alone)
    with pytest.raises(ValueError, match="systems entry 'law'"):
        check(alone, "dataset=standard", "model=sfkd", "controller=mppi")


def test_path_coordinates_for_data_and_model_or_for_neither():
    for overrides in (("dataset=standard",), ("model=sfkd", "controller=mppi")):
        with pytest.raises(ValueError, match="go together"):
            check(*overrides)
