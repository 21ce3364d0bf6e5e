"""The certificate document of a policy: what is proved, and what is measured."""

import numpy as np
import pytest
from helpers import SHARES, certified, dataset, model_and_params

from sfkd_jax.certification import issue

BOXES = {
    "state": [[4.0], [16.0]],
    "control": [[-0.5, -6.0], [0.5, 3.0]],
    "env": [[0.3, -8.0], [0.9, 8.0]],
}


@pytest.fixture(scope="module")
def certificate():
    data = dataset()
    return issue(
        *model_and_params("sfkd"),
        validation=data.validation,
        calibration=data.calibration,
        held_out={"test": data.test, "s1": data.test},
        boxes=BOXES,
        level=0.9,
        horizon=10,
        attack_starts=0,
    )


def test_a_certificate_states_what_was_proved_and_measured(certificate):
    proved = certified("sfkd")
    for name in ("alpha", "alpha_joint", "rho", "beta", "params_sha256"):
        assert certificate[name] == getattr(proved, name)
    assert certificate["decoder_lipschitz"] == proved.lipschitz["decoder"]
    assert certificate["d_bar"]["trajectories"] == round(SHARES[2] * 120)
    assert certificate["d_bar"]["level"] == 0.9
    low, high = certificate["d_bar"]["coverage_ci95"]
    assert 0.0 <= low <= certificate["d_bar"]["coverage"] <= high <= 1.0


def test_the_tubes_of_a_certificate_grow_to_the_ultimate_bound(certificate):
    tube, d_bar = certificate["tube"], certificate["d_bar"]["value"]
    assert d_bar > 0
    assert len(tube["latent"]) == 10
    np.testing.assert_allclose(tube["latent"][0], d_bar)
    np.testing.assert_allclose(tube["ultimate"], d_bar / (1 - certificate["alpha"]))
    assert tube["latent"][-1] < tube["ultimate"]
    for radii in (tube["latent"], *tube["physical"].values()):
        assert len(radii) == 10
        assert np.all(np.diff(radii) > 0)
        assert np.all(np.isfinite(radii))
