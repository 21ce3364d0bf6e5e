"""The joint budget: operator and residual as one map are α-Lipschitz, though their
norms may sum to more.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import certified

from sfkd_jax.models._networks import Weights
from sfkd_jax.models.sfkd._residual import share_budget

ALPHA, RANK = 0.9, 6
IDENTITY = Weights((jnp.eye(RANK), jnp.eye(RANK)), (jnp.ones(RANK),))


def shared(operator_scale, coupling_scale, seed=0):
    """A_j, G and H in float64, G and H read off a residual whose network is the
    identity.
    """
    random = np.random.default_rng(seed)
    operators = operator_scale * random.standard_normal((3, RANK, RANK))
    couplings = coupling_scale * random.standard_normal((2, RANK, RANK))
    arrays = [jnp.asarray(part, dtype=jnp.float32) for part in (operators, couplings)]
    vertices, residual = share_budget(*arrays, IDENTITY, ALPHA)
    first, last = residual.matrices
    return tuple(np.asarray(part, dtype=np.float64) for part in (vertices, last, first))


@pytest.mark.parametrize("operator_scale", [1e-3, 0.3, 3.0, 1e4])
@pytest.mark.parametrize("coupling_scale", [1e-3, 0.1, 1.0, 1e4])
def test_the_block_matrix_of_every_vertex_has_norm_at_most_one(
    operator_scale, coupling_scale
):
    vertices, out, into = shared(operator_scale, coupling_scale)
    for vertex in vertices:
        block = np.block(
            [[vertex / ALPHA, out], [into / ALPHA, np.zeros((RANK, RANK))]]
        )
        assert np.linalg.norm(block, 2) <= 1.0 + 1e-6


def test_where_the_residual_takes_a_direction_the_operator_has_none_of_it_and_keeps_the_others():
    """G = H = e_1 e_1' (nearly): the first direction may have gain α through φ, or
    through A, never both.
    """
    projector = np.zeros((RANK, RANK))
    projector[0, 0] = 1e3
    couplings = jnp.asarray(np.stack([projector, projector]), dtype=jnp.float32)
    vertices, residual = share_budget(
        jnp.eye(RANK)[None] * 1e3, couplings, IDENTITY, ALPHA
    )
    vertex = np.asarray(vertices[0])
    gain = np.asarray(residual.matrices[1] @ residual.matrices[0])[0, 0]
    assert gain > 0.99 * ALPHA
    assert abs(vertex[0, 0]) < 0.01
    np.testing.assert_allclose(np.diag(vertex)[1:], ALPHA, rtol=0.03)
    assert np.linalg.norm(vertex, 2) + gain > 1.7
    assert (
        np.linalg.norm(vertex + gain * np.diag([1.0] + [0.0] * (RANK - 1)), 2)
        <= ALPHA * 1.001
    )


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0, 10.0])
def test_the_certificate_proves_the_budget_from_the_networks_own_multipliers(scale):
    proved = certified("joint", scale)
    assert proved.alpha <= 0.995 * (1 + 2e-6)
    assert proved.alpha_separate > proved.alpha
