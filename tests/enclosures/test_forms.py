"""Enclosures contain every value of a program, at numbers of every size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.enclosures import UnknownPrimitive, program, variables

WIDE = np.longdouble
POINTS = 40
MATRIX = np.random.default_rng(0).normal(size=(5, 3))


def mixture(xp, logits):
    """Softmax as programs have it."""
    raised = xp.exp(logits - xp.max(logits))
    return raised / xp.sum(raised)


PROGRAMS = {
    "sums and products": lambda xp, x: x * x[::-1] - 3.0 * x + 0.1,
    "a product of linear forms": lambda xp, x: (x[:1] - x[1:]) * (x[:1] + x[2]),
    "a matrix": lambda xp, x: MATRIX @ x,
    "a network": lambda xp, x: MATRIX.T @ xp.tanh(MATRIX @ x + 0.3),
    "waves": lambda xp, x: xp.sin(x) * xp.cos(2.0 * x),
    "a quotient": lambda xp, x: x / (2.0 + xp.sin(x[::-1])),
    "a root": lambda xp, x: xp.sqrt(x**2 + 1.0),
    "powers": lambda xp, x: x**3 - x**2,
    "an exponential": lambda xp, x: xp.exp(-(x**2)),
    "limits": lambda xp, x: xp.clip(3.0 * x - x[::-1], -0.5, 0.7),
    "sizes": lambda xp, x: xp.abs(x - 0.1),
    "a mixture": lambda xp, x: mixture(xp, 3.0 * x),
}


def boxes(random, count, radius):
    """Boxes with these radii at most, around centres in [-1, 1]^3."""
    centres = random.uniform(-1.0, 1.0, (count, 3))
    return centres, radius * random.uniform(0.0, 1.0, (count, 3))


def values_in(form, shares):
    """What a form says at a point of every box, and how far the value may be off."""
    wide = form.parts.astype(WIDE)
    at = shares.astype(WIDE)
    value = wide[0].copy()
    for index, part in zip(form.active, form.slopes, strict=True):
        value += part.astype(WIDE) * at[:, index, None]
    for (i, j), part in zip(form.pairs, wide[1 + len(form.active) :], strict=True):
        value += part * (at[:, i] * at[:, j])[:, None]
    return value, form.error


def points(random, count):
    """Corners of boxes and points inside."""
    inside = random.uniform(-1.0, 1.0, (count, 3))
    return np.where(random.random((count, 1)) < 0.5, np.sign(inside), inside)


@pytest.mark.parametrize("curved", [(), (0, 2), (0, 1, 2)])
@pytest.mark.parametrize("name", PROGRAMS)
def test_every_value_is_within_the_remainder(name, curved):
    """The same program in extended precision is the witness."""
    random = np.random.default_rng(1)
    function = PROGRAMS[name]
    read = program(lambda x: function(jnp, x), np.zeros(3))
    for radius in (0.0, 1e-12, 1e-3, 0.3, 2.0):
        centres, radii = boxes(random, 50, radius)
        form = read(variables(centres, radii, curved))[0]
        low, high = form.range
        for _ in range(POINTS):
            shares = points(random, len(centres))
            at = centres.astype(WIDE) + radii.astype(WIDE) * shares
            true = np.stack([function(np, x) for x in at])
            value, error = values_in(form, shares)
            # Extended precision itself rounds, far below float64.
            slack = 1e-17 * (1.0 + np.abs(true))
            with np.errstate(invalid="ignore"):
                near = np.abs(true - value) <= error + slack
            # An enclosure that says nothing is infinite, or NaN.
            assert np.all(near | ~np.isfinite(error))
            within = (low - slack <= true) & (true <= high + slack)
            assert np.all(within | ~np.isfinite(high - low))
            assert radius > 1.0 or np.all(np.isfinite(error))


@pytest.mark.parametrize("scale", [5e-324, 1e-310, 1e-160, 1e150, 1e300])
@pytest.mark.parametrize("name", ["sums and products", "a matrix", "limits", "sizes"])
def test_numbers_of_every_size(name, scale):
    """Underflow is inside the remainder, and overflow makes it infinite or NaN."""
    random = np.random.default_rng(2)
    function = PROGRAMS[name]
    read = program(lambda x: function(jnp, x), np.zeros(3))
    centres, radii = boxes(random, 50, 0.5)
    form = read(variables(scale * centres, scale * radii, (0, 1)))[0]
    shares = points(random, 50)
    at = (scale * centres).astype(WIDE) + (scale * radii).astype(WIDE) * shares
    true = np.stack([function(np, x) for x in at])
    with np.errstate(invalid="ignore"):
        value, error = values_in(form, shares)
        within = np.abs(true - value) <= error + 1e-17 * np.abs(true)
    assert np.all(within | ~np.isfinite(form.size))


def test_products_of_curved_variables_leave_a_remainder_of_third_order():
    read = program(lambda x: jnp.tanh(x[0] + 0.3 * x[1]), np.zeros(2))
    centres = np.full((1, 2), 0.4)

    def remainder(radius, curved):
        radii = np.full((1, 2), radius)
        return read(variables(centres, radii, curved))[0].error.item()

    assert remainder(1e-3, ()) / remainder(5e-4, ()) == pytest.approx(4.0, rel=0.02)
    with_pairs = remainder(1e-3, (0, 1)) / remainder(5e-4, (0, 1))
    assert with_pairs == pytest.approx(8.0, rel=0.02)


def test_a_square_at_its_lowest_point_is_no_constant():
    """Its slope is 0 there, so that only the pair of its variable is left."""
    read = program(lambda x: (x**2)[:1] * x[1:] + (x**2)[:1], np.zeros(2))
    centres = np.asarray([[0.0, 1.0]])
    low, high = read(variables(centres, np.ones((1, 2)), (0, 1)))[0].range
    assert low <= 0.0
    assert high >= 3.0


def test_common_terms_cancel():
    def program_of(x):
        return (MATRIX @ x) * 2.0 - MATRIX @ (2.0 * x)

    form = program(program_of, np.zeros(3))(variables(np.ones((1, 3)), np.ones((1, 3))))
    assert np.max(form[0].size) < 1e-12


def test_loops_calls_and_moves_are_read():
    @jax.jit
    def moved(x):
        def body(carry, _):
            return carry.at[np.asarray([2, 0])].set(0.5 * carry[:2]), None

        return jax.lax.scan(body, x, None, length=3)[0][::-1]

    form = program(moved, np.zeros(3))(
        variables(np.asarray([[0.2, 0.4, 0.6]]), np.zeros((1, 3)))
    )[0]
    np.testing.assert_allclose(form.centre[0], moved(jnp.asarray([0.2, 0.4, 0.6])))


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (lambda x: jnp.arctan2(x[0], x[1]), "atan2"),
        (lambda x: jnp.floor(x), "floor"),
        (lambda x: jnp.where(x > 0.0, x, -x), "select_n"),
        (lambda x: jnp.log(x), "log"),
    ],
)
def test_what_has_no_enclosure_is_refused_by_its_name(function, name):
    with pytest.raises(UnknownPrimitive, match=name):
        program(function, np.zeros(2))
