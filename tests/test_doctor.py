"""The doctor names what works and why something does not, and writes nothing."""

from helpers import last_line, run_command


def test_it_reports_the_installation_and_writes_nothing(tmp_path):
    done = run_command("doctor", cwd=tmp_path)
    document = last_line(done)
    assert set(document) == {"versions", "devices", "extras", "advice"}
    assert {"python", "jax", "flax", "sfkd_jax"} <= set(document["versions"])
    assert "train" in document["extras"]
    assert "extra train: works" in done.stdout
    assert list(tmp_path.iterdir()) == []
