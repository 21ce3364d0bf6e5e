"""The monitor: its flags, its fallbacks, and that it changes nothing else."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, at, driven, jit, model_and_params, same, straight

from sfkd_jax import certification, control, evaluation, models, plants, scenarios
from sfkd_jax.rollout import fibers_along, step_disturbances
from sfkd_jax.types import Controller, Trajectory

PLANT = plants.kinematic()
BOXES = {
    "state_low": (0.0,),
    "state_high": (30.0,),
    "control_low": PLANT.control_low,
    "control_high": PLANT.control_high,
    "env_low": ENV_LOW,
    "env_high": ENV_HIGH,
}
WIDE, TIGHT = (1e6,) * 4, (1e-4,) * 4
HORIZON = 6
REFERENCE = straight(HORIZON)
KINDS = ("latent", "position", "yaw", "body")
CLEAN = Trajectory(*map(np.asarray, at(driven(), 0)))
"""One drive of the plant; its environment switches at every step."""


def scripted(controls):
    """A controller that plays recorded controls and reports its inputs in the info."""

    def act(params, count, observation, env, reference):
        return (
            jnp.asarray(controls)[count],
            count + 1,
            {"observation": observation, "reference": reference},
        )

    return Controller(lambda key: jnp.zeros((), dtype=int), act)


def changed(drive, field, step, entry, value):
    """A drive with one number in it replaced."""
    values = np.array(getattr(drive, field))
    values[step, entry] = value
    return drive._replace(**{field: values})


def one_by_one(act, state, params, drive, reference=REFERENCE):
    """States and infos of a monitor along a drive, step by step."""
    steps = []
    for observation, env in zip(drive.states[:-1], drive.envs, strict=True):
        _, state, info = act(params, state, observation, env, reference)
        steps.append((state, info))
    return steps


def stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def watch_with(name="oracle", bounds=TIGHT, **settings):
    """(drive, reference) -> infos and states of a monitor of a model, in one scan."""
    model, params = model_and_params(name)

    def watch(drive, reference):
        monitor = control.monitored(
            scripted(drive.controls), model, bounds=bounds, **BOXES | settings
        )

        def step(state, inputs):
            _, state, info = monitor.act(params, state, *inputs, reference)
            return state, (info, state)

        return jax.lax.scan(
            step, monitor.init(jax.random.key(0)), (drive.states[:-1], drive.envs)
        )[1]

    return watch


@cache
def watcher(*names, **settings):
    """The same, compiled."""
    return jit(watch_with(*names, **settings))


def watched(drive, name="oracle", bounds=TIGHT, reference=REFERENCE, **settings):
    """What the monitor reports along a drive, as numpy arrays."""
    info, _ = watcher(name, bounds, **settings)(drive, reference)
    return jax.tree.map(np.asarray, info)


def flagged(steps):
    return list(np.flatnonzero(steps))


# ---- what is measured --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["segment", "nominal"])
def test_along_a_trajectory_the_kinds_are_those_that_bounds_are_calibrated_on(name):
    """With the anchor of the calibration, the start of the trajectory."""
    model, params = model_and_params(name)

    @jit
    def largest(params, drive):
        fibers, later = fibers_along(model, params, drive)
        origin = model.encode(at(fibers, 0), drive.states[0])
        step = jax.vmap(
            partial(step_disturbances, model), in_axes=(0, 0, None, 0, 0, 0)
        )
        return jnp.max(
            step(
                fibers,
                later,
                origin,
                drive.states[:-1],
                drive.controls,
                drive.states[1:],
            ),
            axis=0,
        )

    scores = certification.disturbances(
        model, params, jax.tree.map(lambda leaf: leaf[:1], driven())
    ).scores[0]
    np.testing.assert_allclose(largest(params, CLEAN), scores, rtol=1e-4, atol=2e-6)


def test_a_perfect_model_without_noise_is_never_accused():
    info = watched(CLEAN)
    assert np.all(np.isnan(info["disturbance"][0]))  # nothing to compare with
    np.testing.assert_allclose(info["disturbance"][1:], 0.0, atol=1e-5)
    for name in ("breach", "box_exit", "breaches", "box_exits"):
        assert not np.any(info[name])


def misses(drive):
    """|d| of the nominal bicycle from the definition; its latent is the body state."""
    before, after = (np.float64(part) for part in (drive.states[:-1], drive.states[1:]))
    predicted = np.float64(
        jax.vmap(PLANT.nominal)(*map(jnp.asarray, (before, drive.controls, drive.envs)))
    )
    gap = predicted - after
    body = np.abs(gap[:, 3])
    return np.stack(
        [body, np.hypot(gap[:, 0], gap[:, 1]), np.abs(gap[:, 2]), body], axis=1
    )


@pytest.mark.parametrize("kind", range(4))
def test_a_breach_is_flagged_exactly_where_a_kind_exceeds_its_bound(kind):
    sizes = misses(CLEAN)[:-1]  # the last step is not seen: no observation follows it
    bound = float(np.median(sizes[:, kind])) * 1.001
    info = watched(CLEAN, "nominal", (*WIDE[:kind], bound, *WIDE[kind + 1 :]))
    np.testing.assert_allclose(info["disturbance"][1:], sizes, rtol=1e-2, atol=2e-5)
    expected = 1 + np.flatnonzero(sizes[:, kind] > bound)
    assert 0 < len(expected) < len(sizes)
    assert flagged(info["breach"]) == list(expected)
    np.testing.assert_array_equal(info["breaches"], np.cumsum(info["breach"]))
    assert not np.any(info["box_exit"])


@pytest.mark.parametrize(("shove", "breaches"), [(0.099, []), (0.101, [6])])
def test_a_sideways_shove_is_flagged_at_the_step_that_shows_it_and_only_there(
    shove, breaches
):
    """The car is displaced sideways after step 5; from then on it drives as the model
    predicts.
    """
    states = np.array(CLEAN.states)
    yaw = states[6, 2]
    states[6:, :2] += shove * np.array([-np.sin(yaw), np.cos(yaw)])
    info = watched(CLEAN._replace(states=states), bounds=(0.1,) * 4)
    np.testing.assert_allclose(
        info["disturbance"][6], [0.0, shove, 0.0, 0.0], atol=1e-5
    )
    assert flagged(info["breach"]) == breaches


def test_a_frozen_observation_is_a_breach_at_every_step_while_the_car_moves():
    states = np.array(CLEAN.states)
    states[6:] = states[5]
    info = watched(CLEAN._replace(states=states), bounds=(0.1,) * 4)
    assert flagged(info["breach"]) == list(range(6, len(states) - 1))
    assert not np.any(info["box_exit"])


def test_an_observation_that_jumps_for_one_step_is_a_breach_there_and_on_its_way_back():
    info = watched(
        changed(CLEAN, "states", 6, 0, CLEAN.states[6, 0] + 3.0), bounds=(0.1,) * 4
    )
    assert flagged(info["breach"]) == [6, 7]


@pytest.mark.parametrize("name", ["sfkd", "segment"])
def test_on_a_switch_the_latent_is_transported(name):
    model, params = model_and_params(name)

    @jit
    def by_hand(params, here, there, state, action, after):
        fiber, fiber_next = model.fiber(params, here), model.fiber(params, there)
        start = model.encode(fiber, state)
        stepped = model.step(fiber, start, action)
        after = model.observe(fiber_next, start, after).z
        carried = model.transport(fiber, fiber_next, stepped).z
        return jnp.linalg.norm(after - carried), jnp.linalg.norm(after - stepped.z)

    latent = watched(CLEAN, name)["disturbance"][:, 0]
    for k in (1, 4):
        with_transport, without = by_hand(
            params,
            *CLEAN.envs[k - 1 : k + 1],
            CLEAN.states[k - 1],
            CLEAN.controls[k - 1],
            CLEAN.states[k],
        )
        np.testing.assert_allclose(latent[k], with_transport, rtol=2e-5)
        assert abs(float(with_transport) - float(without)) > 3e-4 * float(
            with_transport
        )


def test_a_prediction_that_is_not_finite_is_a_breach_though_it_exceeds_nothing():
    broken = models.physics(lambda state, action, env: state + jnp.nan)
    monitor = control.monitored(scripted(CLEAN.controls), broken, bounds=WIDE, **BOXES)
    steps = one_by_one(
        monitor.act,
        monitor.init(jax.random.key(0)),
        {},
        jax.tree.map(jnp.asarray, first(3)),
    )
    assert [bool(info["breach"]) for _, info in steps] == [False, True, True]


# ---- boxes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "entry", "value", "when"),
    [
        ("envs", 0, 0.299, [4]),
        ("envs", 1, 8.01, [4]),
        ("states", 3, -0.1, [4]),
        ("states", 3, 30.1, [4]),
        (
            "controls",
            0,
            0.51,
            [5],
        ),  # the control of step 4 is the last one applied at step 5
        ("controls", 1, -6.1, [5]),
        ("envs", 0, 0.9, []),
        ("states", 3, 30.0, []),
        ("controls", 0, -0.5, []),
    ],
)
def test_what_lies_outside_its_box_is_flagged_then_and_only_then(
    field, entry, value, when
):
    info = watched(changed(CLEAN, field, 4, entry, value), bounds=WIDE)
    assert flagged(info["box_exit"]) == when
    np.testing.assert_array_equal(info["box_exits"], np.cumsum(info["box_exit"]))
    assert not np.any(info["breach"])


@pytest.mark.parametrize(("field", "entry"), [("states", 3), ("envs", 1)])
def test_the_first_step_is_checked_as_far_as_it_can_be(field, entry):
    """s_0 and e_0 have boxes; there is no u_{-1}, so the control box does not apply."""
    info = watched(changed(CLEAN, field, 0, entry, 99.0), bounds=WIDE)
    assert flagged(info["box_exit"]) == [0]
    braking = {"control_low": (-0.5, -6.0), "control_high": (0.5, -1.0)}
    assert not watched(
        CLEAN._replace(controls=CLEAN.controls * 0 - 2.0), bounds=WIDE, **braking
    )["box_exit"][0]


def test_a_control_that_is_not_finite_is_a_box_exit_and_no_evidence_of_a_breach():
    info = watched(changed(CLEAN, "controls", 4, 0, np.nan))
    assert flagged(info["box_exit"]) == [5]
    assert flagged(info["breach"]) == []
    assert np.all(np.isnan(info["disturbance"][5]))
    np.testing.assert_allclose(info["disturbance"][6:], 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("field", "entry"), [("states", 0), ("states", 3), ("envs", 0)]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_broken_measurement_is_a_box_exit_and_the_clean_pair_after_it_is_compared_again(
    field, entry, value
):
    broken = changed(CLEAN, field, 4, entry, value)
    info, states = jax.tree.map(np.asarray, watcher()(broken, REFERENCE))
    assert flagged(info["box_exit"]) == [4]
    assert flagged(info["breach"]) == []
    assert flagged(np.isnan(info["disturbance"][:, 0])) == [0, 4, 5]
    np.testing.assert_allclose(info["disturbance"][6:], 0.0, atol=1e-5)
    assert flagged(~states.previous_clean) == [4]
    assert all(
        np.all(np.isfinite(leaf))
        for leaf in (states.observation, states.env, states.control)
    )
    np.testing.assert_array_equal(states.observation[4], CLEAN.states[3])


# ---- fallbacks ---------------------------------------------------------------------------------------------------


def first(steps):
    """The drive's first steps."""
    return Trajectory(
        CLEAN.states[: steps + 1], CLEAN.controls[:steps], CLEAN.envs[:steps]
    )


@pytest.mark.parametrize(
    ("exits", "active"), [([2], [2, 3, 4]), ([2, 4], [2, 3, 4, 5, 6]), ([10], [10, 11])]
)
def test_a_fallback_is_in_force_for_so_many_steps_from_the_last_exit(exits, active):
    drive = CLEAN
    for step in exits:
        drive = changed(drive, "envs", step, 0, 1.5)
    for fallback, expected in (("none", []), ("hold", active), ("slow", active)):
        info = watched(drive, bounds=WIDE, fallback=fallback, release=3)
        assert flagged(info["fallback_active"]) == expected
        assert flagged(info["box_exit"]) == exits
        seen = [
            k
            for k in range(12)
            if np.array_equal(info["observation"][k], drive.states[k])
        ]
        held = expected if fallback == "hold" else []
        assert seen == [k for k in range(12) if k not in held]
        slowed = expected if fallback == "slow" else []
        assert flagged(info["reference"][:, 0, 3] != 10.0) == slowed


def test_a_breach_calls_the_fallback_as_an_exit_does():
    info = watched(CLEAN, "nominal", fallback="slow")
    assert (
        flagged(info["breach"])
        == flagged(info["fallback_active"])
        == list(range(1, 12))
    )


def test_holding_waits_for_a_first_clean_step():
    """Before it there is no plan to continue."""
    drive = changed(changed(CLEAN, "states", 0, 0, np.nan), "envs", 1, 0, 1.5)
    info = watched(drive, bounds=WIDE, fallback="hold", release=3)
    assert flagged(info["box_exit"]) == [0, 1]
    assert flagged(info["fallback_active"]) == [2, 3]


def test_holding_ends_with_the_plan_and_begins_again_once_all_was_well():
    """Otherwise the last control would steer a car that left its box for ever."""
    drive = CLEAN
    for step in (*range(8), 11):
        drive = changed(drive, "envs", step, 0, 1.5)
    info = watched(drive, bounds=WIDE, fallback="hold", release=2)
    assert flagged(info["box_exit"]) == [*range(8), 11]
    held = [
        *range(1, 1 + HORIZON),
        11,
    ]  # from the first step on there is a plan, which ends after step 6
    assert flagged(info["fallback_active"]) == held
    assert flagged(np.isnan(info["observation"][:, 0])) == held
    assert flagged(
        watched(drive, bounds=WIDE, fallback="slow", release=2)["fallback_active"]
    ) == [*range(9), 11]


def planner(samples=8):
    model, _ = model_and_params("oracle")
    limits = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
    law = control.path_feedback(wheelbase=PLANT.wheelbase)
    task = control.path_tracking(
        model, control.tracking_cost(dt=0.1), law, dt=0.1, **limits
    )
    return control.mppi(
        task, num_samples=samples, horizon=HORIZON, env_low=ENV_LOW, env_high=ENV_HIGH
    )


def guarded(fallback="none", **settings):
    model, _ = model_and_params("oracle")
    return control.monitored(
        planner(),
        model,
        **{"bounds": (0.1,) * 4, "fallback": fallback, **BOXES, **settings},
    )


@cache
def compiled(fallback="none"):
    """A monitor of the planner, its act, and the planner's own; no bound forbids
    standing still.
    """
    monitor = guarded(fallback, release=3, bounds=WIDE)
    return monitor, jit(monitor.act), planner_alone()


@cache
def planner_alone():
    return jit(planner().act)


NOW, ENV, OUTSIDE = (
    np.float32([0.0, 0.3, 0.0, 10.0]),
    np.float32([0.7, 3.0]),
    np.float32([1.5, 3.0]),
)


def test_holding_is_the_planners_own_continuation_to_the_bit():
    monitor, act, inner = compiled("hold")
    _, state, info = act({}, monitor.init(jax.random.key(3)), NOW, ENV, REFERENCE)
    assert not bool(info["fallback_active"])
    alone = state.inner
    plan = np.asarray(alone.controls)
    for k in range(3):
        action, state, info = act({}, state, NOW, OUTSIDE if k == 0 else ENV, REFERENCE)
        expected, alone, _ = inner({}, alone, NOW * np.nan, ENV, REFERENCE)
        np.testing.assert_array_equal(action, expected)
        np.testing.assert_array_equal(action, plan[k])
        assert same(state.inner, alone, rtol=0, atol=0)
        assert bool(info["fallback_active"])
        assert not bool(info["healthy"])
    _, state, info = act({}, state, NOW, ENV, REFERENCE)
    assert bool(info["healthy"])
    assert not bool(info["fallback_active"])


def test_a_monitor_that_only_reports_changes_nothing_of_what_is_done():
    monitor, act, inner = compiled()
    state, alone = monitor.init(jax.random.key(3)), planner().init(jax.random.key(3))
    for env in (ENV, OUTSIDE, ENV):
        action, state, info = act({}, state, NOW, env, REFERENCE)
        expected, alone, plain = inner({}, alone, NOW, env, REFERENCE)
        # Two programs, in which the compiler rounds sums differently.
        assert same((action, state.inner), (expected, alone), rtol=0, atol=1e-6)
        assert same({name: info[name] for name in plain}, plain, rtol=0, atol=1e-6)
        assert set(info) - set(plain) == {
            "breach", "box_exit", "breaches", "box_exits", "disturbance", "fallback_active",
        }  # fmt: skip


def circle(radius, *, steps, start):
    """Poses 1 m apart along a circle, yaw in [-π, π], at increasing speeds."""
    angle = start + np.arange(1, steps + 1) / radius
    yaw = (angle + np.pi) % (2 * np.pi) - np.pi
    return np.float32(
        np.stack(
            [
                radius * np.sin(angle),
                -radius * np.cos(angle),
                yaw,
                10.0 + np.arange(steps),
            ],
            axis=1,
        )
    )


def distance_to_polyline(point, corners):
    """Distance of a point in the plane to the nearest segment between consecutive
    corners.
    """
    start, step = corners[:-1], np.diff(corners, axis=0)
    share = np.clip(
        np.sum((point - start) * step, axis=1) / np.sum(step**2, axis=1), 0.0, 1.0
    )
    return np.min(np.linalg.norm(start + share[:, None] * step - point, axis=1))


@pytest.mark.parametrize("factor", [0.7, 0.25, 1.0])
def test_slowed_down_the_reference_lies_on_the_same_path_and_is_driven_at_a_lower_speed(
    factor,
):
    """On a circle through yaw ±π, where arc lengths, speeds and yaws are known."""
    radius, start = 50.0, np.pi - 0.05
    reference = circle(radius, steps=HORIZON, start=start)
    drive = changed(CLEAN, "envs", 2, 0, 1.5)
    settings = {"fallback": "slow", "slow_factor": factor, "release": 1}
    slow = watched(drive, bounds=WIDE, reference=reference, **settings)["reference"][
        2
    ].astype(np.float64)

    here = circle(radius, steps=1, start=start - 1 / radius)[0]
    corners = np.concatenate([here[None, :2], reference[:, :2]])
    assert max(distance_to_polyline(point, corners) for point in slow[:, :2]) < 1e-4
    times = factor * np.arange(1, HORIZON + 1)
    angle = start + times / radius
    sagitta = 1.0 / (8 * radius)
    np.testing.assert_allclose(slow[:, 0], radius * np.sin(angle), atol=1.1 * sagitta)
    np.testing.assert_allclose(slow[:, 1], -radius * np.cos(angle), atol=1.1 * sagitta)
    np.testing.assert_allclose(np.exp(1j * slow[:, 2]), np.exp(1j * angle), atol=1e-5)
    np.testing.assert_allclose(
        slow[:, 3], factor * (10.0 + np.maximum(times - 1, 0.0)), rtol=1e-5
    )


def test_slowed_down_on_a_straight_road_it_is_the_window_of_a_slower_drive():
    drive = changed(CLEAN, "envs", 2, 0, 1.5)
    slow = watched(drive, bounds=WIDE, fallback="slow", release=1)["reference"][2]
    np.testing.assert_allclose(slow, straight(HORIZON, speed=7.0), rtol=1e-6, atol=1e-6)


def test_a_car_outside_its_box_slows_down_on_its_path_and_the_one_inside_does_not():
    """In the ordinary closed loop, at a friction inside the box and at one above it."""
    monitor = guarded("slow")

    @jit
    def episode(friction):
        road = scenarios.Scenario(
            jnp.asarray([0.0, 0.0, 0.0, 10.0]),
            *[jnp.tile(jnp.stack([friction, 0.0]), (40, 1))] * 2,
            scenarios.path_from_curvature(jnp.full(200, 0.01), spacing=0.5),
            jnp.asarray(10.0),
        )
        return evaluation.simulate(
            PLANT.step, monitor, {}, road, jax.random.key(0), dt=0.1, horizon=HORIZON
        )

    inside, outside = (
        jax.tree.map(np.asarray, episode(friction)) for friction in (0.9, 0.95)
    )
    assert np.all(np.abs(inside.states[-10:, 3] - 10.0) < 0.5)
    assert np.all(np.abs(outside.states[-10:, 3] - 7.0) < 0.5)
    assert np.max(np.abs(outside.lateral)) < 0.15


# ---- purity ------------------------------------------------------------------------------------------------------


def test_compiling_does_not_change_it():
    model, _ = model_and_params("nominal")
    monitor = control.monitored(
        scripted(CLEAN.controls), model, bounds=TIGHT, fallback="slow", **BOXES
    )
    drive = jax.tree.map(jnp.asarray, first(3))
    both = [
        one_by_one(act, monitor.init(jax.random.key(0)), {}, drive)
        for act in (jit(monitor.act), monitor.act)
    ]
    assert same(*both, rtol=1e-4, atol=1e-5)
    assert bool(both[0][-1][1]["fallback_active"])


def test_a_batch_of_monitors_is_each_one_alone():
    drives = [changed(at(driven(), k), "envs", 3 + k, 0, 1.5) for k in range(3)]
    setting = ("nominal", (0.05,) * 4)
    batch = jit(jax.vmap(watch_with(*setting, fallback="slow"), in_axes=(0, None)))(
        stacked(drives), REFERENCE
    )
    alone = [watcher(*setting, fallback="slow")(drive, REFERENCE) for drive in drives]
    assert same(batch, stacked(alone), rtol=1e-4, atol=1e-5)
    assert len(set(np.asarray(batch[0]["breaches"])[:, -1])) > 1


def test_it_is_traced_once_while_everything_changes():
    model, _ = model_and_params("oracle")
    traces = []

    def counting(params, *inputs):
        traces.append(1)
        return scripted(CLEAN.controls).act(params, *inputs)

    inner = Controller(scripted(CLEAN.controls).init, counting)
    monitor = control.monitored(inner, model, bounds=TIGHT, fallback="slow", **BOXES)
    one_by_one(
        jit(monitor.act),
        monitor.init(jax.random.key(0)),
        {},
        changed(CLEAN, "envs", 2, 0, np.nan),
    )
    assert len(traces) == 1


def scans(jaxpr):
    """The number of loops in a jaxpr, at any depth."""
    count = 0
    for equation in jaxpr.eqns:
        count += equation.primitive.name in ("scan", "while")
        for value in equation.params.values():
            for part in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(part, "jaxpr", part)
                count += scans(inner) if hasattr(inner, "eqns") else 0
    return count


@pytest.mark.parametrize("fallback", ["none", "hold", "slow"])
def test_the_planner_is_run_once_whatever_the_fallback(fallback):
    """The monitor adds one step of the model, which has a loop over its substeps."""

    def loops(function, *inputs):
        return scans(jax.make_jaxpr(function)(*inputs).jaxpr)

    def acting(controller):
        return loops(
            controller.act, {}, controller.init(jax.random.key(0)), NOW, ENV, REFERENCE
        )

    assert (
        acting(guarded(fallback)) - loops(PLANT.step, NOW, np.zeros(2), ENV)
        == acting(planner())
        > 1
    )


# ---- settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"fallback": "stop"}, "none, hold, slow"),
        ({"bounds": (0.1,) * 3}, "bounds"),
        ({"bounds": (0.1, 0.1, 0.1, np.nan)}, "bounds"),
        ({"bounds": (0.1, 0.1, np.inf, 0.1)}, "bounds"),
        ({"bounds": (0.0, 0.1, 0.1, 0.1)}, "bounds"),
        ({"env_low": (0.3,)}, "env_low"),
        ({"state_low": (31.0,)}, "state_low"),
        ({"control_high": (np.nan, 1.0)}, "control_low"),
        ({"slow_factor": 0.0}, "slow_factor"),
        ({"slow_factor": 1.5}, "slow_factor"),
        ({"release": 0}, "release"),
    ],
)
def test_invalid_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        guarded(**settings)
