"""All planners: any task, temperature and limits, several environments and devices."""

import os
import subprocess
import sys
import textwrap
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, same

from sfkd_jax import control

DT, HORIZON = 0.1, 12
A = np.float32([[1.0, DT], [0.0, 1.0]])
B = np.float32([[0.0], [DT]])
Q, R = np.float32([1.0, 0.1]), 0.05
START = jnp.asarray([1.0, 0.0])
NOTHING = jnp.zeros(1)
BOUNDS = {"control_low": (-50.0,), "control_high": (50.0,)}


def dynamics(params, state, action, env):
    return A @ state + B @ action + env


def stage(weights, state, action, before, goal):
    return weights["state"] * jnp.sum(jnp.asarray(Q) * state**2) + weights[
        "effort"
    ] * R * jnp.sum(action**2)


def double_integrator(**settings):
    options = {"dt": DT, "weights": {"state": 1.0, "effort": 1.0}, **BOUNDS, **settings}
    return control.free_task(dynamics, stage, **options)


SEARCHES = {
    "mppi": partial(
        control.mppi,
        num_samples=400,
        effective_samples=20.0,
        noise="white",
        adapt=0.5,
        iterations=2,
    ),
    "cem": partial(
        control.cem, num_samples=400, elites=40, iterations=3, noise="white"
    ),
    "gradient": control.gradient_planner,
}
every = pytest.mark.parametrize("search", SEARCHES)


def plan_for(search, task=None, steps=12, start=START, env=NOTHING, **settings):
    """Plan repeatedly from the same state: the plan to which the search converges."""
    task = task or double_integrator()
    controller = SEARCHES[search](task, horizon=HORIZON, noise_std=(2.0,), **settings)

    @jit
    def run(key):
        def again(state, _):
            held = state._replace(tuning=state.tuning._replace(elapsed=jnp.zeros(())))
            action, state, info = controller.act({}, held, start, env, ())
            return state, (action, info)

        state, (actions, info) = jax.lax.scan(
            again, controller.init(key), None, length=steps
        )
        return state, actions[-1], jax.tree.map(lambda leaf: leaf[-1], info)

    return run(jax.random.key(0))


def optimal():
    """Optimal cost and controls of the linear-quadratic problem, by a Riccati recursion
    in float64.
    """
    a, b, q = A.astype(float), B.astype(float), np.diag(Q).astype(float)
    value, gains = np.zeros((2, 2)), []
    for _ in range(HORIZON):
        total = q + value
        gain = np.linalg.solve(R * np.eye(1) + b.T @ total @ b, b.T @ total @ a)
        closed = a - b @ gain
        value = closed.T @ total @ closed + R * gain.T @ gain
        gains.append(gain)
    state, plan = np.array(START, dtype=float), []
    for gain in reversed(gains):
        plan.append(-gain @ state)
        state = a @ state + b @ plan[-1]
    start = np.array(START, dtype=float)
    return float(start @ value @ start), np.array(plan)


@every
def test_on_a_linear_quadratic_problem_the_cost_is_within_two_percent_of_the_optimum(
    search,
):
    least, _ = optimal()
    _, _, info = plan_for(search)
    assert least <= float(info["mean_cost"]) * (1 + 1e-5)
    assert float(info["mean_cost"]) <= 1.02 * least


def test_the_gradient_planner_never_goes_up_and_ends_at_the_optimal_plan():
    costs = [
        float(plan_for("gradient", steps=steps, iterations=1)[2]["mean_cost"])
        for steps in (1, 2, 4, 8, 16)
    ]
    assert all(after <= before * (1 + 1e-6) for before, after in pairwise(costs))
    state, _, _ = plan_for("gradient", steps=60)
    np.testing.assert_allclose(state.plan, optimal()[1], atol=0.05)


@every
@pytest.mark.parametrize("elapsed", [0.5, 1.0, 2.0, 2.75])
def test_a_call_that_comes_late_continues_the_plan_from_where_it_would_be_by_then(
    search, elapsed
):
    """The observation of that call is NaN, so its control is the plan's; the stored
    plan is one period old.
    """
    controller = SEARCHES[search](
        double_integrator(), horizon=HORIZON, noise_std=(2.0,)
    )
    plan, state = (
        0.1 * jnp.arange(HORIZON, dtype=float)[:, None],
        controller.init(jax.random.key(0)),
    )
    tuning = state.tuning._replace(elapsed=jnp.asarray(elapsed))
    state = state._replace(plan=plan, controls=plan, tuning=tuning)
    action, after, info = jit(controller.act)({}, state, START * jnp.nan, NOTHING, ())
    assert not bool(info["healthy"])
    late = max(elapsed - 1.0, 0.0)
    np.testing.assert_allclose(action, 0.1 * late, atol=1e-6)
    np.testing.assert_allclose(
        after.controls[0], 0.1 * (late + min(elapsed, 1.0)), atol=1e-6
    )


@every
def test_a_clock_that_tells_no_number_counts_as_a_call_in_time(search):
    """Otherwise the plan and all later controls would be NaN."""
    controller = SEARCHES[search](
        double_integrator(), horizon=HORIZON, noise_std=(2.0,)
    )
    act, seen = jit(controller.act), []
    for elapsed in (jnp.nan, 1.0):
        state = controller.init(jax.random.key(0))
        for clock in (1.0, elapsed, 1.0):
            state = state._replace(
                tuning=state.tuning._replace(elapsed=jnp.asarray(clock))
            )
            action, state, info = act({}, state, START, NOTHING, ())
            assert bool(info["healthy"])
        seen.append((action, state.plan))
    assert same(*seen, rtol=0, atol=0)


@every
def test_everything_a_driver_may_turn_is_data_and_compiles_nothing(search):
    traces = []

    def counted(params, state, action, env):
        traces.append(1)
        return dynamics(params, state, action, env)

    task = control.free_task(
        counted, stage, dt=DT, weights={"state": 1.0, "effort": 1.0}, **BOUNDS
    )
    controller = SEARCHES[search](
        task, horizon=HORIZON, noise_std=(2.0,), num_proposals=1
    )
    act, state = jit(controller.act), controller.init(jax.random.key(0))
    plans, seen = [], None
    for k in range(1, 4):
        tuning = state.tuning._replace(
            temperature=jnp.asarray(1.0 * k),
            effective_samples=jnp.asarray(10.0 * k),
            noise_std=jnp.full(1, 1.0 * k),
            elapsed=jnp.asarray(0.5 * k),
            cost={"state": jnp.asarray(1.0 * k), "effort": jnp.asarray(1.0 / k)},
        )
        state = state._replace(
            tuning=tuning, proposals=jnp.full((1, HORIZON, 1), -1.0 * k)
        )
        _, state, _ = act({}, state, START * k, NOTHING, ())
        plans.append(np.asarray(state.plan))
        seen = seen or len(traces)
    assert len(traces) == seen
    assert not np.allclose(plans[0], plans[1])


@every
def test_a_dearer_control_is_used_less(search):
    used = []
    for effort in (1.0, 30.0):
        task = double_integrator(weights={"state": 1.0, "effort": effort})
        used.append(float(jnp.sum(plan_for(search, task)[0].plan ** 2)))
    assert used[1] < 0.5 * used[0]


@every
def test_a_proposal_that_is_best_is_found_at_once(search):
    _, plan = optimal()
    controller = SEARCHES[search](
        double_integrator(), horizon=HORIZON, noise_std=(1e-6,), num_proposals=1
    )
    state = controller.init(jax.random.key(0))
    proposed = state._replace(proposals=jnp.asarray(plan[None], dtype=jnp.float32))
    if search != "gradient":  # plans are averaged: let the best one alone count
        proposed = proposed._replace(
            tuning=proposed.tuning._replace(effective_samples=jnp.ones(()))
        )
    _, _, info = jit(controller.act)({}, proposed, START, NOTHING, ())
    least, _ = optimal()
    np.testing.assert_allclose(info["cost"], least, rtol=1e-4)


@every
@pytest.mark.parametrize("window", [0, 5])
def test_limits_hold_exactly_from_the_measured_actuator_on(search, window):
    """The second entry of the state stands for the actuator position."""
    low, high, rate = (-1.0,), (0.8,), (3.0,)
    limits = {"control_low": low, "control_high": high, "control_rate": rate}
    task = double_integrator(**limits, actuator=lambda state: 0.1 * state[1:])
    start = jnp.asarray([4.0, 5.0])  # the actuator stands at 0.5
    state, action, _ = plan_for(
        search, task, steps=2, start=start, smoothing_window=window
    )
    controls = np.concatenate(
        [[[0.5]], np.asarray(action)[None], np.asarray(state.controls)[1:]]
    )
    assert np.all((np.float32(low) <= controls) & (controls <= np.float32(high)))
    assert np.all(np.abs(np.diff(controls, axis=0)) <= np.float32(rate[0] * DT) + 1e-6)
    if search == "gradient":  # the others are averages
        np.testing.assert_allclose(
            action, 0.5 - 0.3, atol=1e-6
        )  # as fast as it may: the state is far off


@every
def test_all_bad_rollouts_but_one_still_give_a_finite_plan_and_none_keeps_the_last(
    search,
):
    def breaking(params, state, action, env):
        return jnp.where(
            env[0] + action[0] ** 2 > 1e-8,
            jnp.nan,
            dynamics(params, state, action, jnp.zeros(2)),
        )

    task = control.free_task(
        breaking, stage, dt=DT, weights={"state": 1.0, "effort": 1.0}, **BOUNDS
    )
    settings = (
        {}
        if search == "gradient"
        else {"num_samples": 64} | ({"elites": 8} if search == "cem" else {})
    )
    controller = SEARCHES[search](task, horizon=HORIZON, noise_std=(2.0,), **settings)
    act, state = jit(controller.act), controller.init(jax.random.key(0))
    action, state, info = act(
        {}, state, START, NOTHING, ()
    )  # only the plan of zeros survives
    assert bool(info["healthy"])
    np.testing.assert_array_equal(action, 0.0)
    action, state, info = act({}, state, START, jnp.ones(1), ())  # and now nothing does
    assert not bool(info["healthy"])
    assert np.all(np.isfinite(action))
    assert np.all(np.isfinite(state.plan))


@pytest.mark.parametrize("chunk", [1, 7, 64, 1000])
def test_samples_rolled_out_in_chunks_make_the_same_plan(chunk):
    whole, _, _ = plan_for("mppi", steps=2, num_samples=64)
    parts, _, _ = plan_for("mppi", steps=2, num_samples=64, chunk=chunk)
    np.testing.assert_allclose(parts.plan, whole.plan, rtol=1e-4, atol=1e-5)


def test_the_control_cost_pulls_the_plan_to_nothing():
    free, _, _ = plan_for("mppi", control_cost=0.0)
    charged, _, _ = plan_for("mppi", control_cost=5.0)
    assert float(jnp.sum(charged.plan**2)) < 0.7 * float(jnp.sum(free.plan**2))


def test_adapted_noise_finds_the_optimum_more_closely():
    fixed, adapted = (
        plan_for("mppi", steps=20, adapt=adapt)[2]["mean_cost"] for adapt in (0.0, 1.0)
    )
    least, _ = optimal()
    assert float(adapted) - least < 0.7 * (float(fixed) - least)


# ---- several environments ------------------------------------------------------------------------------------------


def test_risk_is_of_whole_trajectories():
    costs = jnp.asarray([[1.0, 4.0], [2.0, 0.0], [6.0, 2.0]])
    np.testing.assert_allclose(control.risk_measure("mean", 1.0)(costs), [3.0, 2.0])
    np.testing.assert_allclose(control.risk_measure("worst", 1.0)(costs), [6.0, 4.0])
    np.testing.assert_allclose(control.risk_measure("cvar", 0.5)(costs), [4.0, 3.0])
    np.testing.assert_allclose(
        control.risk_measure("cvar", 1.0)(costs),
        control.risk_measure("mean", 1.0)(costs),
    )
    np.testing.assert_allclose(
        control.risk_measure("cvar", 0.01)(costs),
        control.risk_measure("worst", 1.0)(costs),
    )


@pytest.mark.parametrize("risk", ["mean", "worst", "cvar"])
def test_environments_that_are_all_the_same_count_as_one(risk):
    push = jnp.asarray([0.02, 0.0])
    one, _, info = plan_for("mppi", steps=2, env=push)
    several, _, same = plan_for("mppi", steps=2, env=jnp.tile(push, (3, 1)), risk=risk)
    np.testing.assert_allclose(several.plan, one.plan, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(same["mean_cost"], info["mean_cost"], rtol=1e-4)


def test_the_worst_case_is_cheaper_for_a_plan_that_was_made_for_it():
    """Pushes from both sides, one three times as strong as the other."""
    envs = jnp.asarray([[0.03, 0.0], [-0.09, 0.0]])
    costs = {}
    for risk in ("mean", "worst"):
        state, _, _ = plan_for("gradient", steps=40, env=envs, risk=risk)
        judge = control.mppi(
            double_integrator(),
            horizon=HORIZON,
            num_samples=1,
            noise_std=(1.0,),
            risk="worst",
        )
        held = judge.init(jax.random.key(0))._replace(plan=state.plan)
        costs[risk] = float(jit(judge.act)({}, held, START, envs, ())[2]["mean_cost"])
    assert costs["worst"] < 0.97 * costs["mean"]


# ---- time ----------------------------------------------------------------------------------------------------------


def test_a_plan_is_shifted_by_the_time_that_has_passed():
    from sfkd_jax.control.planners._plans import shift

    plan = jnp.asarray([[0.0], [2.0], [4.0], [8.0]])
    for elapsed, expected in (
        (0.0, [0, 2, 4, 8]),
        (1.0, [2, 4, 8, 8]),
        (0.5, [1, 3, 6, 8]),
        (9.0, [8, 8, 8, 8]),
    ):
        np.testing.assert_array_equal(shift(plan, jnp.asarray(elapsed))[:, 0], expected)
    np.testing.assert_array_equal(
        shift(jnp.asarray([[3.0]]), jnp.asarray(1.0)), [[3.0]]
    )


# ---- devices -------------------------------------------------------------------------------------------------------

PROGRAM = """
    import jax, jax.numpy as jnp, numpy as np
    from sfkd_jax import control
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("sample",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(None, "sample", None))
    A, B = jnp.asarray([[1.0, 0.1], [0.0, 1.0]]), jnp.asarray([[0.0], [0.1]])
    task = control.free_task(
        lambda p, x, u, e: A @ x + B @ u, lambda w, x, u, b, g: jnp.sum(x**2),
        control_low=(-9.0,), control_high=(9.0,),
    )
    settings = {"num_samples": 64, "noise_std": (2.0,), "effective_samples": 8.0}
    plans = []
    for curvature in (False, True):
        controller = control.mppi(task, horizon=12, sharding=spread, curvature=curvature, **settings)
        _, state, _ = jax.jit(controller.act)({}, controller.init(jax.random.key(0)), jnp.ones(2), jnp.zeros(1), ())
        plans += np.asarray(state.plan).ravel().tolist()
    print(len(jax.devices()), *plans)
"""


def planned_on(devices):
    flags = {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    }
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    done = subprocess.run(
        command, env=os.environ | flags, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    count, *plan = done.stdout.split()
    assert int(count) == devices
    return np.array(plan, dtype=float)


def test_the_same_plan_comes_out_on_one_two_and_eight_devices():
    one = planned_on(1)
    for devices in (2, 8):
        np.testing.assert_allclose(planned_on(devices), one, rtol=1e-5, atol=1e-5)


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("search", "settings", "words"),
    [
        ("mppi", {"effective_samples": 401.0}, "effective_samples"),
        ("mppi", {"num_samples": 0}, "num_samples"),
        ("mppi", {"adapt": 2.0}, "adapt"),
        ("mppi", {"noise": "pink"}, "noise must be one of"),
        ("mppi", {"noise": "rbf", "noise_knots": 1}, "noise_knots"),
        ("mppi", {"noise_std": (1.0, 1.0)}, "noise_std"),
        ("mppi", {"risk": "best"}, "risk must be one of"),
        ("mppi", {"risk_level": 0.0}, "risk_level"),
        ("cem", {"elites": 1000}, "elites"),
        ("gradient", {"shrink": 1.0}, "shrink"),
    ],
)
def test_invalid_settings_are_refused_by_name(search, settings, words):
    with pytest.raises(ValueError, match=words):
        SEARCHES[search](
            double_integrator(), horizon=HORIZON, **{"noise_std": (1.0,), **settings}
        )


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"control_low": (1.0,), "control_high": (0.0,)}, "control_low"),
        ({"control_rate": (0.0,)}, "control_rate"),
        ({"control_rate": (1.0, 1.0)}, "control_rate"),
    ],
)
def test_invalid_limits_are_refused_by_name(limits, words):
    with pytest.raises(ValueError, match=words):
        double_integrator(**limits)


def test_a_reference_of_another_length_is_refused():
    controller = control.mppi(
        double_integrator(), horizon=HORIZON, num_samples=4, noise_std=(1.0,)
    )
    with pytest.raises(ValueError, match="12 steps"):
        controller.act(
            {}, controller.init(jax.random.key(0)), START, NOTHING, jnp.zeros((5, 2))
        )
