"""The doctor names what works and why something does not, and writes nothing."""

from helpers import last_line, run_command

from sfkd_jax import doctor


def test_it_reports_the_installation_and_writes_nothing(tmp_path):
    done = run_command("doctor", cwd=tmp_path)
    document = last_line(done)
    assert set(document) == {"versions", "devices", "extras", "advice", "seconds"}
    assert {"python", "jax", "flax", "sfkd_jax"} <= set(document["versions"])
    assert "train" in document["extras"]
    assert "extra train: works" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_an_extra_that_is_missing_or_broken_is_named_with_its_reason(
    monkeypatch, tmp_path
):
    (tmp_path / "broken_one.py").write_text(
        "raise RuntimeError('its library is of another version\\nand more')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert doctor._broken(("json",)) is None
    missing, broken = (
        doctor._broken(("json", "no_such")),
        doctor._broken(("broken_one",)),
    )
    assert missing == "not installed (no_such)"
    assert broken == "broken_one does not load: its library is of another version"
