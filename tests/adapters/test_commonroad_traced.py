"""The drift car that jax traces (experiments/commonroad/traced_car.py) beside the package's
own function.
"""

import jax.numpy as jnp
import pytest

pytest.importorskip(
    "vehiclemodels",
    reason='CommonRoad\'s cars need the extra: pip install "sfkd-jax[plants]"',
)

from experiments.commonroad import traced_car

CLOSE = 1e-5
"""Largest difference of one step [m, rad, s]."""
WHEELS = 2e-3
"""Of wheel speeds [rad/s]: the package's solver steps at its stability limit there."""


def test_one_step_is_that_of_the_package():
    """Braking and driving, both sides, wind, and sliding at friction 0.3; no wheel
    locks.
    """
    states = [
        [0.0, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.0, -2.0, 2.0, 8.0, 0.3, 0.4, 0.1, 0.2, -0.2],
        [0.0, 0.0, -1.0, 11.0, -0.6, -0.5, -0.08, 0.0, 0.5],
        [0.0, 1.0, 0.5, 9.0, 0.8, -0.6, 0.15, -0.3, 0.1],
    ]
    controls = [[0.05, 1.0], [-0.2, -1.0], [0.12, 2.5], [0.15, -0.5]]
    envs = [[0.9, 0.0], [0.3, 8.0], [0.6, -5.0], [0.3, -8.0]]
    result = traced_car.disagreement(*map(jnp.asarray, (states, controls, envs)))
    wheels = {
        name: value for name, value in result.items() if name.startswith("hidden")
    }
    assert {
        name: value
        for name, value in result.items()
        if value > (WHEELS if name in wheels else CLOSE)
    } == {}
    assert len(wheels) == 2
