"""The calibration of alarms, whatever the innovations are."""

import json
from dataclasses import asdict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.certificate._reading import read_as
from sfkd_jax.driving.certificate import Innovations
from sfkd_jax.driving.corridor._alarms import calibrate_innovations
from sfkd_jax.store import plain


@pytest.mark.parametrize("tail", ["cauchy", "diverged", "silent", "constant", "tiny"])
def test_what_the_calibration_of_alarms_writes_can_be_read(tail):
    """Whatever the innovations are: a servo that slews, a state that never moves."""

    def observe(key):
        steps = np.random.default_rng(int(jax.random.bits(key))).standard_cauchy(
            (20, 60, 4)
        )
        if tail == "cauchy":
            steps = 1e3 * steps
        if tail == "diverged":
            steps[0, 30:] = np.inf
        if tail == "silent":
            steps[..., 2] = np.nan
        if tail == "constant":
            steps[..., 1] = 0.0
        if tail == "tiny":
            steps = 1e-30 * steps
        levels = np.abs(steps[..., 0]) % 3.0
        return jnp.asarray(steps, jnp.float32), jnp.nan_to_num(jnp.asarray(levels))

    found = calibrate_innovations(observe, observe, jax.random.key(0), 6.0)
    written = json.loads(json.dumps(plain(asdict(found))))
    assert read_as(Innovations, written) == found
    assert np.min(found.deviation) > 0
    assert np.max(found.threshold) <= 1e6
