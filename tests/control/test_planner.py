"""All planners of any task: optima that are known, limits, time, risk, other users'
states and types, several devices.
"""

import dataclasses
import inspect
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
from flax.struct import dataclass
from helpers import jit, same

from sfkd_jax import control
from sfkd_jax.control import tuned
from sfkd_jax.control.planners._plans import shift
from sfkd_jax.control.planners._rollouts import risk_measure

DT, HORIZON = 0.1, 12
A = np.float32([[1.0, DT], [0.0, 1.0]])
B = np.float32([[0.0], [DT]])
Q, R = np.float32([1.0, 0.1]), 0.05
START, NOTHING = jnp.asarray([1.0, 0.0]), jnp.zeros(1)
WEIGHTS = {"state": 1.0, "effort": 1.0}


def dynamics(params, x, u, e):
    return A @ x + B @ u + e


def stage(weights, x, u, before, target):
    state = weights["state"] * jnp.sum(jnp.asarray(Q) * x**2)
    return state + weights["effort"] * R * jnp.sum(u**2)


def double_integrator(f=dynamics, cost=stage, **settings):
    limits = {"control_low": -50.0, "control_high": 50.0}
    return control.free_task(
        f, cost, **{"dt": DT, "weights": WEIGHTS, **limits, **settings}
    )


FEW = {"horizon": HORIZON, "noise_std": (2.0,)}
MPPI = partial(control.mppi, num_samples=400, effective_samples=20.0, noise="white")
SEARCHES = {
    "mppi": partial(MPPI, **FEW),
    "cem": partial(control.cem, num_samples=400, elites=40, noise="white", **FEW),
    "gradient": partial(control.gradient_planner, **FEW),
}
every = pytest.mark.parametrize("search", SEARCHES)


def act(planner, state=None, x=START, env=NOTHING, reference=(), params=None):
    state = planner.init(jax.random.key(0)) if state is None else state
    return jit(planner.act)(params, state, x, env, reference)


def plan_for(search, task=None, steps=12, start=START, env=NOTHING, **settings):
    """Plan repeatedly from the same state: the plan to which the search converges."""
    planner = SEARCHES[search](task or double_integrator(), **settings)

    @jit
    def run(state):
        def again(state, _):
            action, state, info = planner.act(
                {}, tuned(state, elapsed=0.0), start, env, ()
            )
            return state, (action, info)

        state, seen = jax.lax.scan(again, state, None, length=steps)
        return state, *jax.tree.map(lambda leaf: leaf[-1], seen)

    return run(planner.init(jax.random.key(0)))


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
    start = state = np.array(START, dtype=float)
    plan = []
    for gain in reversed(gains):
        plan.append(-gain @ state)
        state = a @ state + b @ plan[-1]
    return float(start @ value @ start), np.array(plan)


# ---- optima


@every
def test_on_a_linear_quadratic_problem_the_cost_is_near_the_optimum(search):
    least, _ = optimal()
    task = double_integrator()
    _, _, info = plan_for(search, task, noise_std=(1.0,))
    assert least <= float(info["mean_cost"]) * (1 + 1e-5)
    assert float(info["mean_cost"]) <= 1.02 * least


def test_the_gradient_planner_never_goes_up_and_ends_at_the_optimal_plan():
    costs = [
        float(plan_for("gradient", steps=steps, iterations=1)[2]["mean_cost"])
        for steps in (1, 2, 8)
    ]
    assert all(after <= before * (1 + 1e-6) for before, after in pairwise(costs))
    state, _, _ = plan_for("gradient", steps=60)
    np.testing.assert_allclose(state.plan, optimal()[1], atol=0.05)


@every
def test_a_proposal_that_is_best_is_found_at_once_and_a_dearer_control_used_less(
    search,
):
    least, plan = optimal()
    planner = SEARCHES[search](double_integrator(), noise_std=(1e-6,), num_proposals=1)
    state = tuned(planner.init(jax.random.key(0)), effective_samples=1.0)
    state = state._replace(proposals=jnp.asarray(plan[None], dtype=float))
    np.testing.assert_allclose(act(planner, state)[2]["cost"], least, rtol=1e-4)
    dear = double_integrator(weights={"state": 1.0, "effort": 30.0})
    used = [float(jnp.sum(plan_for(search, t)[0].plan ** 2)) for t in (None, dear)]
    assert used[1] < 0.5 * used[0]


@every
@pytest.mark.parametrize("window", [0, 5])
def test_limits_hold_exactly_from_the_measured_actuator_on(search, window):
    """The second entry of the state stands for the actuator position, here 0.5."""
    limits = {"control_low": -1.0, "control_high": 0.8, "control_rate": 3.0}
    task = double_integrator(**limits, actuator=lambda x: 0.1 * x[1:])
    far = jnp.asarray([4.0, 5.0])
    state, action, _ = plan_for(search, task, 2, far, smoothing_window=window)
    controls = np.concatenate([[[0.5]], action[None], state.controls[1:]])
    assert np.all((np.float32(-1.0) <= controls) & (controls <= np.float32(0.8)))
    assert np.all(np.abs(np.diff(controls, axis=0)) <= 3.0 * DT + 1e-6)
    if search == "gradient":  # the others average; the state is far off
        np.testing.assert_allclose(action, 0.5 - 3.0 * DT, atol=1e-6)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Random(control.Planner):
    """A planner as a user writes it: the best of some plans."""

    tries: int = 8

    def search(self, key, state, evaluate):
        shape = (self.horizon, self.tries, 1)
        plans = state.plan[:, None] + jax.random.normal(key, shape).at[:, 0].set(0.0)
        evaluated = evaluate(plans)
        best = jnp.argmin(evaluated.costs)
        lowest = evaluated.costs[best]
        plan = evaluated.perturbations[:, best]
        return control.SearchResult(plan, jnp.isfinite(lowest), lowest, jnp.ones(()))


def test_a_planner_of_ones_own_is_a_search_and_has_all_settings_of_planners():
    mine = control.factory(Random, Random.controller)
    arguments = inspect.signature(mine).parameters
    assert {"tries", "horizon", "noise_std", "risk"} <= set(arguments)
    planner = mine(double_integrator(), tries=32, **FEW)
    held = tuned(planner.init(jax.random.key(0)), elapsed=0.0)
    _, state, first = act(planner, held)
    _, state, later = act(planner, tuned(state, elapsed=0.0))
    assert bool(later["healthy"])
    assert later["cost"] <= first["cost"] * (1 + 1e-5)


# ---- what is data


@every
def test_everything_a_driver_may_turn_is_data_and_compiles_nothing(search):
    traces = []

    def counted(*inputs):
        traces.append(1)
        return dynamics(*inputs)

    planner = SEARCHES[search](double_integrator(counted), num_proposals=1)
    run, state = jit(planner.act), planner.init(jax.random.key(0))
    plans, seen = [], None
    for k in (1, 2, 3):
        changes = {"temperature": k, "effective_samples": 10 * k, "noise_std": [k]}
        state = tuned(state, **changes, elapsed=0.5 * k, cost={"effort": 1 / k})
        state = state._replace(proposals=jnp.full((1, HORIZON, 1), -1.0 * k))
        _, state, _ = run({}, state, START * k, NOTHING, ())
        plans.append(np.asarray(state.plan))
        seen = seen or len(traces)
    assert len(traces) == seen
    assert not np.allclose(plans[0], plans[1])
    assert float(state.tuning.elapsed) == 1.0
    assert float(state.tuning.effective_samples) == 30.0


# ---- time


def test_a_plan_is_shifted_by_the_time_that_has_passed():
    plan = jnp.asarray([[0.0], [2.0], [4.0], [8.0]])
    expected = {0.0: [0, 2, 4, 8], 1.0: [2, 4, 8, 8], 0.5: [1, 3, 6, 8], 9.0: [8] * 4}
    for elapsed, shifted in expected.items():
        np.testing.assert_array_equal(shift(plan, jnp.asarray(elapsed))[:, 0], shifted)


def test_a_late_call_continues_the_plan_from_where_it_would_be_by_then():
    """The observation of that call is NaN, so its control is the plan's; the stored
    plan is one period old. A clock that tells no number counts as a call in time.
    """
    planner = SEARCHES["mppi"](double_integrator())
    run, plan = jit(planner.act), 0.1 * jnp.arange(HORIZON, dtype=float)[:, None]
    for told in (0.5, 1.0, 2.75, np.nan):
        state = tuned(planner.init(jax.random.key(0)), elapsed=told)
        state = state._replace(plan=plan, controls=plan)
        action, after, info = run(None, state, START * jnp.nan, NOTHING, ())
        assert not bool(info["healthy"])
        elapsed = 1.0 if np.isnan(told) else told
        late = max(elapsed - 1.0, 0.0)
        np.testing.assert_allclose(action, 0.1 * late, atol=1e-6)
        expected = 0.1 * (late + min(elapsed, 1.0))
        np.testing.assert_allclose(after.controls[0], expected, atol=1e-6)


# ---- what breaks


@every
def test_one_finite_rollout_is_enough_and_none_keeps_the_last_plan(search):
    def breaking(params, x, u, e):
        return jnp.where(e[0] + u[0] ** 2 > 1e-8, jnp.nan, dynamics(params, x, u, 0.0))

    planner = SEARCHES[search](double_integrator(breaking))
    action, state, info = act(planner)  # only the plan of zeros survives
    assert bool(info["healthy"])
    np.testing.assert_array_equal(action, 0.0)
    action, state, info = act(planner, state, env=jnp.ones(1))  # and now nothing does
    assert not bool(info["healthy"])
    assert np.all(np.isfinite(action))
    assert np.all(np.isfinite(state.plan))


@pytest.mark.parametrize("temperature", [0.0, np.nan])
def test_a_temperature_that_is_not_positive_is_reported_and_changes_no_plan(
    temperature,
):
    """Otherwise the worst sample would win."""
    planner = control.mppi(double_integrator(), num_samples=64, **FEW)
    bad = tuned(act(planner)[1], temperature=temperature)
    action, state, info = act(planner, bad)
    assert not bool(info["healthy"])
    np.testing.assert_array_equal(action, bad.controls[0])
    assert bool(act(planner, tuned(state, temperature=5.0))[2]["healthy"])
    with pytest.raises(ValueError, match="temperature must be positive"):
        control.mppi(double_integrator(), temperature=temperature, **FEW)


@pytest.mark.parametrize(
    ("search", "settings", "words"),
    [
        ("mppi", {"effective_samples": 401.0}, "effective_samples"),
        ("mppi", {"horizon": 0}, "horizon must be at least 1"),
        ("mppi", {"noise": "pink"}, "noise must be one of"),
        ("mppi", {"noise_std": (1.0, 1.0)}, "noise_std"),
        ("mppi", {"gain_samples": 8, "smoothing_window": 5}, "gain_samples"),
        ("mppi", {"risk": "best"}, "risk must be one of"),
        ("cem", {"smoothing_window": 25}, "horizon of at least 13"),
        ("cem", {"smoothing_window": 5, "smoothing_order": 4}, "smoothing_order"),
        ("cem", {"elites": 1000}, "elites"),
        ("gradient", {"shrink": 1.0}, "shrink"),
    ],
)
def test_invalid_settings_are_refused_by_name(search, settings, words):
    with pytest.raises(ValueError, match=words):
        SEARCHES[search](double_integrator(), **settings)


# ---- several environments


def test_risk_is_of_whole_trajectories():
    costs = jnp.asarray([[1.0, 4.0], [2.0, 0.0], [6.0, 2.0]])
    expected = {
        ("mean", 1.0): [3.0, 2.0],
        ("worst", 1.0): [6.0, 4.0],
        ("cvar", 0.5): [4.0, 3.0],
        ("cvar", 1.0): [3.0, 2.0],
        ("cvar", 0.01): [6.0, 4.0],
    }
    for measure, reduced in expected.items():
        np.testing.assert_allclose(risk_measure(*measure)(costs), reduced)


@pytest.mark.parametrize("risk", ["worst", "cvar"])
def test_environments_that_are_all_the_same_count_as_one(risk):
    push = jnp.asarray([0.02, 0.0])
    one, _, alone = plan_for("mppi", steps=2, env=push)
    several, _, info = plan_for("mppi", steps=2, env=jnp.tile(push, (3, 1)), risk=risk)
    np.testing.assert_allclose(several.plan, one.plan, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(info["mean_cost"], alone["mean_cost"], rtol=1e-4)


def test_the_worst_case_is_cheaper_for_a_plan_that_was_made_for_it():
    """Pushes from both sides, one three times as strong as the other."""
    envs = jnp.asarray([[0.03, 0.0], [-0.09, 0.0]])
    judge = SEARCHES["mppi"](
        double_integrator(), num_samples=1, effective_samples=0.0, risk="worst"
    )
    costs = {}
    for risk in ("mean", "worst"):
        plan = plan_for("gradient", steps=40, env=envs, risk=risk)[0].plan
        held = judge.init(jax.random.key(0))._replace(plan=plan)
        costs[risk] = float(act(judge, held, env=envs)[2]["mean_cost"])
    assert costs["worst"] < 0.97 * costs["mean"]


# ---- states, types and functions that other projects have


def test_strict_promotion_of_types_and_ranks_is_no_obstacle():
    planner = SEARCHES["mppi"](double_integrator())
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert bool(act(planner, env=jnp.zeros(2))[2]["healthy"])


@pytest.mark.parametrize(
    ("search", "kind", "double"),
    [("mppi", np.int8, False), ("gradient", np.float32, True)],
)
def test_observations_of_any_type_are_planned_from(search, kind, double):
    """Also single precision where double is enabled."""
    with jax.enable_x64(double):
        planner = SEARCHES[search](double_integrator())
        u, state, info = act(planner, x=np.asarray([1, 0], kind))
        assert bool(info["healthy"])
        assert u.dtype == state.plan.dtype == (jnp.float64 if double else jnp.float32)
        assert u < 0


@dataclass
class Body:
    """A state as brax and MJX have them: a dataclass with a counter."""

    position: jax.Array
    velocity: jax.Array
    steps: jax.Array
    note: None = None


def test_state_environment_and_reference_may_be_any_trees_and_several():
    def move(params, x, u, e):
        faster = x.velocity + DT * u[0] * e["gain"]
        return Body(x.position + DT * x.velocity, faster, x.steps + 1)

    def cost(weights, x, u, before, target):
        return (x.position - target["place"]) ** 2 + 0.01 * u[0] ** 2

    planner = SEARCHES["mppi"](double_integrator(move, cost))
    start, goals = Body(*map(jnp.asarray, (1.0, 0.0, 0))), {"place": jnp.zeros(HORIZON)}
    u, _, info = act(planner, None, start, {"gain": jnp.ones(())}, goals)
    assert info["predicted_states"].position.shape == (HORIZON,)
    np.testing.assert_array_equal(
        info["predicted_states"].steps, np.arange(1, HORIZON + 1)
    )
    several = SEARCHES["mppi"](double_integrator(move, cost), several=True)
    same_u = act(several, None, start, {"gain": jnp.ones(3)}, goals)[0]
    np.testing.assert_allclose(same_u, u, atol=1e-5)


def test_costs_and_dynamics_get_what_they_name():
    """A cost of the first step alone moves nothing but the first control."""

    def noted(weights, x, u, before, target, *, params, env, step):
        return jnp.where(step == 0, jnp.sum((x - params) ** 2), 0.0) + 0.0 * env[0]

    def pushed(params, x, u, e, *, step):
        return jnp.where(step == 0, x + u[0], x)

    end = lambda weights, x, target, *, params, env: 0.0 * x[0] * params[0] * env[0]
    planner = control.mppi(
        double_integrator(pushed, noted, terminal=end),
        num_samples=500,
        temperature=0.01,
        **FEW,
    )
    params, state = jnp.asarray([1.5, 0.5]), planner.init(jax.random.key(0))
    for _ in range(8):
        u, state, _ = act(planner, tuned(state, elapsed=0.0), params=params)
    assert u[0] == pytest.approx(0.5, abs=0.05)


def test_noise_of_the_dynamics_is_the_same_for_all_samples_and_new_at_every_step():
    def noisy(params, x, u, e, *, key):
        return jnp.stack([u[0], jax.random.normal(key)])

    cost = lambda weights, x, u, before, target: u[0] ** 2
    planner = SEARCHES["mppi"](double_integrator(noisy, cost), info_level="samples")
    state, drawn = planner.init(jax.random.key(3)), []
    for _ in range(2):
        _, state, info = act(planner, state)
        seen = np.asarray(info["sample_states"][:, :, 1])
        assert np.all(seen == seen[:, :1])
        drawn += [*seen[:, 0]]
    assert len(set(drawn)) == 2 * HORIZON


@pytest.mark.parametrize(
    ("limits", "reached"),
    [
        ({"control_low": None, "control_high": None}, None),
        ({"control_low": -np.inf, "control_high": 1.0}, None),
        ({"control_low": (-0.5,), "control_high": None}, -0.5),
        ({"control_low": -0.5, "control_rate": 0.25, "dt": 1.0}, -0.25),
        ({"control_low": -0.5, "control_rate": (np.inf,), "dt": 1.0}, -0.5),
    ],
)
def test_limits_may_be_one_number_infinite_or_missing(limits, reached):
    """A cost that asks for as little as there is; the best of 1000 samples is near −6."""
    least = lambda weights, x, u, before, target: u[0]
    planner = control.mppi(
        double_integrator(cost=least, **limits),
        num_samples=1000,
        temperature=1e-3,
        **FEW,
    )
    u = act(planner)[0][0]
    assert u < -1.5 if reached is None else u == pytest.approx(reached, abs=0.01)


@every
def test_candidates_are_reported_on_request_and_explain_the_plan(search):
    """Their weighted mean is the plan that is rolled out."""
    task = double_integrator(lambda params, x, u, e: x + u[0])
    planner = SEARCHES[search](task, info_level="samples")
    info = act(planner)[2]
    weights, plans = info["sample_weights"], info["sample_plans"]
    assert float(jnp.sum(weights)) == pytest.approx(1.0, rel=1e-5)
    states = 1.0 + jnp.cumsum(plans[..., 0], axis=0)
    np.testing.assert_allclose(info["sample_states"][..., 0], states, atol=1e-4)
    mean = jnp.einsum("m,tmc->tc", weights, plans)[:, 0]
    predicted = info["predicted_states"][:, 0]
    np.testing.assert_allclose(predicted, 1.0 + jnp.cumsum(mean), atol=1e-4)
    assert "sample_costs" not in act(SEARCHES[search](task))[2]


# ---- devices

PROGRAM = """
    import jax, jax.numpy as jnp, numpy as np
    from sfkd_jax import control
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("sample",))
    spec = jax.sharding.PartitionSpec(None, "sample", None)
    A, B = jnp.asarray([[1.0, 0.1], [0.0, 1.0]]), jnp.asarray([[0.0], [0.1]])
    task = control.free_task(
        lambda p, x, u, e: A @ x + B @ u, lambda w, x, u, b, g: jnp.sum(x**2),
        control_low=(-9.0,), control_high=(9.0,),
    )
    planner = control.mppi(
        task, horizon=12, num_samples=64, noise_std=(2.0,), effective_samples=8.0,
        sharding=jax.sharding.NamedSharding(mesh, spec),
    )
    state = planner.init(jax.random.key(0))
    _, state, _ = jax.jit(planner.act)({}, state, jnp.ones(2), jnp.zeros(1), ())
    print(len(jax.devices()), *np.asarray(state.plan).ravel().tolist())
"""


def planned_on(devices):
    count = f"--xla_force_host_platform_device_count={devices}"
    flags = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {count}"}
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    done = subprocess.run(
        command, env=os.environ | flags, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found, *plan = done.stdout.split()
    assert int(found) == devices
    return np.asarray(plan, float)


def test_samples_spread_over_devices_make_the_same_plan():
    assert same(planned_on(4), planned_on(1), rtol=1e-5, atol=1e-5)
