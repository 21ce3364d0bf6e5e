"""What the main job says about itself before it begins."""

import re

import pytest
from composing import run

from sfkd_jax.experiment import duration

PROBE = duration._probe


@pytest.fixture(autouse=True)
def one_machine(monkeypatch):
    """As fast as the one that the constants are from, with two cores."""
    monkeypatch.setattr(duration, "_probe", lambda: duration.PROBE)
    monkeypatch.setattr(duration, "available_cores", lambda: 2)


def minutes(*words):
    return int(re.search(r"about (\d+) min", duration.work_of(run(*words)))[1])


def test_the_main_job_says_what_it_does():
    assert duration.work_of(run("+experiment=s3")).startswith(
        "data, 4,000 steps of training, a certificate on 4,520,000 steps of the "
        "vehicle, 8 episodes of 60 s of 3 systems; about "
    )


@pytest.mark.parametrize(
    ("word", "more"),
    [
        ("training.steps=40000", 36_000 * duration.TRAINING_STEP),
        ("evaluation.episodes=80", 3 * 72 * 600 * duration.CONTROL_STEP / 2),
        (
            "certification.corridor.runs=1500",
            16 * 3 * 1350 * 600 * duration.VEHICLE_STEP,
        ),
    ],
)
def test_more_work_takes_longer_by_what_it_costs(word, more):
    longer = minutes("+experiment=s3", word) - minutes("+experiment=s3")
    assert longer == pytest.approx(more / 60.0, abs=1.0)


def test_it_takes_longer_on_a_slower_machine_and_on_one_core(monkeypatch):
    usual = minutes("+experiment=s3")
    monkeypatch.setattr(duration, "_probe", lambda: 3.0 * duration.PROBE)
    assert minutes("+experiment=s3") == pytest.approx(3 * usual, abs=2)
    monkeypatch.setattr(duration, "_probe", lambda: duration.PROBE)
    monkeypatch.setattr(duration, "available_cores", lambda: 1)
    assert minutes("+experiment=s3") > usual


def test_a_probe_takes_a_time():
    assert 0.0 < PROBE() < 60.0
