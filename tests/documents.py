"""Documents of certificates to forge, for several test files."""

import hashlib
import json
from functools import cache

from sfkd_jax import policy, store
from sfkd_jax.certificate import parse
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.corridor import verify_driving


def hashed(changed):
    """As a forger writes it, who knows how the hash is computed."""
    content = {k: v for k, v in changed.items() if k not in ("sha256", "signature")}
    text = json.dumps(content, sort_keys=True).encode()
    return changed | {"sha256": hashlib.sha256(text).hexdigest()}


def policy_copy(folder, name):
    """A copy of a policy that ships, with its certificate."""
    run = folder / "run"
    run.mkdir()
    for file in (policy.SHIPPED / name).iterdir():
        (run / file.name).write_bytes(file.read_bytes())
    return run


@cache
def shipped(name):
    return policy.restore(name)


@cache
def document(name):
    return store.read_json(policy.SHIPPED / name / "certificate.json")


def refusal(changed, name):
    """Why a document is refused, in one line; None if it is accepted."""
    try:
        verify_driving(parse(changed, DrivingCertificate), shipped(name))
    except (ValueError, CertificationRefused, CertificateStale) as reason:
        line = str(reason)
    else:
        return None
    assert "\n" not in line
    return line
