"""Doors opened from nothing: what is missing is made, for every vehicle and every job of a sweep."""

from helpers import door, last_line


def test_a_sweep_runs_every_job_and_ends_with_json(tmp_path):
    done = door("generate", "-m", "+experiment=smoke", "dataset.segments=40", "dataset.seed=0,1", cwd=tmp_path)
    assert last_line(done)["segments"] == 40
    assert len(list((tmp_path / "runs/datasets").iterdir())) == 2


def test_the_walk_works_for_another_vehicle_under_its_speed_loop(tmp_path):
    small = ("training.steps=25", "training.save_every=25", "dataset.segments=160", "evaluation.episode_s=4.0")
    small += ("evaluation.systems=[self]",)
    walk = last_line(door("train", "+experiment=smoke", "vehicle=dynamic_speed", *small, cwd=tmp_path))
    assert (tmp_path / walk["report"]).exists()
