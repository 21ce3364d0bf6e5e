"""Branch and bound over environments: dense grids, a planted spike, exact cases."""

import numpy as np
import pytest

from sfkd_jax.certification import bound_over_box, norm_upper
from sfkd_jax.certification._environments import operator_at
from sfkd_jax.types import Hypernetwork

BOX = ([-1.0, -1.0], [1.0, 1.0])


def random_hypernetwork(seed, size=4, width=12, gain=0.7):
    random = np.random.default_rng(seed)
    shapes = ((width, 2), (width, width), (size * size, width))
    weights = [
        gain * random.standard_normal(shape) / shape[1] ** 0.5 for shape in shapes
    ]
    return Hypernetwork(
        tuple(weights),
        tuple(0.3 * random.standard_normal(len(weight)) for weight in weights),
    )


def spike(height=2.0, centre=(0.29, -0.271), width=0.01):
    """‖A(e)‖ = 0.5 but on a ridge of this width, where two steep units disagree: tanh(x
    + w) − tanh(x − w).
    """
    steep = 3.0 / width
    first = np.asarray([[steep, 0.0], [steep, 0.0]])
    shift = np.asarray([-steep * centre[0] + 3.0, -steep * centre[0] - 3.0])
    last = np.zeros((4, 2))
    last[0] = 0.5 * (height - 0.5) * np.asarray([1.0, -1.0])
    return Hypernetwork((first, last), (shift, np.asarray([0.5, 0.0, 0.0, 0.2])))


def dense_maximum(network, count):
    axis = np.linspace(-1, 1, count)
    return max(
        np.linalg.norm(operator_at(network, np.asarray([x, y])), 2)
        for x in axis
        for y in axis
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_over_a_box_is_above_a_dense_grid_and_close_to_it(seed):
    network = random_hypernetwork(seed)
    bound = bound_over_box(network, BOX, norm_upper, tolerance=0.02)
    grid = dense_maximum(network, 41)
    assert grid <= bound.upper
    assert bound.upper <= 1.03 * max(grid, bound.lower)
    assert bound.lower <= bound.upper


def test_a_narrow_spike_between_the_points_of_a_grid_is_found():
    network = spike()
    grid = dense_maximum(network, 25)
    assert grid < 1.0  # the grid sees nothing
    bound = bound_over_box(network, BOX, norm_upper, tolerance=0.02)
    peak = np.linalg.norm(operator_at(network, np.asarray([0.29, 0.0])), 2)
    assert peak > 1.9
    assert peak <= bound.upper <= 1.05 * peak


def test_a_search_that_is_cut_short_is_loose_and_still_true():
    network = random_hypernetwork(0)
    rough = bound_over_box(network, BOX, norm_upper, most_cells=5)
    fine = bound_over_box(network, BOX, norm_upper, tolerance=0.02)
    assert rough.cells <= 6
    assert rough.upper >= fine.upper >= dense_maximum(network, 21)


def test_an_operator_that_does_not_depend_on_the_environment_takes_one_cell():
    network = random_hypernetwork(0)
    network = network._replace(weights=(0.0 * network.weights[0], *network.weights[1:]))
    bound = bound_over_box(network, BOX, norm_upper)
    assert bound.cells == 1
    assert bound.upper == pytest.approx(
        np.linalg.norm(operator_at(network, np.zeros(2)), 2), rel=1e-9
    )


def test_a_box_of_one_point_has_the_value_there():
    network, point = random_hypernetwork(2), [0.3, -0.4]
    bound = bound_over_box(network, (point, point), norm_upper)
    assert bound.upper == pytest.approx(
        np.linalg.norm(operator_at(network, np.asarray(point)), 2), rel=1e-9
    )
