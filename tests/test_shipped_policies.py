"""The policies that ship with the package are loaded by name."""

from pathlib import Path

import pytest

import sfkd_jax
from sfkd_jax.certificate import read
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.policy import SHIPPED, policy_file

ALONG_PATH = {"dynamic_path": 0.114, "kinematic_path": 0.349}
"""Half width of the corridor [m], as the README prints it."""


def test_the_policies_that_ship_are_listed_with_their_corridor_and_class():
    listed = sfkd_jax.policies()
    assert set(listed) == {*ALONG_PATH, "dynamic", "kinematic"}
    for name, corridor in ALONG_PATH.items():
        policy = listed[name]
        assert policy.frame == "path"
        assert round(policy.corridor_m, 3) == corridor
        assert policy.speed[0] < 10.0 < policy.speed[1]
        assert policy.peak_curvature > 0.0
    assert listed["dynamic"].frame == "body"
    assert listed["dynamic"].corridor_m is None
    for policy in listed.values():
        assert policy.env_low == (0.3, -8.0)
        assert policy.env_high == (0.9, 8.0)


def test_a_name_is_the_folder_of_the_package_and_a_path_that_exists_comes_first(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert policy_file("dynamic_path").parent == SHIPPED / "dynamic_path"
    Path("dynamic_path").mkdir()
    assert policy_file("dynamic_path").parent == Path("dynamic_path")
    # A path is never taken for a name.
    assert policy_file("./kinematic_path").parent == Path("kinematic_path")


@pytest.mark.parametrize("name", ["dynamc_path", "runs/none/seed=0"])
def test_what_is_neither_a_run_nor_a_name_is_refused_in_one_line(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(sfkd_jax.ArtefactError) as refused:
        sfkd_jax.load(name)
    assert "\n" not in str(refused.value)
    assert name in str(refused.value)
    assert ("dynamic_path" in str(refused.value)) == ("/" not in name)


def test_a_policy_by_name_has_its_verified_certificate():
    loaded = sfkd_jax.load("kinematic")
    assert loaded.certificate == read(
        SHIPPED / "kinematic" / "certificate.json", DrivingCertificate
    )
    assert loaded.signature == "unsigned"
