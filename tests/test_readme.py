"""What the README promises is still so."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def test_the_first_screen_holds_the_two_commands():
    screen = "\n".join(README.splitlines()[:25])
    assert "python -m sfkd_jax.train +experiment=s3" in screen
    assert "pytest -q -n 2" in screen


def test_the_readme_is_short():
    assert len(README.encode()) <= 8 * 1024


def test_ci_runs_the_test_command_of_the_readme():
    assert "pytest -q -n 2" in (ROOT / ".ci" / "run").read_text("utf-8")
