"""The contract of every controller: all registered planners, their variants, and all
wrappers. `test_mppi.py` asserts more for `mppi` alone.
"""

from functools import cache, partial
from inspect import signature
from typing import Any, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ENV_HIGH,
    ENV_LOW,
    TINY,
    any_law,
    jit,
    model_and_params,
    path_space,
    same,
    straight,
)
from jaxtyping import jaxtyped

from sfkd_jax import assembly, control, models
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.info import (
    AdaptationInfo,
    Claim,
    ControllerInfo,
    GateInfo,
    LaneInfo,
    PathInfo,
    PlanInfo,
    Reason,
    ShieldInfo,
    first,
    reported,
)
from sfkd_jax.rollout import fold, with_offset

PLANT = plants.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
HORIZON = 5
OFFSET = np.float32([0.0, 0.3, 0.0, 10.0])
ENV = np.float32([0.7, 3.0])
REFERENCE = straight(HORIZON)
BLACKOUTS = {"observation": 1, "infinite": 3, "env": 5, "reference": 7}
"""Steps of the drive with an input that is not finite; the step after each is clean."""
SMALL = {
    "horizon": HORIZON,
    "num_samples": 16,
    "elites": 4,
    "iterations": 2,
    "steps": 4,
}
"""Small values of settings, for the planners that have them."""


def along_path(law, **settings):
    """The task of tracking a path with the kinematic bicycle, and its parameters."""
    model, params = model_and_params("nominal")
    cost = path_following.tracking_cost(dt=PLANT.dt)
    return path_following.path_tracking(
        model, cost, law, dt=PLANT.dt, **LIMITS, **settings
    ), params


def mppi(law, **settings):
    """A tiny planner, and its parameters."""
    task, params = along_path(law)
    return control.mppi(
        task, num_samples=16, horizon=HORIZON, **BOX, **settings
    ), params


def registered(name):
    """A planner as it is registered, with small settings and slew limits."""
    known = signature(assembly.PLANNERS[name]).parameters
    # One that takes no task solves a quadratic program of its own.
    samples = "task" in known
    settings = {
        "name": name,
        "planner": name,
        name: {key: value for key, value in SMALL.items() if key in known},
        "task": {"terminal_weight": 1.0},
    }
    if samples:
        settings |= {"sampling": "feedback"}
        settings["task"] |= {"control_rate": (0.5, 20.0)}
    model, params = model_and_params("nominal" if samples else "koopman_mpc")
    return assembly.build_controller(settings, model, PLANT, **BOX), params


def around_law(model, law):
    """A tiny planner along a path."""
    task = path_following.following_law(
        model, path_following.tracking_cost(dt=PLANT.dt), law, dt=PLANT.dt, **LIMITS
    )
    return control.mppi(
        task, num_samples=16, horizon=HORIZON, noise_std=(0.01, 0.3), **BOX
    )


def path_model():
    """A tiny SFKD in path coordinates and its initial parameters, folded."""
    model = models.sfkd(path_space(), **TINY | {"budget": "joint"}, frame=PATH_FRAME)
    return model, jit(partial(fold, model))(jit(model.init)(jax.random.key(0)))


def along(controller):
    """A controller along a path as one in the world."""
    return path_following.along_reference(controller, coordinates=3)


def shielded():
    """With a filter, in path coordinates."""
    law, (model, params) = any_law(), path_model()
    shield = path_following.Shield(
        inner=around_law(model, law),
        model=model,
        law=law,
        width=0.5,
        tube=0.2,
        horizon=8,
        control=(LIMITS["control_low"], LIMITS["control_high"]),
        conditions=path_following.Conditions(env=(BOX["env_low"], BOX["env_high"])),
    )
    return gated(shield.controller(), model, law, shield.conditions), params


def gated(inner, model, law, conditions):
    """A controller along a path behind the gate, in the world."""
    prediction = path_following.Prediction(
        model=model, law=law, dt=PLANT.dt, conditions=conditions
    )
    gate = path_following.Gate(inner=inner, prediction=prediction, horizon=HORIZON)
    return along(gate.controller())


def adaptive():
    """With estimates of unmeasured causes, in path coordinates."""
    law, (model, params) = any_law(), path_model()
    planner = around_law(with_offset(model), law)
    adaptation = path_following.Adaptation(
        inner=planner,
        model=model,
        law=law,
        sensor_noise=PLANT.sensor_noise,
        model_error=(1e-3, 3e-4, 3e-3),
        **LIMITS,
        **BOX,
    )
    conditions = path_following.Conditions(env=(BOX["env_low"], BOX["env_high"]))
    return gated(adaptation.controller(), model, law, conditions), params


def constrained():
    """With a lane as a constraint."""
    task, params = along_path(FEEDBACK)
    lane = lambda data, state, u, target, at: jnp.abs(state[1:2]) - data
    planned = control.mppi(
        control.constrained(task, lane, 3.0),
        num_samples=16,
        horizon=HORIZON,
        **BOX,
    )
    return planned, params


FEEDBACK = path_following.path_feedback(wheelbase=PLANT.wheelbase)
PLANNERS = {name: partial(registered, name) for name in assembly.PLANNERS}
VARIANTS = {
    "mppi_plain": partial(mppi, path_following.no_feedback(), noise_std=(0.06, 0.6)),
    "mppi_knots": partial(
        mppi,
        FEEDBACK,
        noise="spline",
        noise_knots=3,
        effective_samples=4.0,
        iterations=2,
    ),
    "mppi_constrained": constrained,
}
WRAPPERS = {
    "shielded": shielded,
    "adaptive": adaptive,
}
BUILDERS = PLANNERS | VARIANTS | WRAPPERS
"""Name -> () -> (controller, params), for `HORIZON` steps of the kinematic plant within
`LIMITS`. A planner that is registered in `assembly.PLANNERS` is among them.
"""
DETERMINISTIC = ("gradient", "koopman_mpc")
"""Those whose plan does not depend on the key."""

every = pytest.mark.parametrize("name", BUILDERS)
every_sampling = pytest.mark.parametrize(
    "name", [name for name in BUILDERS if name not in DETERMINISTIC]
)


@cache
def compiled(name):
    """A controller, its parameters, its compiled act, and a list with one entry per
    trace.
    """
    controller, params = BUILDERS[name]()
    traces = []

    def act(*inputs):
        traces.append(1)
        return controller.act(*inputs)

    return controller, params, jit(act), traces


def act_once(name, seed=0):
    controller, params, act, _ = compiled(name)
    return act(params, controller.init(jax.random.key(seed)), OFFSET, ENV, REFERENCE)


@cache
def drive(name):
    """Controls and infos of ten steps, with blackouts, and far off the road at the
    end.
    """
    controller, params, act, _ = compiled(name)
    observations, envs = np.tile(OFFSET, (10, 1)), np.tile(ENV, (10, 1))
    references = np.tile(REFERENCE, (10, 1, 1))
    observations[:, 1] -= 0.05 * np.arange(10)
    observations[BLACKOUTS["observation"]] = np.nan
    observations[BLACKOUTS["infinite"], 2] = np.inf
    envs[BLACKOUTS["env"], 1] = np.nan
    references[BLACKOUTS["reference"], -1, -1] = np.nan
    observations[9] = [50.0, -1e4, 3.0, 90.0]

    state, steps = controller.init(jax.random.key(0)), []
    for inputs in zip(observations, envs, references, strict=True):
        action, state, info = act(params, state, *inputs)
        steps.append((action, info))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *steps)


@every
def test_the_state_keeps_its_structure_shapes_and_types(name):
    controller, params = BUILDERS[name]()
    before = jax.eval_shape(controller.init, jax.random.key(0))
    action, after, _ = jax.eval_shape(
        controller.act, params, before, OFFSET, ENV, REFERENCE
    )
    assert jax.tree.structure(before) == jax.tree.structure(after)
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    assert [
        (a, b)
        for a, b in pairs
        if (a.shape, a.dtype, a.weak_type) != (b.shape, b.dtype, b.weak_type)
    ] == []
    assert (action.shape, action.dtype) == ((2,), jnp.float32)


@every
def test_controls_are_finite_and_within_the_limits_whatever_is_seen(name):
    controls, info = drive(name)
    low, high = np.float32(PLANT.control_low), np.float32(PLANT.control_high)
    assert np.all(np.isfinite(controls))
    assert np.all((low <= controls) & (controls <= high))
    assert info.plan.states.shape == (10, HORIZON, 4)


@every
def test_an_input_that_is_not_finite_is_reported_and_the_next_clean_step_recovers(name):
    _, info = drive(name)
    healthy = np.asarray(info.healthy)[:9]
    unhealthy, blackouts = set(np.flatnonzero(~healthy)), set(BLACKOUTS.values())
    # A filter that steers the car back does not drive the plan either, and a gate does
    # not believe observations that its model does not expect.
    gated = name in ("shielded", "adaptive")
    assert unhealthy >= blackouts if gated else unhealthy == blackouts
    assert np.all(np.isfinite(np.asarray(info.plan.states)[:9][healthy]))


@pytest.mark.parametrize("name", PLANNERS | WRAPPERS)
def test_a_batch_of_controllers_acts_as_each_one_alone(name):
    controller, params, act, _ = compiled(name)
    inputs = [
        (
            controller.init(jax.random.key(k)),
            OFFSET + np.float32(0.1 * k),
            ENV - np.float32(0.1 * k),
        )
        for k in range(3)
    ]
    stack = partial(jax.tree.map, lambda *leaves: jnp.stack(leaves))
    together = jit(jax.vmap(controller.act, in_axes=(None, 0, 0, 0, None)))
    batch = together(params, *stack(*inputs), REFERENCE)
    assert same(
        batch,
        stack(*[act(params, *each, REFERENCE) for each in inputs]),
        # The quadratic program is iterative, and its predictor far from the data.
        **dict.fromkeys(("rtol", "atol"), 1e-3)
        if name == "koopman_mpc"
        else {"rtol": 1e-4, "atol": 1e-5},
    )
    assert len(np.unique(np.asarray(batch[0]), axis=0)) == 3


@every
def test_it_is_traced_once_while_state_observation_environment_reference_and_key_change(
    name,
):
    controller, params, act, traces = compiled(name)
    for seed in range(2):
        state = controller.init(jax.random.key(seed))
        for k in range(3):
            reference = straight(HORIZON, speed=8.0 + k)
            _, state, _ = act(
                params,
                state,
                OFFSET + np.float32(k),
                ENV + np.float32(9 * k),
                reference,
            )
    assert len(traces) == 1


@every_sampling
def test_another_key_makes_another_plan(name):
    first, other = (act_once(name, seed) for seed in (1, 2))
    for entry in ("cost", "states"):
        plans = [getattr(step[2].plan, entry) for step in (first, other)]
        assert not np.array_equal(*plans)
    if name != "shielded":  # its control may be the law's, whatever the plan is
        assert not np.array_equal(first[0], other[0])


PARTS = {
    "plan": PlanInfo,
    "claim": Claim,
    "path": PathInfo,
    "gate": GateInfo,
    "adaptation": AdaptationInfo,
    "shield": ShieldInfo,
    "lane": LaneInfo,
}


@jaxtyped(typechecker=None)
def undocumented(info):
    """Entries of a part of an info whose shapes are not the documented ones."""
    return {
        (name, entry): np.shape(value)
        for name, part in PARTS.items()
        if (values := getattr(info, name)) is not None
        for entry, value in values._asdict().items()
        if (hint := get_type_hints(part)[entry]) is not Any
        and not isinstance(value, hint | None)
    }


@every
def test_info_has_the_documented_entries_with_the_documented_shapes(name):
    _, _, info = act_once(name)
    assert isinstance(info, ControllerInfo)
    assert undocumented(info) == {}
    assert Reason(int(info.claim.reason)) in Reason


def test_every_part_is_given_by_a_planner_or_a_wrapper():
    given = set()
    for name in BUILDERS:
        info = act_once(name)[2]
        given |= {part for part in PARTS if getattr(info, part) is not None}
    assert given == set(PARTS) - {"lane"}  # of `InLane`, see test_lanes.py


def test_every_reason_has_advice_and_the_first_one_is_reported():
    assert all(reason.advice.endswith(".") for reason in Reason)
    late, wild = jnp.asarray(True), jnp.asarray(False)
    reason = first(Reason.CERTIFIED, (wild, Reason.ALARM), (late, Reason.TRIAL))
    assert int(reason) == Reason.TRIAL
    assert int(first(reason, (late, Reason.ALARM))) == Reason.TRIAL
    claim = Claim(bound=jnp.asarray(0.1), reason=jnp.asarray(Reason.CERTIFIED))
    assert bool(claim.holds)
    assert not bool(claim.under(reason).holds)
    assert int(claim.under(reason).reason) == Reason.TRIAL
    assert int(claim.unless(wild, Reason.EVADING).reason) == Reason.CERTIFIED


@pytest.mark.parametrize("reason", Reason)
def test_a_controller_is_healthy_where_nothing_speaks_against_its_plan(reason):
    usual = (Reason.CERTIFIED, Reason.NO_CERTIFICATE, Reason.NOT_CALIBRATED)
    info = ControllerInfo(claim=Claim(reason=jnp.asarray(reason)))
    assert bool(info.healthy) == (reason in usual)
    assert not bool(info._replace(plan=PlanInfo(healthy=jnp.asarray(False))).healthy)


@pytest.mark.parametrize(
    ("told", "healthy"),
    [(None, True), ({}, True), ({"healthy": False}, False), (("x", 1.0), True)],
)
def test_what_a_controller_from_outside_reports_becomes_a_part(told, healthy):
    info = reported(told)
    assert info.planner is told
    assert bool(info.healthy) == healthy
    assert reported(info) is info
