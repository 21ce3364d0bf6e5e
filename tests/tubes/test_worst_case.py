"""The tube of the worst case: a loop whose largest one-step error is known."""

from dataclasses import replace
from functools import cache
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import DT, loop, pushed

from sfkd_jax import models
from sfkd_jax.certificate import OutputMetric
from sfkd_jax.enclosures import CoverRefused
from sfkd_jax.tubes import (
    OneStep,
    States,
    WorstCaseRefused,
    check_worst_case,
    prove_worst_case,
    sampled_worst,
)
from sfkd_jax.tubes._one_step import Cells
from sfkd_jax.types import BODY

NOISE = np.asarray([0.003, 0.006])
FACTOR = 1.01
METRIC = ((1.0, 0.1), (0.1, 0.2))
B = np.asarray([0.5 * DT**2, DT])


@cache
def nominal_matrix():
    """The closed loop in the middle of its table."""
    at = loop().law.at(jnp.zeros(1), jnp.asarray([1.0, 0.0]))
    return np.asarray([[1.0, DT], [0.0, 1.0]]) - np.outer(B, at.gain)


def nominal_step(state, control, env):
    """A model that knows nothing of e."""
    moved = jnp.asarray(nominal_matrix()) @ state[BODY] + jnp.asarray(B) * control[0]
    return jnp.concatenate([jnp.zeros(3), moved])


def one_step(of=None):
    of = loop() if of is None else of
    model = models.physics(nominal_step, frame=of.tracked.model_frame)
    states = States(np.zeros(2), np.diag([0.05, 0.1]), np.zeros((0, 2)))
    return OneStep(of, model, {}, states, NOISE, curved=(0, 1, 2, 3, 4))


def claim():
    """Constants as of a proof; α is that of the model in this metric."""
    root = np.linalg.cholesky(np.asarray(METRIC)).T
    inverse = np.linalg.inv(root)
    alpha = float(np.linalg.norm(root @ nominal_matrix() @ inverse, 2))
    return OutputMetric(
        alpha=alpha,
        lipschitz=float(np.linalg.norm(np.asarray([[1.0, 0.0]]) @ inverse)),
        metric=METRIC,
        joint=(),
    )


@cache
def largest():
    """The largest error. It is linear in every variable, or monotone: at a corner."""
    error = one_step()
    root = jnp.asarray(np.linalg.cholesky(np.asarray(METRIC)).T)
    corners = np.asarray([*product((-1.0, 1.0), repeat=error.variables)])

    def size(at, *cell):
        return jnp.linalg.norm(root @ error.difference(at, Cells(*cell)))

    with jax.enable_x64(True):
        at_corners = jax.vmap(size, in_axes=(0, None, None, None, None, None))
        of_cells = jax.jit(jax.vmap(at_corners, in_axes=(None, 0, 0, 0, 0, 0)))
        return float(jnp.max(of_cells(corners, *error.cells)))


@cache
def proved():
    return prove_worst_case(one_step(), claim(), largest(), factor=FACTOR)


def test_the_bound_is_the_known_one():
    tube, _ = proved()
    assert largest() * (1.0 - 1e-12) <= tube.one_step <= FACTOR * largest()
    assert tube.radius == pytest.approx(tube.one_step / (1.0 - claim().alpha))


def test_an_ascent_finds_the_worst_case(key):
    size, _, _ = sampled_worst(one_step(), claim(), key, samples=2000)
    assert size == pytest.approx(largest(), rel=1e-3)


def test_a_cell_of_the_law_is_the_law(key):
    """At random places the polynomial of a cell is the value of the table."""
    error = one_step()
    cells = error.cells
    for number, at_key in enumerate(jax.random.split(key, 8)):
        cell = Cells(*(jnp.asarray(part[number % len(cells.middle)]) for part in cells))
        at = jax.random.uniform(at_key, (error.variables,), minval=-1.0, maxval=1.0)
        _, _, _, inputs, env, steady = error.situation(at, cell)
        for part, expected in zip(steady, error.loop.law.at(inputs, env), strict=True):
            np.testing.assert_allclose(part, expected, atol=2e-5)


def test_the_tube_holds_on_the_worst_sequences_that_a_greedy_enemy_finds(key):
    """Every step takes the corner that drives system and model farthest apart."""
    error = one_step()
    tube, _ = proved()
    root = np.linalg.cholesky(np.asarray(METRIC)).T
    corners = np.asarray([*product((-1.0, 1.0), repeat=error.variables)])
    # Entries of ξ are those of the run, not of the enemy.
    first = error.cells.middle.shape[1]
    corners[:, first : first + 2] = 0.0

    @jax.jit
    def after(state, nominal, at, *cell):
        of = replace(error, states=States(state, np.zeros((2, 2)), np.zeros((0, 2))))
        _, _, nu, inputs, env, _ = of.situation(at, Cells(*cell))
        padded = jnp.concatenate([jnp.zeros(3), nominal])
        predicted = nominal_step(padded, jnp.concatenate([nu, inputs]), env)
        return of.after(at, Cells(*cell)), predicted[BODY]

    over = jax.vmap(after, in_axes=(None, None, 0, None, None, None, None, None))
    state = jnp.zeros(2)
    nominal = jnp.zeros(2)
    farthest = 0.0
    for _ in range(30):
        options = [
            over(state, nominal, corners, *(part[number] for part in error.cells))
            for number in range(len(error.cells.middle))
        ]
        states, nominals = (np.concatenate(part) for part in zip(*options, strict=True))
        gaps = np.linalg.norm((states - nominals) @ root.T, axis=1)
        inside = np.all(np.abs(states) <= [0.05, 0.1], axis=1)
        best = int(np.argmax(np.where(inside, gaps, -1.0)))
        state = states[best]
        nominal = nominals[best]
        farthest = max(farthest, float(gaps[best]))
    assert 0.15 * tube.radius < farthest <= tube.radius


def heavier(state, control, env):
    """The mass is 1 % larger than it says."""
    return pushed(state, control, env * jnp.asarray([1.01, 1.0]))


def changed(kind):
    """The loop with a fault of 1 %."""
    of = loop()
    if kind == "plant":
        tracked = of.tracked
        system = replace(tracked.system, step=heavier)
        return replace(of, tracked=replace(tracked, system=system))
    return replace(of, law=of.law._replace(gain=1.01 * of.law.gain))


def test_the_cover_is_checked():
    tube, codes = proved()
    check_worst_case(one_step(), claim(), tube, codes)


@pytest.mark.parametrize("kind", ["plant", "gain"])
def test_another_loop_is_refused(kind):
    tube, codes = proved()
    with pytest.raises(CoverRefused, match="not proved on the leaf"):
        check_worst_case(one_step(changed(kind)), claim(), tube, codes)


@pytest.mark.parametrize(
    "change",
    [
        {"radius": 0.9},
        {"bound": 0.9},
        {"leaves": 2},
        {"one_step": 0.9, "radius": 0.9, "bound": 0.9},
    ],
)
def test_a_forged_tube_is_refused(change):
    tube, codes = proved()
    forged = {
        name: type(getattr(tube, name))(getattr(tube, name) * factor)
        for name, factor in change.items()
    }
    with pytest.raises((WorstCaseRefused, CoverRefused)):
        check_worst_case(one_step(), claim(), replace(tube, **forged), codes)


def test_leaves_of_another_hash_are_refused():
    tube, codes = proved()
    with pytest.raises(WorstCaseRefused, match="not those of the tube"):
        check_worst_case(one_step(), claim(), tube, codes[:-1])


def test_a_search_that_ends_early_proves_nothing():
    with pytest.raises(WorstCaseRefused, match="boxes have a bound above"):
        prove_worst_case(one_step(), claim(), largest(), factor=1.0, seconds=0.0)
