"""The demo: shipped policies are evaluated, and beat the nominal model."""

import json
import socket

import pytest
from composing import run
from helpers import last_line, run_command

from sfkd_jax import demo, policy
from sfkd_jax.certificate import read
from sfkd_jax.driving.certificate import DrivingCertificate

BODY = ("+experiment=s3_body", "controller=mppi_tiny", "demo.episode_s=9.0")
PATH = ("controller.mppi.num_samples=30", "optimized=false", "demo.episode_s=6.0")


@pytest.mark.parametrize(
    ("system", "options"),
    [("sfkd_path", PATH), pytest.param("sfkd", BODY, marks=pytest.mark.exhaustive)],
)
def test_the_demo_drives_without_training_and_draws_an_animation(
    tmp_path, system, options
):
    done = run_command("demo", *options, cwd=tmp_path)
    document = last_line(done)
    assert (tmp_path / document["animation"]).read_bytes()[:6] == b"GIF89a"
    rows = {
        row["system"]: row
        for row in json.loads((tmp_path / document["results"]).read_text())["rows"]
    }
    assert set(rows) == {system, "nominal", "oracle"}
    own = rows[system]
    assert "proved: alpha" in done.stderr
    if system == "sfkd":
        assert own["rmse_m"]["mean"] < 0.5 * rows["nominal"]["rmse_m"]["mean"]
        assert own["departures"] == 0
    else:
        file = policy.SHIPPED / "kinematic_path" / "certificate.json"
        corridor = read(file, DrivingCertificate).corridor
        assert own["max_deviation_m"] <= corridor.corridor_m
        assert f"corridor {corridor.corridor_m:.3f} m to each side" in done.stderr


def test_a_vehicle_without_a_shipped_policy_is_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="controllers ship for ") as refusal:
        demo.main(run("vehicle.mass=900.0", f"root={tmp_path}"))
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_the_viewer_refuses_before_anything_is_compiled(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=rf"demo\.port={port} cannot be used"):
            demo.main(run("viewer=true", f"demo.port={port}", f"root={tmp_path}"))
    body = ("+experiment=s3_body", "viewer=true", "demo.port=0")
    with pytest.raises(ValueError, match="has no certified corridor"):
        demo.main(run(*body, f"root={tmp_path}"))
    with pytest.raises(ValueError, match=r"demo\.port"):
        run("demo.port=70000")
    assert list(tmp_path.iterdir()) == []
