"""Recorded runs through the commands: from csv files to a policy that loads."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from composing import run, settings
from helpers import last_line, run_command

import sfkd_jax
from sfkd_jax import assembly, collect, evaluate, generate
from sfkd_jax.certificate import write
from sfkd_jax.driving import plants
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.run import Run
from sfkd_jax.store import ArtefactError

sys.path.append(str(Path(__file__).parent / "driving" / "logs"))
sys.path.append(str(Path(__file__).parents[1] / "examples"))
from recorded import NAMES, recorded_run, write_csv
from recording import drive_by_hand, drive_under

STATE = "dataset.columns.state=[p_x,p_y,yaw,v,yaw_rate]"
SMALL = (
    "+experiment=smoke",
    "dataset=files",
    "dataset.path=logs",
    "dataset.steps=10",
    STATE,
    "environment.source=none",
)
TINY = (
    "model.rank=8",
    "model.vertices=3",
    "model.residual_hidden=[8,8]",
    "model.decoder_hidden=[8]",
    "model.budget=sum",
)
FAST = (
    "training.steps=25",
    "training.save_every=25",
    "training.window=5",
    "certification.horizon=5",
    "certification.attack_starts=0",
)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Eight runs with a yaw rate; nobody measured friction or wind."""
    folder = tmp_path_factory.mktemp("own") / "logs"
    folder.mkdir()
    for k in range(8):
        columns = recorded_run(seconds=12.0, phase=0.8 * k)
        columns["yaw_rate"] = np.gradient(columns["yaw"], columns["t"])
        write_csv(
            folder / f"{k}.csv",
            {
                name: columns[name]
                for name in columns
                if name not in ("friction", "wind")
            },
        )
    return folder


@pytest.mark.exhaustive
def test_logs_become_a_certified_policy_of_a_robot_that_nothing_drives(logs):
    document = last_line(
        done := run_command(
            "train", *SMALL, *TINY, *FAST, "model.environment=false", cwd=logs.parent
        )
    )
    assert document["results"] is None
    assert "not driven" in done.stderr
    assert "episodes of" not in done.stderr
    errors = json.loads((logs.parent / document["run"] / "open_loop.json").read_text())
    assert set(errors["baselines"]) == {"kinematic_bicycle", "least_squares"}
    fitted = errors["baselines"]["least_squares"]["position_rmse_m"]
    assert len(fitted) == len(errors["position_rmse_m"]) == 5
    certificate = json.loads((logs.parent / document["certificate"]).read_text())
    assert certificate["valid"]
    boxes = certificate["measured"]["boxes"]
    assert boxes["names"] == {
        "state": ["v", "yaw_rate"],
        "control": ["steering", "acceleration"],
        "env": [],
    }
    assert (logs.parent / document["report"]).exists()
    policy = sfkd_jax.load(logs.parent / document["run"])
    assert policy.certificate is not None
    limits = [policy.settings["vehicle"][f"control_{side}"] for side in ("low", "high")]
    assert limits == boxes["control"]
    assert not {"path"} & set(policy.settings["dataset"])


def test_logs_are_stored_with_their_coverage_and_only_test_runs_are_held_out(
    logs, monkeypatch
):
    monkeypatch.chdir(logs.parent)
    source = run(*SMALL).source
    dataset = source.dataset
    assert [part.states.shape[1:] for part in dataset[:4]] == [(11, 5)] * 4
    assert sum(len(part.states) for part in dataset[:4]) == 8 * 12
    assert set(source.held_out) == {"test"}
    assert source.held_out["test"] is dataset.test
    covered = json.loads((source.path.parent / "coverage.json").read_text())
    lags = generate.main(run(*SMALL))["command_lags"]
    # Samples of a smooth command, half a period early as commands that are held.
    assert lags["steering"]["low_s"] <= -0.05 <= lags["steering"]["high_s"]
    assert set(covered["state"]) == {"v", "yaw_rate"}
    assert 4.0 <= covered["state"]["v"]["low"] < covered["state"]["v"]["high"] <= 6.0


def test_what_logs_cannot_support_is_refused_before_a_run_is_begun(logs, monkeypatch):
    monkeypatch.chdir(logs.parent)
    chosen = run(*SMALL, "name=other", "certification.level=0.99")
    with pytest.raises(ValueError, match="12 calibration segments are too few for"):
        _ = chosen.policy
    with pytest.raises(
        ValueError,
        match=r"no column friction among .* or pass environment.source=none",
    ):
        _ = run(*SMALL, "environment.source=measured", "name=other").policy
    with pytest.raises(
        ValueError,
        match="vehicle=own is known from logs alone, so it cannot be simulated",
    ):
        evaluate.main(run(*SMALL, *FAST, "name=other"))
    assert not (logs.parent / "runs" / "other").exists()


def test_logs_that_moved_are_the_same_data_set_and_changed_ones_are_not(logs, tmp_path):
    def identity(folder):
        return run(*SMALL, f"dataset.path={folder}").identity

    here = identity(logs)
    shutil.copytree(logs, tmp_path / "moved")
    assert identity(tmp_path / "moved") == here
    (tmp_path / "moved" / "0.csv").unlink()
    assert identity(tmp_path / "moved") != here


BOX, PRETRAINED = ([0.4, -5], [0.9, 5]), Path(sfkd_jax.__file__).parent / "pretrained"


class Car:
    """A car that nobody knows: the kinematic plant, of another mass."""

    plant = plants.kinematic(mass=2100.0)
    dt, wheelbase, state_names = plant.dt, plant.wheelbase, plant.state_names
    control_low, control_high = plant.control_low, plant.control_high
    advance = staticmethod(jax.jit(plant.step))

    def reset(self, state):
        self.state = np.asarray(state, np.float32)

    def step(self, control, env):
        self.state = self.advance(self.state, np.float32(control), np.float32(env))
        return self.state


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Six runs of that car under its own driver; a number is missing in one row."""
    folder = tmp_path_factory.mktemp("car") / "logs"
    drive_by_hand(Car(), folder, BOX, range(6), 30, ",".join(NAMES))
    rows = (folder / "0.csv").read_text().splitlines()
    rows[101] = rows[101].rpartition(",")[0] + ",nan"
    (folder / "0.csv").write_text("\n".join(rows) + "\n")
    return folder


def logged(folder, *more):
    words = ("vehicle=logged", f"vehicle.path={folder}", f"root={folder.parent}")
    return identified.with_identified(settings("+experiment=s3", *words, *more))


def test_a_model_of_its_logs_takes_the_place_of_a_car(driven, monkeypatch, capsys):
    monkeypatch.setattr(identified, "REGRESSION_STEPS", 400)
    chosen = logged(driven, "vehicle.missing=drop")
    assert "wind is nan, 0.33 % of the rows, dropped" in capsys.readouterr().err
    plant = assembly.build_vehicle(chosen.vehicle)
    (low, calm), (high, windy) = chosen.environment.box.values()
    assert 0.4 <= low < high <= 0.9
    assert -5.0 <= calm < windy <= 5.0
    assert 5.0 < chosen.dataset.speed[0] < chosen.dataset.speed[1] <= 12.0
    assert -0.5 < plant.control_low[0] < -0.02 < 0.02 < plant.control_high[0] < 0.5
    state, control, env = np.float32([5, 2, 1, 9]), np.float32([0.03, 0.5]), (0.5, 3.0)
    expected = Car.advance(state, control, np.float32(env))
    after = jax.jit(plant.step)(state, control, np.float32(env))
    np.testing.assert_allclose(after, expected, atol=5e-3)
    # What the run is made from are the contents of the logs, wherever they lie.
    moved = driven.parent / "moved"
    shutil.copytree(driven, moved)
    again = logged(moved, "vehicle.missing=drop")
    assert "fitted" not in capsys.readouterr().err
    assert Run.of(again).source.config == Run.of(chosen).source.config


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ((), "wind is nan"),
        (("vehicle.path=null",), "vehicle=logged needs vehicle.path=FOLDER"),
        (("vehicle.missing=drop", "dataset.speed=[20,30]"), "the vehicle reach 6"),
    ],
)
def test_logs_that_make_no_vehicle_are_refused_in_one_line(driven, more, says):
    with pytest.raises(ValueError, match=says) as refused:
        logged(driven, *more)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def under_policy(tmp_path_factory):
    """A run directory, and five runs of the car under its policy."""
    root = tmp_path_factory.mktemp("collect")
    folder = root / "car" / "sfkd_path" / "seed=0"
    shutil.copytree(PRETRAINED / "kinematic_path", folder)
    drive_under(sfkd_jax.load(folder), Car(), root / "recorded", BOX, range(5), 6)
    return root


def test_an_environment_in_another_unit_is_told_of_while_recording(under_policy):
    """N for kN, degrees for radians: the policy drives on, and claims nothing."""
    policy = sfkd_jax.load(under_policy / "car" / "sfkd_path" / "seed=0")
    wide = ([0.5, 4000.0], [0.6, 5000.0])
    with pytest.warns(UserWarning, match=r"e left friction .* 0\.9, .*: no corridor"):
        drive_under(policy, Car(), under_policy / "wrong", wide, [0], 0.3)


def collected(root, runs="recorded", level=0.8):
    words = ("name=car", f"root={root}", f"collect.path={root / runs}")
    return collect.main(run(*words, f"certification.level={level}"))


def test_runs_of_the_car_calibrate_its_corridor_again(under_policy, capsys):
    made = collected(under_policy)
    says = r"after 5 runs: corridor [\d.]+ m at level 0.83"
    assert re.search(says, capsys.readouterr().err)
    folder = Path(made["certificate"]).parent
    policy = sfkd_jax.load(folder)
    corridor = policy.certificate.corridor
    claim = corridor.recorded
    assert claim.bounds.nominal >= corridor.bounds.nominal
    assert made["conditions"]["lateral_m"] <= made["corridor_m"]
    assert "of 5 runs of the car" in repr(policy)
    collected(under_policy)
    assert "is replaced" in capsys.readouterr().err
    narrower = replace(corridor, recorded=replace(claim, corridor_m=0.01))
    forged = replace(policy.certificate, corridor=narrower)
    write(Path(made["certificate"]), forged)
    with pytest.raises(ArtefactError, match=r"corridor_m does not follow"):
        sfkd_jax.load(folder)
    Path(made["certificate"]).unlink()


CHANGES = {"no e": ("wind", "gust"), "law": ("nu_1,nu_2", "nu_2,nu_1")}
CHANGES |= {"nan": ("\n0.3,", "\nnan,")}


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("none", "no .csv, .npz, .parquet in this folder"),
        ("few", "5 runs are too few for certification.level=0.9: .*level=0.83"),
        ("no e", "no column wind among"),
        ("law", "of the steps the control is not that of the law"),
        ("nan", "line 5: t is nan"),
        ("twice", "two runs are the same"),
    ],
)
def test_runs_that_calibrate_nothing_are_refused_in_one_line(under_policy, kind, says):
    folder = under_policy / kind
    folder.mkdir()
    for file in [*(under_policy / "recorded").iterdir()] * (kind != "none"):
        text = file.read_text().replace(*CHANGES.get(kind, ("", "")))
        (folder / file.name).write_text(text)
    if kind == "twice":
        shutil.copy(folder / "0.csv", folder / "5.csv")
    with pytest.raises(ValueError, match=says) as refused:
        collected(under_policy, kind, level=0.9 if kind == "few" else 0.8)
    assert "\n" not in str(refused.value)
