"""Every term of the core's rounding bounds, made visible by large rounding units.

`test_core.py` checks with exact arithmetic that the bounds suffice.
"""

import numpy as np

from sfkd_jax.certification import _core

UNIT, TINY, MARGIN = 2.0**-12, 2.0**-20, 0.25
norm = np.linalg.norm


VERTICES = [0.5 * np.eye(2), np.diag([0.3, -0.4]), np.asarray([[0.0, 0.5], [0.0, 0.0]])]
LAYERS = [0.2 * np.eye(2), 0.5 * np.eye(2)]


def test_every_vertex_is_checked_with_its_own_multipliers():
    """|A| + |W_2||W_1| = 0.6 at most; λ = 0.25 proves 0.8, and λ < |W_2|²/2 proves
    nothing.
    """
    good, bad = [np.full(2, 0.25)], [np.full(2, 0.12)]
    assert _core.check_vertices(LAYERS, [good] * 3, 0.8, VERTICES)
    for k in range(3):
        assert not _core.check_vertices(
            LAYERS, [*[good] * k, bad, *[good] * (2 - k)], 0.8, VERTICES
        )
        longer = [vertex * (2 if j == k else 1) for j, vertex in enumerate(VERTICES)]
        assert not _core.check_vertices(LAYERS, [good] * 3, 0.8, longer)
    assert not _core.check_vertices(LAYERS, [good] * 3, 0.5, VERTICES)


def test_there_are_as_many_witnesses_as_vertices_and_at_least_one():
    good = [np.full(2, 0.25)]
    assert not _core.check_vertices(LAYERS, [], 0.8, [])
    for count in (0, 1, 2, 4):
        assert not _core.check_vertices(LAYERS, [good] * count, 0.8, VERTICES)
        assert not _core.check_vertices((), [()] * count, 0.8, VERTICES)
    for few in ([], [*good, *good]):
        for k in range(3):
            assert not _core.check_vertices(
                LAYERS, [*[good] * k, few, *[good] * (2 - k)], 0.8, VERTICES
            )
