"""Violations counted where the count is known."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax import models
from sfkd_jax.evaluation import ClaimedBounds, violations
from sfkd_jax.types import Trajectory

WIDE = 99.0


def still(count=2, steps=20):
    """Cars that stand at the origin whatever they observe."""
    shapes = (count, steps + 1, 4), (count, steps, 2)
    return Trajectory(*map(jnp.zeros, shapes), jnp.ones((count, steps, 2)))


def drifting(*each):
    """A model that adds the same to every state."""
    return models.physics(lambda state, action, env: state + jnp.asarray(each))


def rates(model, data, *, radii=(WIDE, WIDE, WIDE), latent=WIDE, d_bar=WIDE, length=10):
    """V0 and V1 of predictions over four steps."""
    claims = ClaimedBounds(
        jnp.broadcast_to(jnp.asarray(radii), (4, 3)),
        jnp.broadcast_to(jnp.asarray(latent), 4),
        jnp.asarray(d_bar),
    )
    found = jit(partial(violations, model, length=length))({}, data, claims)
    return float(found["v0"]), float(found["v1"])


@pytest.mark.parametrize(
    ("radii", "left"),
    [
        ((2.0001, 3.0, 2.0001), 0.0),  # the yaw is wrapped: 3 of 1, 2, 3, 4 rad
        ((1.9999, 3.0, 2.0001), 1.0),
        ((2.0001, 2.2, 2.0001), 1.0),
        ((2.0001, 3.0, 1.9999), 1.0),
    ],
)
def test_a_segment_leaves_its_tube_if_any_step_or_kind_does(radii, left):
    """A constant drift errs by its multiples."""
    assert rates(drifting(0.3, 0.4, 1.0, 0.5), still(), radii=radii)[1] == left


def test_segments_are_counted_one_by_one_and_a_prediction_that_is_lost_leaves():
    states = jnp.zeros((2, 21, 4)).at[0, 12, 0].set(5.0).at[1, 3, 3].set(jnp.nan)
    data = still()._replace(states=states)
    assert rates(drifting(0.0, 0.0, 0.0, 0.0), data)[1] == 0.25
    assert rates(drifting(0.0, 0.0, 0.0, 0.0), data, radii=(1.0, WIDE, WIDE))[1] == 0.5


def test_the_theorem_is_only_asked_about_steps_up_to_the_first_large_defect():
    """|e_k| = 0.5 k in all windows, after defects of 0.5."""
    model, steps = drifting(0.0, 0.0, 0.0, 0.5), np.arange(1.0, 5.0)
    assert rates(model, still(), latent=0.5001 * steps, d_bar=0.6)[0] == 0.0
    assert rates(model, still(), latent=0.4999 * steps, d_bar=0.6)[0] == 1.0
    assert rates(model, still(), latent=1.2, d_bar=0.6)[0] == 0.5
    assert np.isnan(rates(model, still(), latent=1.2, d_bar=0.4)[0])
    # A jump of the car: one defect, and what comes after it is not asked about.
    jump = jnp.zeros((1, 5, 4)).at[0, 3:, 3].set(9.0)
    data = still(1, 4)._replace(states=jump)
    assert rates(model, data, latent=0.6, d_bar=0.6, length=4)[0] == 0.5


def test_defects_that_all_point_one_way_fill_the_tube_of_a_linear_model():
    """s⁺ = α s beside the truth s⁺ = α s + d̄: |e_k| = R_k, so any smaller radius is
    left at every step.
    """
    alpha, d_bar = 0.93, 0.2
    model = models.physics(lambda state, action, env: state.at[3].multiply(alpha))
    speeds = [1.0]
    for _ in range(20):
        speeds.append(alpha * speeds[-1] + d_bar)
    data = still(count=1)
    data = data._replace(states=data.states.at[0, :, 3].set(jnp.asarray(speeds)))
    bound = d_bar * (1 - alpha ** np.arange(1, 5)) / (1 - alpha)
    for size, rate in ((1.0, 0.0), (1.0 - 1e-3, 1.0)):
        found = rates(model, data, latent=size * bound, d_bar=d_bar + 1e-6, length=20)
        assert found[0] == rate
