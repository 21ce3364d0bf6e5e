"""Run directories from which checkpoints cannot be read are refused before training;
data sets come back with the scenario of every segment.
"""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import dataset

from sfkd_jax import data as datasets
from sfkd_jax.pipeline import runs, stages
from sfkd_jax.store import ArtefactError

SETTINGS = {name: {} for name in runs.IDENTITY} | {
    "model": {"system": "sfkd"},
    "seed": 0,
    "name": "trial",
}


@pytest.mark.parametrize("name", ["[a]", "trial=[1,2]"])
def test_a_path_that_checkpoints_cannot_be_read_from_is_refused_at_once(tmp_path, name):
    with pytest.raises(ValueError, match=r"cannot be read back from a path with \[ \]"):
        runs.claim(SETTINGS | {"root": str(tmp_path), "name": name})
    assert list(tmp_path.iterdir()) == []


def test_other_unusual_names_are_claimed(tmp_path):
    settings = SETTINGS | {"root": str(tmp_path), "name": "a=0.1,b=c d"}
    runs.claim(settings)
    assert (Path(runs.run_directory(settings)) / "settings.json").exists()


def test_a_run_that_kept_nothing_does_not_block_its_correction(tmp_path):
    """A first attempt with a mistake records its settings before it fails."""
    first = SETTINGS | {"root": str(tmp_path)}
    second = first | {"training": {"steps": 25}}
    runs.claim(first)
    runs.claim(second)
    recorded = Path(runs.run_directory(second)) / "settings.json"
    assert json.loads(recorded.read_text())["training"] == {"steps": 25}
    (recorded.parent / "checkpoints" / "25").mkdir(parents=True)
    runs.claim(second)
    with pytest.raises(ArtefactError, match="was made with other settings"):
        runs.claim(first)


def generated(tmp_path):
    """Settings of a generated data set, which is stored."""
    box = {"env_low": [0.3, -8.0], "env_high": [0.9, 8.0]}
    settings = SETTINGS | {"root": str(tmp_path), "dataset": box}
    settings |= {"vehicle": {"name": "kinematic"}}
    runs.write_dataset(settings, dataset(count=20, steps=8))
    return settings


def test_a_data_set_comes_back_with_the_scenario_of_every_segment(tmp_path):
    stored, _ = runs.read_dataset(generated(tmp_path))
    for part, labels in dataset(count=20, steps=8).scenarios.items():
        np.testing.assert_array_equal(stored.scenarios[part], labels)
        assert len(labels) == len(getattr(stored, part).controls)


def test_a_data_set_of_an_earlier_version_is_refused_in_one_line(tmp_path):
    settings = generated(tmp_path)
    runs.write_dataset(settings, dataset(count=20, steps=8)._replace(scenarios=None))
    with pytest.raises(ArtefactError, match="made by an earlier version") as refusal:
        runs.read_dataset(settings)
    assert "\n" not in str(refusal.value)


def test_coverage_is_measured_on_the_segments_of_each_scenario(tmp_path, monkeypatch):
    monkeypatch.setattr(stages, "_switching", lambda options: "drives of S3")
    data = dataset(count=20, steps=8)
    labels = np.arange(len(data.test.controls)) % len(datasets.SCENARIOS)
    data = data._replace(scenarios={"test": labels})
    parts = stages.held_out_parts(generated(tmp_path), data)
    assert set(parts) == {"test", "s3", *np.take(datasets.SCENARIOS, np.unique(labels))}
    for code, name in enumerate(datasets.SCENARIOS):
        if name in parts:
            np.testing.assert_array_equal(
                parts[name].states, np.asarray(data.test.states)[labels == code]
            )


def test_baselines_stand_beside_the_errors_of_the_model():
    errors = jnp.asarray([[0.3, 0.4, 0.1, 0.2], [0.6, 0.8, 0.2, 0.3]])
    document = runs.open_loop_document(
        errors, dataset(count=20, steps=8).test, 0.1, {"constant_turn": 2.0 * errors}
    )
    assert document["steps"] == [1, 2]
    np.testing.assert_allclose(document["position_rmse_m"], [0.5, 1.0])
    turn = document["baselines"]["constant_turn"]
    assert set(turn) == set(document) - {"steps", "dt", "trajectories", "baselines"}
    np.testing.assert_allclose(turn["position_rmse_m"], [1.0, 2.0])
