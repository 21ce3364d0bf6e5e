"""Documents of certificates to forge, for several test files."""

import hashlib
import json

from sfkd_jax import policy


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
