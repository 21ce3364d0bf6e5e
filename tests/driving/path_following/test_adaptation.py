"""Adaptation while driving: what is estimated, what stays proved, and hostile inputs."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, any_law, certified, jit, model_and_params

from sfkd_jax import assembly, certification, models
from sfkd_jax.certification._weights import exported
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.driving.path_following.wrappers import _estimator as estimator
from sfkd_jax.driving.path_following.wrappers._adaptation import _compensation
from sfkd_jax.geometry import without_pose
from sfkd_jax.info import ControllerInfo, PlanInfo
from sfkd_jax.latency import Latency
from sfkd_jax.rollout import Offset, with_offset
from sfkd_jax.types import BODY, Controller

PLANT, LAW = plants.kinematic(), any_law()
MODEL = models.physics(assembly.build_loop(PLANT, LAW).step, frame=PATH_FRAME)
"""The true loop as a model, so that every estimate has an exact answer."""
LOOP = estimator.Loop(MODEL, LAW, jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH))
NOISE = np.float32([0.015, 0.002, 0.03])
STEPS = 120
SETTINGS = {
    "control_low": PLANT.control_low,
    "control_high": PLANT.control_high,
    "env_low": ENV_LOW,
    "env_high": ENV_HIGH,
    "sensor_noise": PLANT.sensor_noise,
    "model_error": (1e-3, 3e-4, 3e-3),
}
HORIZON = 4


def law_alone():
    """A controller along a path whose plan is the law, with offset parameters."""

    def act(params, state, xi, env, preview):
        ahead = jnp.tile(xi, (HORIZON, 1))
        info = ControllerInfo(plan=PlanInfo(states=ahead), planner=xi)
        return LAW(xi, *preview.road[0], env), state, info

    return Controller(lambda key: jnp.zeros(()), act)


@cache
def adaptive(**settings):
    options = SETTINGS | {"inner": law_alone(), "model": MODEL, "law": LAW} | settings
    adaptation = path_following.Adaptation(**options).controller()
    prediction = path_following.Prediction(model=MODEL, law=LAW, dt=PLANT.dt)
    gate = path_following.Gate(
        inner=adaptation, prediction=prediction, horizon=HORIZON
    ).controller()
    return path_following.along_reference(gate, coordinates=3)


def road(time, speed=10.0):
    """Reference points ahead of a car that drives along a straight line."""
    ahead = speed * 0.1 * (time + 1.0 + jnp.arange(HORIZON))
    zero = jnp.zeros(HORIZON)
    return jnp.stack([ahead, zero, zero, zero + speed], axis=1)


def hostile(time, seen, last):
    """Every few steps a value that no sensor should give."""
    values = jnp.asarray([jnp.nan, jnp.inf, -1e30, 1e-40, 1e6, 0.0, 3e38, 1e3])
    which = (7.0 * time).astype(int)
    value, entry = values[which % 8], which % 4
    return seen.at[entry].set(jnp.where(time % 5 == 3, value, seen[entry]))


def during(time, steps, value, seen):
    return jnp.where((time >= 60) & (time < 60 + steps), value, seen)


FAULTS = {
    "none": lambda time, seen, last: seen,
    "jump": lambda time, seen, last: during(time, 1, seen.at[1].add(5.0), seen),
    "freeze": lambda time, seen, last: during(time, 4, last, seen),
    "lose": lambda time, seen, last: during(time, 4, jnp.nan, seen),
    "overflow": lambda time, seen, last: during(time, 1, 1e30, seen),
    "hostile": hostile,
}
"""(step, observation, last observation) -> observation."""


@cache
def driver(**settings):
    """Infos and beliefs of drives in a loop with unmeasured causes, compiled once."""
    controller = adaptive(**settings)
    env = jnp.asarray([0.7, 0.0])

    @jit
    def run(seed, force, steering, noise, fault, scores):
        pushed = LOOP.split_force(env, force)[0]

        def step(carry, inputs):
            state, memory, last = carry
            time, key = inputs
            # The car is put back onto the abscissa of the reference.
            state = state.at[0].set(time)
            seen = state.at[1:4].add(noise * NOISE * jax.random.normal(key, (3,)))
            seen = jax.lax.switch(fault, list(FAULTS.values()), time, seen, last)
            action, memory, info = controller.act({}, memory, seen, env, road(time))
            state = PLANT.step(state, action.at[0].add(steering), pushed)
            return (state, memory, seen), (info, memory.inner.inner.belief)

        start = jnp.asarray([0.0, 0.0, 0.0, 10.0])
        memory = controller.init(jax.random.key(0))
        gate = memory.inner
        belief = gate.inner.belief._replace(scores=scores)
        gate = gate._replace(inner=gate.inner._replace(belief=belief))
        carry = (start, memory._replace(inner=gate), start)
        keys = jax.random.split(jax.random.key(seed), STEPS)
        return jax.lax.scan(step, carry, (jnp.arange(float(STEPS)), keys))[1]

    return run


def drive(
    seed=0,
    force=0.0,
    steering=0.0,
    noise=0.0,
    fault="none",
    scores=(0.0, 0.0),
    **settings,
):
    """One drive; without settings, causes are not shrunk and all drives are one program."""
    run = driver(**(settings or {"shrinkage": 0.0}))
    number = list(FAULTS).index(fault)
    made = run(seed, force, steering, noise, number, jnp.asarray(scores))
    return jax.tree.map(np.asarray, made)


def test_an_offset_shifts_a_step_and_nothing_else():
    """F(z, u + δ) + b, so that two predictions differ by the same as before."""
    model, params = model_and_params("path")
    shifted, env = with_offset(model), jnp.asarray([0.5, 3.0])
    fiber = model.fiber(params, env)
    states = [without_pose(jnp.asarray([9.5 + k])) for k in range(2)]
    control_, delta = jnp.asarray([0.01, 0.2]), jnp.full(2, 0.01)
    latents = [model.encode(fiber, state) for state in states]
    push = states[0], without_pose(jnp.asarray([0.1]))
    _, lifted = jax.jvp(partial(model.encode, fiber), push[:1], push[1:])
    fiber_ = shifted.fiber(Offset(params, delta, push), env)
    plain = [model.step(fiber, latent, control_ + delta) for latent in latents]
    moved = [shifted.step(fiber_, latent, control_) for latent in latents]
    gap = lambda pair: model.vector(pair[1]) - model.vector(pair[0])
    np.testing.assert_allclose(gap(moved), gap(plain), atol=1e-6)
    shift = model.vector(moved[0]) - model.vector(plain[0])
    np.testing.assert_allclose(shift, model.vector(lifted), atol=1e-6)


def test_the_certificate_of_the_model_holds_for_the_adapted_one():
    """Its explicit weights are the same arrays; other weights are refused."""
    model, params = model_and_params()
    certificate = certified()
    push = jnp.zeros(4), jnp.full(4, 1e3)
    offset = Offset(params, jnp.full(2, 50.0), push)
    adapted = exported(with_offset(model), offset)
    certification.verify_proof(certificate, model, offset.params, weights=adapted)
    larger = jax.tree.map(lambda leaf: 3.0 * leaf, params)
    broken = exported(with_offset(model), offset._replace(params=larger))
    with pytest.raises(certification.CertificationRefused):
        certification.verify_proof(certificate, model, params, weights=broken)


def test_a_constant_side_force_is_found():
    force = -0.6
    info, _ = drive(force=force)
    causes = info.adaptation.causes[-20:]
    np.testing.assert_allclose(causes[:, estimator.FORCE], force, atol=0.05)
    np.testing.assert_allclose(causes[:, estimator.STEERING], 0.0, atol=0.002)


def test_a_wrong_steering_angle_is_found_and_removed():
    info, _ = drive(steering=0.02)
    causes = info.adaptation.causes[-20:]
    np.testing.assert_allclose(causes[:, estimator.STEERING], 0.02, atol=1e-3)
    assert np.all(info.adaptation.adapting[20:])
    assert np.abs(info.planner[-20:, 0]).max() < 0.01


def test_the_true_cause_lies_within_the_reported_spread():
    """Within three standard deviations in at least 95 % of the steps."""
    truth = np.array([0.5, 0.01])
    inside = []
    for seed in range(3):
        # Numbers of Python like those of the other drives: else a program of its own.
        force, steering = truth.tolist()
        info, _ = drive(seed, force=force, steering=steering, noise=1.0)
        gap = np.abs(info.adaptation.causes[30:, :2] - truth)
        inside.append(gap <= 3.0 * info.adaptation.causes_std[30:, :2] + 1e-3)
    assert np.mean(inside) > 0.95


def test_causes_are_those_of_the_command_that_acted():
    """With 0.2 s of latency, after a start beside the path. Commands that are taken for
    those of another time look like an error of the steering.
    """
    latency = Latency((0.1,), (0.1,)).sized(4, 2)
    delay = latency.loop(PLANT.dt)
    late = plants.late_loop(latency, states=4, dt=PLANT.dt)
    model = with_offset(MODEL)
    prediction = path_following.Prediction(model=model, law=LAW, dt=PLANT.dt)
    predictor = path_following.Predictor(
        inner=law_alone(), prediction=prediction, delay=delay
    )
    inner = predictor.controller()
    options = SETTINGS | {"model": MODEL, "law": LAW, "shrinkage": 0.0}
    inner = path_following.Adaptation(inner=inner, delay=delay, **options).controller()
    horizon = HORIZON + delay.steps
    about = path_following.Prediction(model=MODEL, law=LAW, dt=PLANT.dt)
    gate = path_following.Gate(
        inner=inner, prediction=about, delay=delay, horizon=horizon
    ).controller()
    controller = path_following.along_reference(gate, coordinates=3, delay=delay)
    env = jnp.asarray([0.7, 0.0])

    def step(carry, time):
        state, memory, pending = carry
        state = state.at[0].set(time)
        arrived, pending = late.observe(pending, jnp.append(state, time))
        ahead = 10.0 * 0.1 * (arrived[4] + 1.0 + jnp.arange(horizon))
        zero = jnp.zeros(horizon)
        reference = jnp.stack([ahead, zero, zero, zero + 10.0], axis=1)
        seen = arrived[:4].at[0].set(arrived[4])
        action, memory, info = controller.act({}, memory, seen, env, reference)
        acting, pending = late.actuate(pending, action)
        state = PLANT.step(state, acting.at[0].add(0.01), env)
        return (state, memory, pending), info.adaptation.causes

    start = jnp.asarray([0.0, 0.3, 0.0, 10.0])
    memory = controller.init(jax.random.key(0))
    carry = (start, memory, late.init(jnp.append(start, 0.0)))
    _, causes = jit(lambda c: jax.lax.scan(step, c, jnp.arange(60.0)))(carry)
    steering = np.asarray(causes)[5:, estimator.STEERING]
    # Without `delay` it is wrong by more.
    np.testing.assert_allclose(steering, 0.01, atol=5e-3)


def test_wind_is_estimated_if_it_is_not_measured():
    """A force of 0.5 is a wind of √0.5 of the largest; e is not read."""
    info, _ = drive(force=0.5, estimate_env=True)
    wind = info.adaptation.env[-20:, 1]
    np.testing.assert_allclose(wind, np.sqrt(0.5) * ENV_HIGH[1], atol=0.8)


@pytest.mark.parametrize("fault", ["jump", "freeze", "lose", "overflow"])
def test_a_sensor_fault_is_not_learned_as_a_cause(fault):
    """At the fault the causes move by less than a tenth of what was learned."""
    settings = {"force": 0.5, "steering": 0.01, "noise": 1.0}
    info, belief = drive(fault=fault, **settings)
    assert info.adaptation.rejected[60]
    change = np.abs(np.diff(info.adaptation.causes[58:66, :2], axis=0)).max(axis=0)
    usual = np.abs(np.diff(info.adaptation.causes[30:58, :2], axis=0)).max(axis=0)
    assert np.all(change <= np.maximum(2.0 * usual, [0.05, 0.001]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(belief.bank))


def test_hostile_measurements_leave_finite_bounded_estimates():
    info, belief = drive(fault="hostile", force=0.5, noise=1.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(belief.bank))
    assert np.all(np.abs(info.adaptation.causes) <= estimator.BOUNDS)
    diagonals = np.diagonal(belief.bank.covariances, axis1=-2, axis2=-1)
    assert diagonals.min() >= 0.0
    np.testing.assert_allclose(belief.bank.probabilities.sum(axis=-1), 1.0, atol=1e-4)


def test_causes_that_predict_worse_than_none_are_not_used():
    """The scores of the last seconds decide."""
    info, _ = drive(force=0.5, scores=(2e3, 1e3))
    assert not info.adaptation.adapting[0]
    np.testing.assert_array_equal(info.adaptation.causes[:5], 0.0)
    better, _ = drive(force=0.5, scores=(1e3, 2e3))
    assert better.adaptation.adapting[0]
    assert np.any(better.adaptation.causes[:5])


def test_a_force_that_could_be_noise_is_shrunk():
    """f max(0, 1 - s var f / f²), and no other cause."""
    options = SETTINGS | {"inner": law_alone(), "model": MODEL, "law": LAW}
    adaptation = path_following.Adaptation(**options)
    belief = adaptation.init(jax.random.key(0)).belief
    mean = jnp.asarray([0.0, 0.0, 10.0, 0.4, 0.01, 0.02, 0.03, 0.5])
    for variance, left in ((0.2, 0.4 - 0.3 * 0.2 / 0.4), (0.6, 0.0)):
        bank = belief.bank._replace(
            means=jnp.tile(mean, (2, 1)),
            covariances=jnp.tile(variance * jnp.eye(8), (2, 1, 1)),
        )
        causes = adaptation._estimator.causes(belief._replace(bank=bank), 0.3)
        np.testing.assert_allclose(causes, [left, 0.01, 0.02, 0.03, 0.5], atol=1e-6)


def test_a_force_beyond_the_box_is_balanced_without_a_lateral_error():
    """At the fixed point of the linearised loop with d and its steering, e_y = 0."""
    env, turn = jnp.asarray([0.7, 8.0]), jnp.asarray([0.0, 10.0])
    xi = LAW.turn(turn[0], turn[1], env).state.at[2].set(10.0)
    compensate = jit(partial(_compensation, LOOP))
    offset = compensate({}, env, turn, xi, jnp.asarray(0.3))
    assert abs(float(offset.inputs[0])) > 1e-3
    shifted = with_offset(MODEL)

    @jit
    def settle(inputs):
        fiber = shifted.fiber(offset._replace(inputs=inputs), env)
        plain = MODEL.fiber({}, env)
        w = jnp.concatenate([jnp.zeros(2), turn])

        def both(states, _):
            first = shifted.step(fiber, states[0], w)
            return (first, MODEL.step(plain, states[1], w)), None

        start = without_pose(xi)
        (pushed, alone), _ = jax.lax.scan(both, (start, start), length=300)
        return (pushed - alone)[BODY][0]

    unbalanced = abs(float(settle(jnp.zeros(4))))
    assert abs(float(settle(offset.inputs))) < 0.1 * unbalanced


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"env_low": (0.3, -7.0)}, "wind"),
        ({"dwell": 1.0}, "dwell"),
        ({"model": models.physics(PLANT.step)}, "path coordinates"),
    ],
)
def test_invalid_settings_are_refused_by_name(change, word):
    with pytest.raises(ValueError, match=word):
        adaptive.__wrapped__(**change)
