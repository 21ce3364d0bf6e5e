"""The commands as a user runs them: last line JSON, one-line errors, artefacts intact."""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from helpers import last_line, run_command

from sfkd_jax import store

POLICY = "runs/smoke/sfkd/seed=0/policy.safetensors"
read_policy = partial(store.read_arrays, kind="policy")


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """One smoke run from nothing; tests that change it copy it first."""
    directory = tmp_path_factory.mktemp("run")
    done = run_command("train", "+experiment=smoke", cwd=directory)
    (directory / "messages.txt").write_text(done.stderr, "utf-8")
    return directory, last_line(done)


@pytest.fixture
def copied(smoke, tmp_path):
    shutil.copytree(smoke[0] / "runs", tmp_path / "runs")
    return tmp_path


def test_train_goes_from_nothing_to_a_report(smoke):
    directory, document = smoke
    paths = ("run", "checkpoint", "certificate", "results", "report")
    assert all((directory / document[name]).exists() for name in paths)
    numbers = {"open_loop_rmse_m", "alpha", "seconds", "objective"}
    assert set(document) == {*paths, *numbers}
    assert 0 < document["objective"] < np.inf
    assert len(document["open_loop_rmse_m"]) == 20
    assert 0.9 < document["alpha"] < 0.996


def test_its_last_messages_are_who_drove_how_and_the_page(smoke):
    directory, document = smoke
    *_, errors, page = (directory / "messages.txt").read_text("utf-8").splitlines()
    rows = store.read_json(directory / document["results"])["rows"]
    shown = [f" {1e3 * row['rmse_m']['mean']:.1f}" for row in rows]
    assert errors.startswith("RMSE on ")
    assert all(number in errors for number in shown)
    assert errors.count(",") == len(rows) - 1
    assert page == f"report: {document['report']}"


def test_the_certificate_is_about_the_weights(smoke):
    directory, document = smoke
    certificate = json.loads((directory / document["certificate"]).read_text())
    file = directory / document["run"] / "policy.safetensors"
    assert certificate["valid"]
    assert certificate["provenance"]["weights_sha256"] == read_policy(file)[1]["sha256"]
    assert len(certificate["measured"]["tube"]["latent"]) == 20
    assert set(certificate["measured"]["d_bar"]["by_scenario"]) == {
        "uniform",
        "wet",
        "s3",
    }
    assert 1.0 <= certificate["proof"]["tightness"] <= 1.1


def test_certify_exits_3_when_weights_changed_and_0_when_renewed(copied):
    file = copied / POLICY
    arrays, manifest = read_policy(file)
    changed = {name: array * np.float32(1.01) for name, array in arrays.items()}
    about = {name: manifest[name] for name in ("config", "made_from", "kind")}
    store.write_arrays(file, changed, **about)
    stale = run_command("certify", "+experiment=smoke", cwd=copied, code=3)
    assert "other weights" in stale.stderr
    options = ("+experiment=smoke", "certification.renew=true")
    renewed = last_line(run_command("certify", *options, cwd=copied))
    assert renewed["valid"]
    assert renewed["alpha"] < 1.0


def test_compare_drives_every_row_names_those_that_fail_and_goes_on(copied):
    """The policy of a row is that of the smoke run, so that nothing is trained again."""
    run = copied / "runs/table/kinematic/sfkd/sfkd/seed=0"
    shutil.copytree(copied / "runs/smoke/sfkd/seed=0", run)
    asked = (
        "+experiment=smoke",
        "+comparison.rows.two='evaluation.systems=[nominal,oracle]'",
        "+comparison.rows.wrong='training.step=3'",
        "+comparison.rows.unknown='certification.mode=boxes'",
        "name=table",
    )
    done = run_command("compare", *asked, cwd=copied)
    first = last_line(done)
    document = json.loads((copied / first["results"]).read_text())
    rows = {entry["system"]: entry for entry in document["rows"]}
    assert set(rows) == {"oracle", "sfkd"}
    assert "training sfkd" not in done.stderr
    assert rows["oracle"]["difference_to_sfkd"]["mean"] < 0
    assert len(document["failed"]) == first["failed"] == 3
    assert "row wrong: " in done.stderr
    assert "row two: evaluation.systems must be one system" in done.stderr
    assert "certification.mode" in done.stderr
    stored = copied / "runs/table/cells"
    before = {file: file.read_bytes() for file in stored.rglob("*.row.json")}
    (victim,) = (file for file in before if "oracle" in file.name)
    victim.write_bytes(before[victim][:-9])
    run_command("compare", *asked, cwd=copied)
    after = {file: file.read_bytes() for file in stored.rglob("*.row.json")}
    remade, first_made = (json.loads(kept.pop(victim)) for kept in (after, before))
    assert after == before
    for document in (remade, first_made):
        assert document["row"].pop("provenance")
    assert remade == first_made


@pytest.mark.exhaustive
def test_a_model_without_a_bound_is_evaluated_but_not_certified(smoke):
    directory = smoke[0]
    small = (
        "model=sfkd_no_contraction",
        "training.steps=25",
        "training.save_every=25",
        "evaluation.systems=[self]",
    )
    done = run_command("train", "+experiment=smoke", *small, cwd=directory)
    assert last_line(done)["alpha"] is None
    done = run_command("certify", "+experiment=smoke", *small, cwd=directory, code=2)
    assert done.stderr.strip().splitlines()[-1].startswith("sfkd_jax: refused:")


@pytest.mark.exhaustive
def test_a_lost_policy_is_finished_again_from_the_checkpoint(copied):
    file = copied / POLICY
    weights = read_policy(file)[1]["sha256"]
    file.unlink()
    run_command("certify", "+experiment=smoke", cwd=copied)
    assert read_policy(file)[1]["sha256"] == weights


@pytest.mark.exhaustive
def test_another_setting_of_the_controller_adds_rows_and_keeps_the_others(copied):
    other = "controller.mppi.num_samples=8"
    run_command("evaluate", "+experiment=smoke", other, cwd=copied)
    text = (copied / "runs/smoke/sfkd/seed=0/results.json").read_text()
    rows = {(row["system"], row["controller"]) for row in json.loads(text)["rows"]}
    controllers = "mppi", "mppi,mppi.num_samples=8"
    assert rows == set(product(("sfkd", "nominal"), controllers))
    report = last_line(run_command("report", "+experiment=smoke", cwd=copied))
    assert all((copied / figure).exists() for figure in report["figures"])


@pytest.mark.exhaustive
def test_without_systems_a_model_is_trained_alone_and_scored_for_a_search(smoke):
    asked = "+experiment=smoke", "evaluation.systems=[]"
    document = last_line(run_command("train", *asked, cwd=smoke[0]))
    assert document["objective"] > 0
    assert "certificate" not in document


def test_the_example_in_the_readme_runs():
    readme = Path(__file__).parents[2] / "README.md"
    program = readme.read_text("utf-8").split("```python\n")[1].split("```")[0]
    assert 'sfkd_jax.load("kinematic_path")' in program
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


COUNTED = """
    import json, sys, jax
    from sfkd_jax import train
    from sfkd_jax.experiment.command import hydra_command

    events = {}
    def count(event, **_):
        name = event.rpartition("/")[2]
        events[name] = events.get(name, 0) + 1

    jax.monitoring.register_event_listener(count)
    hydra_command(train.main)()
    print(json.dumps({key: events.get(key, 0) for key in ("cache_hits", "cache_misses")}))
"""


@pytest.mark.exhaustive
def test_the_same_command_again_trains_nothing(smoke):
    directory, before = smoke
    weights = (directory / before["run"] / "policy.safetensors").read_bytes()
    again = last_line(run_command("train", "+experiment=smoke", cwd=directory))
    kept = directory / again["run"] / "policy.safetensors"
    assert kept.read_bytes() == weights
    assert again["open_loop_rmse_m"] == before["open_loop_rmse_m"]


@pytest.mark.exhaustive
def test_another_run_compiles_nothing(tmp_path):
    """Programs are kept below the root, so a second training of a kind only runs."""
    hidden = {name: os.environ[name] for name in os.environ if "JAX_" not in name}
    program = [sys.executable, "-c", textwrap.dedent(COUNTED), "+experiment=smoke"]
    start = partial(
        subprocess.run, cwd=tmp_path, env=hidden, capture_output=True, text=True
    )
    for seed in ("seed=0", "seed=1"):
        done = start([*program, seed])
        assert done.returncode == 0, done.stderr[-2000:]
    counted = last_line(done)
    assert counted["cache_hits"] > 50
    assert counted["cache_misses"] <= 5
