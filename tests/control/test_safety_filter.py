"""The margins of the safety filter are those of its definition, in float64."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax import control, models

HORIZON = 6
OUTPUTS = ((3, 5), (4,))
LIMIT = np.asarray([0.3, 0.2])
WIDTHS = (0.8, 0.6)
BACKUPS = np.concatenate([np.diag(LIMIT), -np.diag(LIMIT)])


def case(seed):
    """A linear loop of three states with two controls and one input, at random."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((3, 3))
    A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    B = random.standard_normal((3, 3)) * [1.0, 1.0, 0.1]
    start = 0.3 * random.standard_normal(3)
    request = 0.3 * random.standard_normal(2)
    inputs = random.standard_normal((HORIZON, 1))
    return A, B, start, request, inputs


def margin(A, B, start, nu, inputs):
    """min_i (width_i − max_k |ŷ_i,k|), as the docstring defines it."""
    state = start
    sizes = []
    for step, rho in enumerate(inputs):
        acting = nu if step == 0 else np.zeros(2)
        state = A @ state + B @ np.concatenate([acting, rho])
        sizes.append([np.hypot(state[0], state[2]), abs(state[1])])
    return np.min(WIDTHS - np.max(sizes, axis=0))


@partial(jit, static_argnames="widths")
def filtered(A, B, start, request, inputs, widths=WIDTHS):
    def step(fiber, state, given):
        return jnp.concatenate([jnp.zeros(3), A @ state[3:] + B @ given])

    model = models.state_model(lambda key: {}, lambda params, env: env, step)
    return control.safety_filter(
        model,
        jnp.zeros(0),
        jnp.concatenate([jnp.zeros(3), start]),
        request,
        inputs,
        jnp.asarray(LIMIT),
        outputs=OUTPUTS,
        widths=widths,
        backups=jnp.asarray(BACKUPS),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_largest_scale_whose_margin_is_positive_passes(seed):
    ways = set()
    for offset in range(40):
        given = case(100 * seed + offset)
        result = filtered(*map(jnp.asarray, given))
        A, B, start, request, inputs = given
        clipped = np.clip(request, -LIMIT, LIMIT)
        margins = [
            margin(A, B, start, scale * clipped, inputs)
            for scale in control.FILTER_SCALES
        ]
        # Of a margin that is nearly 0 the sign is rounding.
        if min(map(abs, margins)) < 1e-5:
            continue
        passing = np.flatnonzero(np.asarray(margins) >= 0.0)
        if len(passing):
            scale = control.FILTER_SCALES[passing[0]]
            expected = scale * clipped
            ways.add("request" if scale == 1.0 else "scaled" if scale else "law")
            # Of the entry of the request that the limit clips most.
            share = np.min(LIMIT / np.maximum(np.abs(request), LIMIT))
            np.testing.assert_allclose(result.scale, scale * share, rtol=1e-5)
        else:
            candidates = [np.zeros(2), *BACKUPS]
            best = [margin(A, B, start, nu, inputs) for nu in candidates]
            expected = candidates[int(np.argmax(best))]
            ways.add("backup")
            assert float(result.scale) == 0.0
        np.testing.assert_allclose(result.nu, expected, atol=1e-6)
        true = margin(A, B, start, expected, inputs)
        np.testing.assert_allclose(result.margin, true, atol=1e-5)
        assert bool(result.feasible) == (true >= 0.0)
        after = A @ start + B @ np.concatenate([expected, inputs[0]])
        np.testing.assert_allclose(result.latent[3:], after, atol=1e-5)
    assert {"request", "backup"} <= ways


def test_a_request_or_a_state_that_is_not_finite():
    A, B, start, _, inputs = case(0)
    wide = (50.0, 50.0)
    bad = np.asarray([np.nan, 0.1])
    result = filtered(*map(jnp.asarray, (A, B, start, bad, inputs)), widths=wide)
    np.testing.assert_array_equal(result.nu, 0.0)
    assert bool(result.feasible)
    lost = np.full(3, np.nan)
    result = filtered(*map(jnp.asarray, (A, B, lost, bad, inputs)), widths=wide)
    np.testing.assert_array_equal(result.nu, 0.0)
    assert float(result.margin) == -np.inf
    assert not bool(result.feasible)
