"""A cover proves what it says, and a forged one is refused."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.enclosures import (
    CoverRefused,
    Question,
    check_cover,
    levels,
    norms,
    program,
    search_cover,
    variables,
)


def question(function=lambda x: jnp.stack([x[0] ** 2 - x[1] ** 2, 2 * x[0] * x[1]])):
    """|z²| for a complex z of the square, which is 2 at its corners."""
    read = program(function, np.zeros(2))

    def enclose(boxes):
        return read(variables(boxes.centres, boxes.radii))[0]

    def outside(boxes):
        return np.zeros(boxes.count, bool)

    return Question(enclose, norms, outside, roots=1, variables=2)


@pytest.fixture(scope="module")
def found():
    return search_cover(question(), 2.02)


def test_a_known_largest_value_is_enclosed_from_above(found):
    assert not found.open.count
    assert 2.0 <= found.largest <= 2.02
    assert check_cover(question(), found.codes, found.largest) == found.leaves


def test_boxes_outside_of_the_domain_are_left_out():
    """For |x| ≤ 1/2 the largest |z²| is 5/4."""

    def outside(boxes):
        return np.abs(boxes.centres[:, 0]) - boxes.radii[:, 0] > 0.5

    narrow = replace(question(), outside=outside)
    cover = search_cover(narrow, 1.27)
    assert not cover.open.count
    assert np.any(cover.codes == 254)
    assert check_cover(narrow, cover.codes, cover.largest) == cover.leaves
    with pytest.raises(CoverRefused, match="left out"):
        check_cover(question(), cover.codes, cover.largest)


def test_no_search_closes_below_the_largest_value():
    assert search_cover(question(), 1.99, most=3000).open.count


def test_leaves_are_a_partition(found):
    """They have the volume of the square, and no two contain the same point."""
    parts = [leaves for leaves, _ in levels(found.codes, question())]
    centres = np.concatenate([part.centres for part in parts])
    radii = np.concatenate([part.radii for part in parts])
    assert np.sum(np.prod(2.0 * radii, axis=1)) == 4.0
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 2))
    inside = np.all(np.abs(random[:, None] - centres) < radii, axis=2)
    assert np.all(np.sum(inside, axis=1) == 1)


def forged(codes, kind):
    """A cover with a fault."""
    codes = codes.copy()
    split = int(np.flatnonzero(codes < 2)[-1])
    last = int(np.flatnonzero(codes == 255)[-1])
    if kind == "a leaf is missing":
        return np.delete(codes, last)
    if kind == "a leaf is there twice":
        return np.append(codes, codes[last])
    if kind == "leaves overlap":
        codes[split] = 255
        return codes
    if kind == "an unknown variable":
        codes[split] = 2
        return codes
    if kind == "a box is left out":
        codes[last] = 254
        return codes
    if kind == "leaves are too large":
        return np.asarray([0, 255, 255], np.uint8)
    raise ValueError(kind)


@pytest.mark.parametrize(
    "kind",
    [
        "a leaf is missing",
        "a leaf is there twice",
        "leaves overlap",
        "an unknown variable",
        "a box is left out",
        "leaves are too large",
    ],
)
def test_a_forged_cover_is_refused(found, kind):
    with pytest.raises(CoverRefused):
        check_cover(question(), forged(found.codes, kind), found.largest)


@pytest.mark.parametrize("largest", [1.99, np.nan, np.inf, -1.0])
def test_a_smaller_bound_or_none_is_refused(found, largest):
    with pytest.raises(CoverRefused):
        check_cover(question(), found.codes, largest)


def test_another_function_is_refused(found):
    """The function is 1 % larger, and its cover was tight."""

    def larger(x):
        return 1.02 * jnp.stack([x[0] ** 2 - x[1] ** 2, 2 * x[0] * x[1]])

    with pytest.raises(CoverRefused):
        check_cover(question(larger), found.codes, found.largest)
