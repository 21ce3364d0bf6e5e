"""The contract of `Model`: all registered models, all variants, the physics rows."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from helpers import (
    HARD,
    OTHERS,
    PHYSICS,
    TINY,
    VARIANTS,
    at,
    driven,
    jit,
    model_and_params,
    path_space,
    same,
    space,
)

from sfkd_jax import models, paper
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.geometry import compose
from sfkd_jax.models.sfkd import RESIDUALS
from sfkd_jax.rollout import fold, rollout
from sfkd_jax.types import POSE, Structure, Trajectory

EVERY = (*VARIANTS, *OTHERS, *PHYSICS)
LEARNED = (*VARIANTS, *OTHERS)
SFKD = tuple(VARIANTS)


def chain(model, params, trajectory):
    """Two steps with a switch of the environment: every function of a model is called."""
    here, there = (
        model.fiber(params, env) for env in (trajectory.envs[0], trajectory.envs[1])
    )
    start = model.encode(here, trajectory.states[0])
    stepped = model.step(here, start, trajectory.controls[0])
    moved = model.step(
        there, model.transport(here, there, stepped), trajectory.controls[1]
    )
    seen = model.observe(there, start, trajectory.states[2])
    again = model.observe(here, start, trajectory.states[0])
    return {
        "start": model.decode(here, start),
        "stepped": model.decode(here, stepped),
        "moved": model.decode(there, moved),
        "gap": model.vector(moved) - model.vector(seen),
        "seen again": model.vector(again) - model.vector(start),
    }


@cache
def chained(name):
    """The chain of a model by name, compiled once."""
    return jit(partial(chain, model_and_params(name)[0]))


def run(name, trajectory):
    return chained(name)(model_and_params(name)[1], trajectory)


@pytest.fixture(scope="module")
def one():
    return at(driven(), 0)


def test_every_registered_model_is_tested_here():
    assert {"sfkd", *OTHERS} == set(models.FACTORIES | paper.MODELS)
    kinds = {variant.get("residual", "sandwich") for variant in VARIANTS.values()}
    assert kinds == set(RESIDUALS)


@pytest.mark.parametrize("name", EVERY)
def test_a_state_comes_out_as_it_went_in(name, one):
    """Shapes, finite numbers, and the pose."""
    out = run(name, one)
    assert out["start"].shape == out["stepped"].shape == out["moved"].shape == (4,)
    assert out["gap"].ndim == 1
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(out))
    np.testing.assert_array_equal(out["start"][POSE], one.states[0, POSE])
    # Observing the state that was encoded gives its latent.
    np.testing.assert_allclose(out["seen again"], 0.0, atol=1e-6)


@pytest.mark.parametrize("name", LEARNED)
def test_gradients_of_a_rollout_are_finite_and_reach_every_parameter_in_use(name, one):
    model, params = model_and_params(name)

    def loss(params):
        predicted = rollout(model, params, one).free
        total = jnp.sum((predicted - one.states[1:]) ** 2)
        if model.fitting.penalty is not None:
            fiber = model.fiber(params, one.envs[0])
            total += model.fitting.penalty(
                fiber, model.encode(fiber, one.states[0]), one.controls[0]
            )
        return total

    flat = flatten_dict(jit(jax.grad(loss))(params), sep="/")
    assert all(np.all(np.isfinite(gradient)) for gradient in flat.values())
    unused = {name for name, gradient in flat.items() if not np.any(gradient)}
    allowed = {
        "no_transport": ("tangent_head",),
        "state": ("tangent_head", "square_2"),  # of one body state as well
        "no_fiber": ("psi/layers_0/kernel",),  # which reads e
        "control_synth": ("free/Y",),  # Y − Y' of a single body state is 0
    }
    assert not {
        path
        for path in unused
        if not any(part in path for part in allowed.get(name, ()))
    }


@pytest.mark.parametrize("name", EVERY)
def test_predictions_move_with_the_frame_of_the_world(name, one):
    """SE(2): a motion of the initial pose moves every predicted pose; body states stay."""
    world = jnp.asarray([30.0, -20.0, 1.1])
    states = jax.vmap(lambda state: state.at[POSE].set(compose(world, state[POSE])))(
        one.states
    )
    here, there = run(name, one), run(name, one._replace(states=states))
    for part in ("start", "stepped", "moved"):
        expected = here[part].at[POSE].set(compose(world, here[part][POSE]))
        np.testing.assert_allclose(there[part], expected, rtol=1e-5, atol=3e-5)
    np.testing.assert_allclose(there["gap"], here["gap"], atol=3e-5)


@pytest.mark.parametrize("name", EVERY)
def test_only_models_without_an_environment_ignore_it_and_these_exactly(name, one):
    blind = name in ("no_fiber", "nominal")
    other = one._replace(envs=one.envs[::-1])
    assert same(run(name, one), run(name, other), rtol=0, atol=0) == blind


@pytest.mark.parametrize("name", SFKD)
def test_what_is_certified_is_what_is_multiplied_by(name, one):
    model, params = model_and_params(name)
    explicit, fiber = jit(
        lambda params: (
            model.structure.explicit(params),
            model.fiber(fold(model, params), one.envs[0]),
        )
    )(params)
    vertices = np.asarray(explicit.operators.vertices)
    if name == "state":
        # Its z is the one body state, and the weights read the control too.
        operator, *_ = model.step.__self__._terms(fiber, one.controls[0])
        A, mixture = operator.summed(), np.asarray(operator.weights)
    else:
        A = fiber.A
        mixture, *_ = np.linalg.lstsq(
            vertices.reshape(3, -1).T, np.ravel(A), rcond=None
        )
    assert vertices.shape == (TINY["vertices"], *A.shape)
    residual, decoder = fiber.shared.residual.matrices, fiber.shared.decoder.matrices
    assert same(explicit.residual, residual, rtol=0, atol=0)
    assert bool(explicit.residual) == (name != "no_residual")
    assert same(explicit.decoder[:-1], decoder[:-1], rtol=0, atol=0)
    assert bool(explicit.decoder) == model.frame.has_pose
    if explicit.decoder:
        scale = np.asarray(space().increment_scale)
        np.testing.assert_allclose(
            explicit.decoder[-1],
            scale[:, None] * np.asarray(decoder[-1]),
            rtol=1e-6,
        )
    np.testing.assert_allclose(np.tensordot(mixture, vertices, axes=1), A, atol=1e-5)
    assert np.all(mixture > 0)
    np.testing.assert_allclose(mixture.sum(), 1.0, atol=1e-5)
    assert len(explicit.residual_multipliers) == (
        2 if name in (*HARD, "joint", "path", "state") else 0
    )


def test_only_the_soft_variant_has_a_penalty_and_it_is_the_hinge_on_the_jacobian(one):
    assert [
        name
        for name in LEARNED
        if model_and_params(name)[0].fitting.penalty is not None
    ] == ["soft"]
    model, params = model_and_params("soft")

    @jit
    def parts(params):
        fiber = model.fiber(params, one.envs[0])
        latent = model.encode(fiber, one.states[0])
        slope = jax.jacobian(
            lambda z: model.step(fiber, latent._replace(z=z), one.controls[0]).z
        )(latent.z)
        slope = slope - fiber.A
        return model.fitting.penalty(fiber, latent, one.controls[0]), slope

    penalty, slope = parts(params)
    excess = np.linalg.norm(np.asarray(slope, np.float64), 2) - 0.1
    assert excess > 0
    np.testing.assert_allclose(penalty, excess**2, rtol=1e-3)


@pytest.mark.parametrize("free", [1, 3])
def test_what_planners_add_takes_any_number_of_controls(free):
    """Of one and of three, with one input from the reference."""
    frame = replace(PATH_FRAME, inputs=1)
    scales = path_space()
    size = free + frame.inputs
    scales = scales._replace(control_mean=jnp.zeros(size), control_scale=jnp.ones(size))
    frame = replace(
        frame, following=lambda rho, body: jnp.zeros(body).at[1].set(rho[0])
    )
    model = models.sfkd(scales, **TINY, frame=frame, planning_residual=True)
    params = jit(model.init)(jax.random.key(0))

    @jit
    def both(params, control):
        fiber = model.planning.fiber(params, jnp.zeros(2))
        state = jnp.zeros(6).at[4].set(control[free])
        latent = model.planning.encode(fiber, state)
        there = model.planning.on_reference(fiber, control[free:])
        return [model.planning.step(at, latent, control) for at in (fiber, there)]

    alone, shared = both(params, 0.1 * jnp.arange(1.0, size + 1.0))
    np.testing.assert_allclose(alone, shared, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["path", "state", "sfkd"])
def test_what_planners_add_is_nothing_at_first_and_never_certified(name):
    """Not a bit of the model itself changes, whatever is added."""
    scales = space(3) if name == "sfkd" else path_space()
    build = partial(models.sfkd, scales, **TINY | VARIANTS[name])
    model, both = build(), build(planning_residual=True)
    planning, params = both.planning, jit(both.init)(jax.random.key(0))
    draw, along = partial(jax.random.normal, jax.random.key(1)), not both.frame.has_pose
    states, controls = draw((3, 6)).at[:, 5].add(10.0), 0.01 * draw((2, 2 + 2 * along))
    if along:
        # e_y, e_ψ and ν are 0 in the first state, and v is v_ref: F is its tangent.
        controls = controls.at[:, 3].add(9.0).at[0, :2].set(0.0)
        states = states.at[0, :5].set(0.0).at[0, 5].set(controls[0, 3])
    run = Trajectory(states, controls, 0.3 * draw((2, 2)))

    @jit
    def driven(params):
        fiber = planning.fiber(params, run.envs[0])
        there = planning.on_reference(fiber, run.controls[0, 2:]) if along else fiber
        start = planning.encode(fiber, run.states[0])
        after = (planning.step(at, start, controls[0]) for at in (there, fiber))
        steps = [planning.decode(fiber, latent) for latent in after]
        own = model.fiber(params, run.envs[0])
        latent = model.step(own, model.encode(own, run.states[0]), controls[0])
        certified = chain(both, params, run), both.structure.explicit(params)
        return certified, (*steps, model.decode(own, latent))

    folded = jit(partial(fold, both))(params)
    alone = jit(lambda p: (chain(model, p, run), model.structure.explicit(p)))(folded)
    before = driven(folded)[0]
    assert same(before, alone, rtol=1e-6, atol=1e-6)
    assert planning.structure == Structure()
    for size in (0.0, 0.1, 1e30, np.nan):
        more = jax.tree.map(lambda leaf, size=size: leaf + size, params["planning"])
        changed = folded._replace(weights={**params, "planning": more})
        certified, (split, whole, expected) = driven(changed)
        assert same(certified, before, rtol=0, atol=0)
        # Sums of other orders, relative to a speed of 10 m/s.
        assert same(whole, expected, rtol=1e-6, atol=1e-5) == (size == 0.0)
        if size < 1.0:
            np.testing.assert_allclose(split, whole, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["sfkd", "joint", "no_contraction", "path"])
def test_folded_parameters_are_the_same_model_and_the_same_claim(name, one):
    model, params = model_and_params(name)
    folded = jit(partial(fold, model))(params)

    @jit
    def driven(given):
        fiber = model.fiber(given, one.envs[0])
        after = model.step(fiber, model.encode(fiber, one.states[0]), one.controls[0])
        return model.vector(after), model.decode(fiber, after)

    assert same(driven(folded), driven(params), rtol=1e-5, atol=1e-5)
    claims = [jit(model.structure.explicit)(given) for given in (folded, params)]
    assert same(*claims, rtol=1e-6, atol=1e-6)


def test_nothing_is_factorised_in_a_control_step_with_folded_parameters(one):
    """The threads of a linear algebra library spin on a busy host: one inverse may take
    a sampling period.
    """
    model, params = model_and_params("sfkd")
    program = [
        jax.jit(model.fiber).lower(given, one.envs[0]).as_text()
        for given in (params, jit(partial(fold, model))(params))
    ]
    raw, folded = (
        "lapack" in text or "linalg" in text or "triangular_solve" in text
        for text in program
    )
    assert raw
    assert not folded


def test_a_claim_about_folded_parameters_is_about_the_matrices_that_run():
    """Parameters changed after folding must not be certified as the original ones."""
    model, params = model_and_params("sfkd")
    folded = jit(partial(fold, model))(params)
    spoiled = folded._replace(
        shared=jax.tree.map(lambda leaf: 2.0 * leaf, folded.shared)
    )
    assert same(
        model.structure.explicit(spoiled).readout,
        2.0 * model.structure.explicit(params).readout,
        rtol=1e-6,
        atol=1e-6,
    )
