"""The doctor names what works and why something does not, and writes nothing."""

import tomllib
from pathlib import Path

import pytest
from helpers import last_line, run_command

from sfkd_jax import doctor


def test_it_reports_the_installation_and_writes_nothing(tmp_path):
    done = run_command("doctor", cwd=tmp_path)
    document = last_line(done)
    assert set(document) == {"versions", "devices", "extras", "advice", "seconds"}
    assert {"python", "jax", "flax", "sfkd_jax"} <= set(document["versions"])
    assert "certify" in document["extras"]
    assert "extra certify: works" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_an_extra_that_is_missing_or_broken_is_named_with_its_reason(
    monkeypatch, tmp_path
):
    (tmp_path / "brokenextra.py").write_text(
        "raise RuntimeError('its library is of another version\\nand more')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert doctor._extra(("json",)) is None
    assert doctor._extra(("json", "no_such_module")) == "not installed (no_such_module)"
    assert (
        doctor._extra(("brokenextra",))
        == "brokenextra does not load: its library is of another version"
    )


def test_a_backend_that_computes_wrongly_is_refused(monkeypatch):
    monkeypatch.setattr(doctor.jnp, "roll", lambda matrix, *_, **__: 2.0 * matrix)
    with pytest.raises(ValueError, match="computes wrongly"):
        doctor._backend_seconds()


def test_advice_is_given_where_something_is_in_the_way(monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    assert doctor._advice(tmp_path / "not" / "made" / "yet", ["cpu: cpu"]) == []
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    monkeypatch.setattr(doctor, "NEEDED_MB", 10**12)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/usr/bin/nvidia-smi")
    written, room, unseen = doctor._advice(tmp_path, ["cpu: cpu"])
    assert "root=DIR" in written
    assert "MB are free" in room
    assert "accelerator" in unseen
    assert doctor._advice(tmp_path, ["cuda: H200"])[2:] == []
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert any(
        "JAX_COMPILATION_CACHE_DIR" in line
        for line in doctor._advice(tmp_path, ["cpu: cpu"])
    )


def test_the_extras_are_those_of_the_package():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())[
        "project"
    ]
    assert set(doctor.EXTRAS) == set(project["optional-dependencies"]) - {"dev"}
