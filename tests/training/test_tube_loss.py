"""The certified tube in the loss equals its formula, in metres; training can lower it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY, any_law, jit

from sfkd_jax import models
from sfkd_jax.data import measure_space, random_windows, split
from sfkd_jax.driving import plants
from sfkd_jax.driving.drives import generate_along_path
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.rollout import rollout
from sfkd_jax.training import multi_step_loss
from sfkd_jax.training._losses import power_mean

LOW, HIGH = (0.3, -8.0), (0.9, 8.0)


@pytest.fixture(scope="module")
def learned():
    loop = plants.along_path(plants.kinematic(), any_law())
    drives = jit(
        partial(
            generate_along_path, loop, segments=32, steps=12, env_low=LOW, env_high=HIGH
        )
    )
    box = {"env_low": jnp.asarray(LOW), "env_high": jnp.asarray(HIGH)}
    data = split(
        drives(jax.random.key(0)), jax.random.key(1), shares=(0.7, 0.1, 0.1, 0.1), **box
    )
    space = measure_space(data)
    model = models.sfkd(
        space, **TINY | {"frame": PATH_FRAME, "budget": "joint", "learn_alpha": True}
    )
    batch = random_windows(data.train, jax.random.key(2), batch=8, length=5)
    return model, space, jit(model.init)(jax.random.key(3)), batch


def test_the_tube_in_the_loss_is_the_read_out_times_the_defect_over_what_contracts(
    learned,
):
    model, space, params, batch = learned
    loss = multi_step_loss(model, space, tube=(0.5,))
    total, parts, _ = loss.validate(params, batch)
    gaps = jit(jax.vmap(lambda drive: rollout(model, params, drive).defects))(batch)
    largest = float(power_mean(jnp.linalg.norm(gaps, axis=-1)))
    row = float(jnp.linalg.norm(model.structure.explicit(params).readout[0]))
    np.testing.assert_allclose(
        parts["tube"],
        row * largest / (1.0 - float(model.structure.rate(params))),
        rtol=1e-4,
    )
    without, _, _ = multi_step_loss(model, space).validate(params, batch)
    np.testing.assert_allclose(
        total - without, 0.5 * (float(parts["tube"]) / 0.01) ** 2, rtol=1e-3
    )


def test_alpha_follows_the_loss_and_stays_below_its_largest(learned):
    """A large tube weight decreases α; the bounds hold for any α."""
    model, space, params, batch = learned
    loss = multi_step_loss(
        model,
        space,
        prediction=0.0,
        one_step=0.0,
        consistency=0.0,
        reconstruction=0.0,
        transport=0.0,
        tube=(1.0,),
    )
    slope = jit(jax.grad(lambda params: loss(params, batch)[0]))(params)
    assert float(slope["networks"]["alpha_logit"]) > 0
    assert 0.5 < float(model.structure.rate(params)) < 0.995
    for logit in (-5.0, 5.0):
        moved = params | {
            "networks": params["networks"] | {"alpha_logit": jnp.asarray(logit)}
        }
        norms = jnp.linalg.norm(
            model.structure.explicit(moved).operators.vertices, ord=2, axis=(1, 2)
        )
        assert np.all(norms <= float(model.structure.rate(moved)) + 1e-5)


def test_a_power_mean_holds_tiny_and_huge_numbers():
    for scale in (1e-12, 1.0, 1e12):
        np.testing.assert_allclose(
            power_mean(scale * jnp.asarray([1.0, 2.0, 2.0])),
            2 * scale * (2 / 3) ** 0.125,
            rtol=2e-3,
        )


def test_a_tube_of_a_model_without_a_rate_is_refused(learned):
    space = learned[1]
    with pytest.raises(ValueError, match=r"training\.loss\.tube"):
        multi_step_loss(models.neural_ode(space, frame=PATH_FRAME), space, tube=(0.1,))
    with pytest.raises(ValueError, match="4 weights, the body state 3 entries"):
        multi_step_loss(learned[0], space, tube=(0.1,) * 4)
