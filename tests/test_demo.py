"""The demo: shipped policies are evaluated, their certificates hold, and they beat the
nominal model.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composing import settings
from helpers import last_line, run_command, straight

from sfkd_jax import demo, policy
from sfkd_jax.certification import Certificate, verify

KEY = jax.random.key(0)
VEHICLES = sorted(entry.name for entry in demo.SHIPPED.iterdir())
BODY = ("+experiment=s3_body", "controller=mppi_tiny")
PATH = ("controller.mppi.num_samples=30",)


@pytest.mark.parametrize(
    ("system", "options"),
    [("sfkd_path", PATH), pytest.param("sfkd", BODY, marks=pytest.mark.exhaustive)],
)
def test_the_demo_drives_without_training_and_draws_an_animation(
    tmp_path, system, options
):
    done = run_command("demo", *options, "demo.episode_s=9.0", cwd=tmp_path)
    document = last_line(done)
    assert (tmp_path / document["animation"]).read_bytes()[:6] == b"GIF89a"
    rows = {
        row["system"]: row
        for row in json.loads((tmp_path / document["results"]).read_text())["rows"]
    }
    assert set(rows) == {system, "nominal", "oracle"}
    own = rows[system]
    assert "certificate: holds" in done.stderr
    if system == "sfkd":
        assert own["rmse_m"]["mean"] < 0.5 * rows["nominal"]["rmse_m"]["mean"]
        assert own["violation"]["v0"] == own["departures"] == 0
    else:
        file = demo.SHIPPED / "kinematic_path" / "certificate.json"
        corridor = json.loads(file.read_text())["corridor"]
        assert own["max_deviation_m"] <= corridor["corridor_m"]
        assert "corridor: 0.38 m to each side" in done.stderr


def test_a_vehicle_without_a_shipped_policy_is_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="controllers ship for ") as refusal:
        demo.run(settings("vehicle.mass=900.0", f"root={tmp_path}"))
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_shipped_policies_load_and_their_certificates_follow_from_witnesses(vehicle):
    trained = policy.load(demo.SHIPPED / vehicle)
    proof = Certificate.from_document(trained.certificate)
    verify(proof, trained.params, model=trained.model)
    assert proof.alpha < 1.0
    assert trained.settings["vehicle"]["name"] == vehicle.removesuffix("_path")
    assert ("corridor" in trained.certificate) == vehicle.endswith("_path")


def test_shipped_policies_also_work_with_an_estimated_environment():
    with pytest.raises(ValueError, match="path coordinates"):
        policy.load(demo.SHIPPED / "kinematic", env_source="estimated")
    trained = policy.load(demo.SHIPPED / "kinematic_path", env_source="estimated")
    act, state = jax.jit(trained.controller.act), trained.controller.init(KEY)
    known = trained.params, state, jnp.asarray([0.0, 0.3, 0.0, 10.0])
    control, _, info = act(*known, jnp.full(2, jnp.nan), straight(20))
    other, _, _ = act(*known, jnp.asarray([0.3, 8.0]), straight(20))
    np.testing.assert_array_equal(control, other)
    # Nothing has moved yet.
    np.testing.assert_allclose(info["env_estimate"], [0.6, 0.0], atol=1e-4)
