"""The shield of a system: it passes what is harmless, and keeps the nominal model."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, same
from loops import DT, FASTEST, LIMIT, exact_model, frame, loop, mass, pushed

from sfkd_jax.control import NominalState
from sfkd_jax.geometry import without_pose
from sfkd_jax.info import ControllerInfo, PlanInfo, Reason
from sfkd_jax.systems import ClosedLoop, OutputBound, Shield, Tracked
from sfkd_jax.types import Controller

STEPS = 300
NOMINAL = 0.06
TUBE = 0.03
BOUND = OutputBound(tube=TUBE, nominal=NOMINAL)
ENV = jnp.asarray([1.0, 0.0])
AT_REST = jnp.zeros((20, 1))
NAN = jnp.nan


def planner(control_of, healthy=True):
    """A planner of the tests: (step, ξ, e, ρ) -> u."""

    def act(params, state, error, env, inputs):
        control = control_of(state, error, env, inputs)
        info = ControllerInfo(plan=PlanInfo(healthy=jnp.asarray(healthy)))
        return control, state + 1, info

    return Controller(lambda key: jnp.zeros((), int), act)


def law_and(nu_of):
    """A planner that adds ν to the law."""

    def control_of(step, error, env, inputs):
        return loop().law.at(inputs[0], env).feedback(error) + nu_of(step)

    return planner(control_of)


def shield(inner, **changed):
    box = ((-1.0, -1.0), (1.0, 1.0))
    arguments = {
        "loop": loop(),
        "model": exact_model(loop()),
        "bounds": {"position": BOUND},
        "box": box,
        **changed,
    }
    return Shield(inner=inner, **arguments)


@cache
def references(seed=1):
    """ρ of a run, and e."""
    switches = jax.random.split(jax.random.key(seed), 2)
    low = jnp.asarray([-FASTEST, 0.8, -0.5])
    high = jnp.asarray([FASTEST, 1.2, 0.5])
    drawn = jax.random.uniform(
        switches[0], (STEPS // 10 + 1, 3), minval=low, maxval=high
    )
    held = jnp.repeat(drawn, 10, axis=0)
    return held[: STEPS + 20, :1], held[:STEPS, 1:]


def driven(of, step, *, start=(0.0, 0.0), steps=STEPS, spoil=None):
    """A run of the shield in closed loop: ξ, u and what it reports.

    Args:
        spoil: (time, ξ, e, ρ) -> what the shield is given of them.
    """
    inputs, envs = references()

    def body(carry, time):
        error, state = carry
        ahead = jax.lax.dynamic_slice_in_dim(inputs, time, 20)
        env = envs[time]
        given = (error, env, ahead)
        if spoil is not None:
            given = spoil(time, *given)
        control, state, info = of.act({}, state, *given)
        x = jnp.clip(control, -LIMIT, LIMIT)
        after = step(error, x, ahead[0], env)
        started = state.nominal.started
        nominal = of.model.decode(None, state.nominal.latent)[3:]
        return (after, state), (error, control, info, nominal, started)

    first = (jnp.asarray(start), of.init(jax.random.key(0)))
    run = jax.jit(lambda: jax.lax.scan(body, first, jnp.arange(steps))[1])
    return jax.tree.map(np.asarray, run())


def truth(error, control, inputs, env):
    """The mass, as the model has it."""
    return loop().tracked.step(error, control, inputs, env)


HOSTILE = {
    "nan": planner(lambda step, *_: jnp.full(1, jnp.nan)),
    "infinite": planner(lambda step, *_: jnp.full(1, jnp.inf)),
    "huge": planner(lambda step, *_: jnp.full(1, 1e30)),
    "limit": planner(lambda step, *_: jnp.full(1, LIMIT)),
    "push": law_and(lambda step: jnp.full(1, 0.2)),
    "switching": law_and(lambda step: jnp.where(step // 7 % 2, 0.2, -0.2)[None]),
    "now and then": planner(
        lambda step, *_: jnp.where(step % 3, LIMIT, jnp.nan)[None] * (-1) ** (step // 5)
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_no_planner_drives_the_nominal_model_out_of_its_bound(name):
    errors, controls, info, nominal, started = driven(shield(HOSTILE[name]), truth)
    assert np.all(np.isfinite(controls))
    assert np.abs(controls).max() <= LIMIT
    assert np.abs(nominal[started, 0]).max() <= NOMINAL + 1e-5
    claimed = info.claim.bound[:, 0]
    held = np.isfinite(claimed)
    np.testing.assert_array_equal(held, info.claim.reason == Reason.CERTIFIED)
    assert held[1:].all()
    assert np.all(np.abs(errors[held, 0]) <= claimed[held])
    np.testing.assert_allclose(claimed[held], NOMINAL + TUBE, rtol=1e-6)
    # The system is the model, so that the distance is rounding.
    assert np.nanmax(info.shield.nominal_distance) < 1e-4


def test_the_planner_is_held_back_only_by_as_much_as_is_needed():
    """A push that the law could not undo in time would leave the bound."""
    _, _, info, nominal, _ = driven(shield(HOSTILE["push"]), truth)
    assert np.abs(nominal[:, 0]).max() > 0.5 * NOMINAL
    wide = shield(HOSTILE["push"], bounds={"position": OutputBound(TUBE, 1.0)})
    _, _, free, _, _ = driven(wide, truth)
    assert np.all(free.shield.intervention == 0.0)
    assert np.all(info.shield.margin >= 0.0)


def test_a_harmless_request_passes_bit_for_bit():
    nu = [0.01 * np.sin(0.7 * i) for i in range(40)]
    inner = law_and(lambda step: jnp.asarray(nu)[step][None])
    of = shield(inner)
    act = jax.jit(of.act)
    plan = jax.jit(inner.act)
    state = of.init(jax.random.key(0))
    error = jnp.asarray([0.01, 0.02])
    for step in range(40):
        wanted, _, _ = plan({}, jnp.asarray(step), error, ENV, AT_REST)
        control, state, info = act({}, state, error, ENV, AT_REST)
        assert np.asarray(control).tobytes() == np.asarray(wanted).tobytes()
        assert float(info.shield.intervention) == 0.0
        assert info.claim.reason == Reason.CERTIFIED
        error = truth(error, control, AT_REST[0], ENV)


def test_a_control_beyond_the_limits_never_passes():
    """Where the law itself is at its limit, a huge control differs little from it."""
    of = shield(planner(lambda *_: jnp.full(1, 1e30)))
    error = jnp.asarray([-0.9, -0.9])
    control, state, _ = of.act({}, of.init(jax.random.key(0)), error, ENV, AT_REST)
    assert np.abs(control).max() <= LIMIT
    assert np.all(np.isfinite(state.nominal.latent))


def test_nothing_is_claimed_while_the_nominal_model_is_outside_its_bound():
    """It is on its way back, and inside one step later."""
    of = shield(law_and(lambda step: jnp.zeros(1)))
    for x, reason in ((0.075, Reason.INFEASIBLE), (0.055, Reason.CERTIFIED)):
        error = jnp.asarray([x, -0.3])
        running = NominalState(without_pose(error), jnp.asarray(True), ENV)
        state = of.init(jax.random.key(0))._replace(nominal=running)
        _, _, info = jax.jit(of.act)({}, state, error, ENV, AT_REST)
        assert float(info.shield.margin) > 0.0
        assert info.claim.reason == reason
        assert np.all(np.isnan(info.claim.bound)) == (reason != Reason.CERTIFIED)


def test_it_comes_back_from_far_away():
    of = shield(HOSTILE["switching"])
    errors, _, info, _, _ = driven(of, truth, start=(-0.9, -0.9), steps=60)
    held = np.isfinite(info.claim.bound[:, 0])
    assert not held[0]
    assert held[-10:].all()
    assert np.all(np.abs(errors[held, 0]) <= NOMINAL + TUBE)
    assert set(info.claim.reason[~held]) <= {Reason.INFEASIBLE, Reason.OUTSIDE_BOX}


SPOILT = {
    "state": (lambda t, x, e, r: (x * NAN, e, r), Reason.NOT_MEASURED),
    "a state": (lambda t, x, e, r: (x.at[1].set(NAN), e, r), Reason.NOT_MEASURED),
    "environment": (
        lambda t, x, e, r: (x, e.at[0].set(NAN), r),
        Reason.BAD_ENVIRONMENT,
    ),
    "infinite": (
        lambda t, x, e, r: (x, e.at[1].set(jnp.inf), r),
        Reason.BAD_ENVIRONMENT,
    ),
    "reference": (lambda t, x, e, r: (x, e, r * NAN), Reason.BAD_REFERENCE),
    "preview": (lambda t, x, e, r: (x, e, r.at[7].set(NAN)), Reason.BAD_REFERENCE),
    "box of e": (lambda t, x, e, r: (x, e.at[0].set(3.0), r), Reason.OUTSIDE_BOX),
    "box of state": (lambda t, x, e, r: (x + 5.0, e, r), Reason.OUTSIDE_BOX),
    "box of reference": (lambda t, x, e, r: (x, e, r + 9.0), Reason.OUTSIDE_BOX),
}


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("first", [0, 30])
def test_what_is_spoilt_is_said_and_nothing_is_claimed(name, first):
    change, reason = SPOILT[name]
    last = first + 6

    def spoil(time, *given):
        spoilt = change(time, *given)
        now = (time >= first) & (time < last)
        return jax.tree.map(partial(jnp.where, now), spoilt, given)

    of = shield(law_and(lambda step: 0.05 * jnp.sin(0.9 * step)[None]))
    errors, controls, info, _, _ = driven(of, truth, steps=90, spoil=spoil)
    assert np.all(np.isfinite(controls))
    claims = info.claim.bound[:, 0]
    assert np.all(np.isnan(claims[first:last]))
    assert np.all(info.claim.reason[first:last] == reason)
    held = np.isfinite(claims)
    assert held[last + 30 :].all()
    assert held[:first].all()
    assert np.all(np.abs(errors[held, 0]) <= claims[held])


@pytest.mark.parametrize(("sigmas", "outside"), [(3.0, False), (6.0, True)])
def test_a_reading_may_leave_the_box_of_true_states_by_its_noise(sigmas, outside):
    noise = np.asarray(loop().tracked.system.sensor_noise)
    of = shield(law_and(lambda step: jnp.zeros(1)), box=((-1.0, -1.0), (0.01, 1.0)))
    error = jnp.asarray([0.01 + sigmas * noise[0], 0.0])
    _, _, info = of.act({}, of.init(jax.random.key(0)), error, ENV, AT_REST)
    assert (info.claim.reason == Reason.OUTSIDE_BOX) == outside


def test_another_system_than_the_model_is_noticed_and_nothing_false_is_claimed():
    def heavier(error, control, inputs, env):
        return truth(error, control, inputs, env * jnp.asarray([1.6, 1.0]) + 0.3)

    errors, controls, info, _, _ = driven(shield(HOSTILE["switching"]), heavier)
    reasons = info.claim.reason
    assert (reasons == Reason.BOUND_EXCEEDED).any()
    held = np.isfinite(info.claim.bound[:, 0])
    assert np.all(np.abs(errors[held, 0]) <= info.claim.bound[held, 0] + 0.01)
    assert np.all(np.isnan(info.claim.bound[reasons == Reason.BOUND_EXCEEDED]))
    assert np.all(np.isfinite(controls))


def test_an_unhealthy_planner_gives_way_to_the_law():
    of = shield(planner(lambda *_: jnp.full(1, 0.1), healthy=False))
    error = jnp.asarray([0.01, 0.0])
    control, _, info = of.act({}, of.init(jax.random.key(0)), error, ENV, AT_REST)
    expected = loop().law.at(AT_REST[0], ENV).feedback(error)
    np.testing.assert_allclose(control, expected, atol=1e-6)
    assert not bool(info.plan.healthy)


def test_it_is_the_same_under_jit_and_vmap():
    of = shield(HOSTILE["switching"])
    start = of.init(jax.random.key(0))
    errors = jnp.asarray([[0.01, 0.0], [0.05, 0.1], [NAN, 0.0], [3.0, 0.0]])
    many = jax.jit(jax.vmap(of.act, in_axes=(None, None, 0, None, None)))
    results = many({}, start, errors, ENV, AT_REST)
    act = jax.jit(of.act)
    for index, error in enumerate(errors):
        one = act({}, start, error, ENV, AT_REST)
        assert same(at(results, index), one, atol=1e-5)


def test_a_shield_of_two_outputs_keeps_both():
    of = ClosedLoop(
        Tracked(mass(), frame(outputs={"position": ("x",), "velocity": ("v",)})),
        loop().law,
    )
    bounds = {"position": OutputBound(TUBE, 0.05), "velocity": OutputBound(TUBE, 0.04)}
    box = ((-1.0, -1.0), (1.0, 1.0))
    guard = Shield(
        inner=HOSTILE["switching"],
        loop=of,
        model=exact_model(of),
        bounds=bounds,
        box=box,
    )
    _, _, info, nominal, _ = driven(guard, truth)
    assert np.abs(nominal[:, 0]).max() <= 0.05 + 1e-5
    assert np.abs(nominal[:, 1]).max() <= 0.04 + 1e-5
    assert np.abs(nominal[:, 1]).max() > 0.035
    assert info.claim.bound.shape == (STEPS, 2)


def test_a_truth_is_that_of_the_mass():
    error = jnp.asarray([0.1, 0.2])
    after = truth(error, jnp.asarray([1.0]), jnp.asarray([0.3]), ENV)
    expected = pushed(error, jnp.asarray([1.0]), ENV)
    expected = expected - jnp.asarray([0.5 * 0.3 * DT**2, 0.3 * DT])
    np.testing.assert_allclose(after, expected, atol=1e-6)
