"""The road ahead of a vehicle that is not where its reference begins."""

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving.path_coordinates import curvature_ahead, projected
from sfkd_jax.driving.path_following.tasks._preview import (
    Preview,
    later,
    road_from,
    state_beside,
)
from sfkd_jax.driving.paths import path_from_curvature, point_at, reference_window
from sfkd_jax.info import Reason

SLOPE, SPEED, DT = 1e-3, 9.0, 0.1
PATH = path_from_curvature(SLOPE * 0.25 * jnp.arange(400), spacing=0.25)


def preview(begins, speed=SPEED):
    """What a reference that begins at this arc length shows."""
    reference = reference_window(
        PATH, jnp.asarray(begins), jnp.asarray(speed), dt=DT, horizon=20
    )
    road = jnp.stack([curvature_ahead(reference), reference[:, 3]], axis=1)
    state = jnp.zeros(4)
    return Preview(
        road=road,
        along=jnp.zeros(()),
        observation=state,
        reference=reference,
        sent=jnp.zeros((0, 2)),
        later=jnp.zeros(()),
        repeated=jnp.asarray(False),
        measured=jnp.ones(3, bool),
        on_time=jnp.asarray(True),
        reason=jnp.asarray(Reason.CERTIFIED),
    )


@pytest.mark.parametrize("ahead", [-1.5, 0.0, 0.4, 2.0, 5.0])
def test_the_curvature_ahead_is_that_of_the_vehicle_and_not_of_the_reference(ahead):
    """On a clothoid, 20 m from its beginning."""
    begins = 20.0
    shown = preview(begins)
    along = jnp.asarray(ahead - SPEED * DT)
    road = road_from(shown, along)
    middles = begins + ahead + SPEED * DT * (np.arange(20) + 0.5)
    # Beyond the ends of the reference the road goes on as it is there.
    known = np.clip(middles, begins + 0.5, begins + 20 * SPEED * DT)
    np.testing.assert_allclose(road[:, 0], SLOPE * known, atol=7e-4)
    np.testing.assert_array_equal(road[:, 1], shown.road[:, 1])


def test_a_reference_that_is_not_finite_is_left_as_it_is():
    shown = preview(20.0)
    hostile = shown._replace(reference=shown.reference.at[3, 0].set(jnp.nan))
    np.testing.assert_array_equal(road_from(hostile, jnp.asarray(2.0)), shown.road)
    unknown = road_from(shown, jnp.asarray(jnp.nan))
    np.testing.assert_array_equal(unknown, shown.road)


@pytest.mark.parametrize("ahead", [0.0, 2.0, 6.0])
def test_a_state_beside_the_reference_has_its_own_coordinates(ahead):
    shown = preview(20.0)
    xi = jnp.asarray([0.2, -0.03, 8.5])
    along = jnp.asarray(ahead - SPEED * DT)
    state = state_beside(xi, shown._replace(along=along))
    back, place = projected(state, shown.reference, curvature_ahead(shown.reference))
    np.testing.assert_allclose(back, xi, atol=2e-3)
    np.testing.assert_allclose(place, along, atol=0.02)
    foot = point_at(PATH, jnp.asarray(20.0 + ahead))
    assert abs(float(jnp.hypot(*(state - foot)[:2])) - 0.2) < 0.02


def test_rows_of_later_on_are_between_rows_and_beyond_the_last_one_it_stays():
    yaw = jnp.asarray([3.0, 3.1, -np.pi + 0.05, -np.pi + 0.15])
    rows = jnp.stack([jnp.arange(4.0), yaw], axis=1)
    moved = later(rows, jnp.asarray(1.5), 3, angle=1)
    np.testing.assert_allclose(moved[:, 0], [1.5, 2.5, 3.0])
    turned = moved[:, 1] - jnp.asarray([3.1458, np.pi + 0.1, np.pi + 0.15])
    np.testing.assert_allclose(np.sin(turned), 0.0, atol=1e-4)
    np.testing.assert_array_equal(later(rows, 0.0, 4, angle=1), rows)
