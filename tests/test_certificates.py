"""A certificate is made once, and again if it should be made in another way."""

import pytest

from sfkd_jax.pipeline import certificates, runs, stages
from sfkd_jax.store import write_json

CERTIFICATION = {"mode": "joint", "monitor_level": 0.95, "corridor": {"level": 0.95}}


@pytest.fixture
def certified(monkeypatch, tmp_path):
    """How often a policy is certified for some settings of the certification."""
    made = []
    monkeypatch.setattr(certificates, "certify_policy", made.append)
    monkeypatch.setattr(stages, "ensure_policy", lambda settings: None)
    monkeypatch.setattr(runs, "run_directory", lambda settings: tmp_path)
    (tmp_path / "policy.npz").touch()

    def count(recorded, **changes):
        document = {"valid": True}
        if recorded is not None:
            document |= {"certification": recorded}
        write_json(tmp_path / "certificate.json", document)
        made.clear()
        settings = {"certification": CERTIFICATION | {"renew": False} | changes}
        certificates.ensure_certificate(settings)
        return len(made)

    return count


def test_one_with_the_same_settings_is_kept(certified):
    assert certified(CERTIFICATION) == 0
    assert certified(CERTIFICATION, renew=True) == 0


@pytest.mark.parametrize(
    "change", [{"monitor_level": 0.8}, {"mode": "boxes"}, {"corridor": {"level": 0.9}}]
)
def test_one_with_other_settings_is_made_again(certified, change):
    """Otherwise cells would be driven with it and filed under the new settings."""
    assert certified(CERTIFICATION, **change) == 1


def test_one_that_does_not_record_its_settings_is_kept(certified):
    assert certified(None, monitor_level=0.8) == 0
