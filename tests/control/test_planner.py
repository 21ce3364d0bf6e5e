"""All planners of any task: optima that are known, limits, time, other users'
states and types.
"""

import dataclasses
import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.struct import dataclass
from helpers import jit

from sfkd_jax import control
from sfkd_jax.control import tuned

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
    return control.free_task(f, cost, **{"weights": WEIGHTS, **limits, **settings})


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
    """Plan repeatedly from the same state; return controls and infos of all steps."""
    planner = SEARCHES[search](task or double_integrator(), **settings)

    @jit
    def run(state):
        def again(state, _):
            action, state, info = planner.act(
                {}, tuned(state, elapsed=0.0), start, env, ()
            )
            return state, (action, info)

        state, seen = jax.lax.scan(again, state, None, length=steps)
        return state, *seen

    return run(planner.init(jax.random.key(0)))


def optimal():
    """Optimal cost and controls, by a Riccati recursion in float64."""
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
    cost = float(info.plan.mean_cost[-1])
    assert least <= cost * (1 + 1e-5)
    assert cost <= 1.02 * least


def test_the_gradient_planner_never_goes_up_and_ends_at_the_optimal_plan():
    state, _, info = plan_for("gradient", steps=60)
    costs = np.asarray(info.plan.mean_cost)
    assert np.all(costs[1:] <= costs[:-1] * (1 + 1e-6))
    np.testing.assert_allclose(state.plan, optimal()[1], atol=0.05)
    # A plan of before that is worse than none does not hold it up.
    worse = tuned(state._replace(plan=-9.0 * state.plan), elapsed=0.0)
    _, _, info = act(SEARCHES["gradient"](double_integrator()), worse)
    assert info.plan.mean_cost <= HORIZON * Q[0] * START[0] ** 2


@every
def test_limits_hold_exactly_from_rest_on(search):
    limits = {"control_low": -1.0, "control_high": 0.8, "control_rate": 3.0}
    task = double_integrator(**limits, dt=DT)
    far = jnp.asarray([4.0, 5.0])
    planner = SEARCHES[search](task)
    action, state, _ = act(planner, x=far)
    controls = np.concatenate([[[0.0]], action[None], state.controls])
    assert np.all((np.float32(-1.0) <= controls) & (controls <= np.float32(0.8)))
    assert np.all(np.abs(np.diff(controls, axis=0)) <= 3.0 * DT + 1e-6)
    if search == "gradient":  # the others average; the state is far off
        np.testing.assert_allclose(action, -3.0 * DT, atol=1e-6)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Random(control.Planner):
    """A planner as a user writes it: the best of some plans."""

    tries: int = 8

    def search(self, key, plan, tuning, evaluate):
        shape = (self.horizon, self.tries, 1)
        plans = plan[:, None] + jax.random.normal(key, shape).at[:, 0].set(0.0)
        evaluated = evaluate(plans)
        best = jnp.argmin(evaluated.costs)
        lowest = evaluated.costs[best]
        plan = evaluated.perturbations[:, best]
        return control.SearchResult(plan, jnp.isfinite(lowest), lowest, jnp.ones(()))


def test_a_planner_of_ones_own_is_a_search_and_has_all_settings_of_planners():
    mine = control.factory(Random, Random.controller)
    arguments = inspect.signature(mine).parameters
    assert {"tries", "horizon", "noise_std", "env_low"} <= set(arguments)
    planner = mine(double_integrator(), tries=32, **FEW)
    held = tuned(planner.init(jax.random.key(0)), elapsed=0.0)
    _, state, first = act(planner, held)
    _, state, later = act(planner, tuned(state, elapsed=0.0))
    assert bool(later.healthy)
    assert later.plan.cost <= first.plan.cost * (1 + 1e-5)


# ---- what is data


@every
def test_everything_a_driver_may_turn_is_data_and_compiles_nothing(search):
    traces = []

    def counted(*inputs):
        traces.append(1)
        return dynamics(*inputs)

    planner = SEARCHES[search](double_integrator(counted))
    run, state = jit(planner.act), planner.init(jax.random.key(0))
    plans, seen = [], None
    for k in (1, 2, 3):
        changes = {"temperature": k, "effective_samples": 10 * k, "noise_std": [k]}
        state = tuned(state, **changes, elapsed=0.5 * k, cost={"effort": 1 / k})
        _, state, _ = run({}, state, START * k, NOTHING, ())
        plans.append(np.asarray(state.plan))
        seen = seen or len(traces)
    assert len(traces) == seen
    assert not np.allclose(plans[0], plans[1])
    assert float(state.tuning.elapsed) == 1.0
    assert float(state.tuning.effective_samples) == 30.0


# ---- time


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
        assert not bool(info.healthy)
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
    assert bool(info.healthy)
    np.testing.assert_array_equal(action, 0.0)
    action, state, info = act(planner, state, env=jnp.ones(1))  # and now nothing does
    assert not bool(info.healthy)
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
    assert not bool(info.healthy)
    np.testing.assert_array_equal(action, bad.controls[0])
    assert bool(act(planner, tuned(state, temperature=5.0))[2].healthy)
    with pytest.raises(ValueError, match="temperature must be in"):
        control.mppi(double_integrator(), temperature=temperature, **FEW)


@pytest.mark.parametrize(
    ("search", "settings", "words"),
    [
        ("mppi", {"effective_samples": 401.0}, "effective_samples"),
        ("mppi", {"horizon": 0}, "horizon must be in"),
        ("mppi", {"noise": "pink"}, "noise must be one of"),
        ("mppi", {"noise": "spline", "noise_knots": 13}, "noise_knots"),
        ("mppi", {"noise_std": (0.0,)}, "noise_std"),
        ("mppi", {"smoothing_window": 6}, "smoothing_window"),
        ("mppi", {"smoothing_window": 13}, "smoothing_window"),
        ("cem", {"elites": 1000}, "elites"),
        ("gradient", {"shrink": 1.0}, "shrink"),
    ],
)
def test_invalid_settings_are_refused_by_name(search, settings, words):
    with pytest.raises(ValueError, match=words):
        SEARCHES[search](double_integrator(), **settings)


# ---- states, types and functions that other projects have


def test_strict_promotion_of_types_and_ranks_is_no_obstacle():
    planner = SEARCHES["mppi"](double_integrator())
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert bool(act(planner, env=jnp.zeros(2))[2].healthy)


@pytest.mark.parametrize(
    ("search", "kind", "double"),
    [("mppi", np.int8, False), ("gradient", np.float32, True)],
)
def test_observations_of_any_type_are_planned_from(search, kind, double):
    """Also single precision where double is enabled."""
    with jax.enable_x64(double):
        planner = SEARCHES[search](double_integrator())
        u, state, info = act(planner, x=np.asarray([1, 0], kind))
        assert bool(info.healthy)
        assert u.dtype == state.plan.dtype == (jnp.float64 if double else jnp.float32)
        assert u < 0


@dataclass
class Body:
    """A state as brax and MJX have them: a dataclass with a counter."""

    position: jax.Array
    velocity: jax.Array
    steps: jax.Array
    note: None = None


def test_state_environment_and_reference_may_be_any_trees():
    def move(params, x, u, e):
        faster = x.velocity + DT * u[0] * e["gain"]
        return Body(x.position + DT * x.velocity, faster, x.steps + 1)

    def cost(weights, x, u, before, target):
        return (x.position - target["place"]) ** 2 + 0.01 * u[0] ** 2

    planner = SEARCHES["mppi"](double_integrator(move, cost))
    start, goals = Body(*map(jnp.asarray, (1.0, 0.0, 0))), {"place": jnp.zeros(HORIZON)}
    info = act(planner, None, start, {"gain": jnp.ones(())}, goals)[2]
    assert info.plan.states.position.shape == (HORIZON,)
    np.testing.assert_array_equal(info.plan.states.steps, np.arange(1, HORIZON + 1))


@pytest.mark.parametrize(
    ("limits", "reached"),
    [
        ({"control_low": -np.inf, "control_high": np.inf}, None),
        ({"control_low": (-0.5,), "control_high": np.inf}, -0.5),
        ({"control_low": -0.5, "control_rate": 0.25, "dt": 1.0}, -0.25),
        ({"control_low": -0.5, "control_rate": (np.inf,), "dt": 1.0}, -0.5),
    ],
)
def test_limits_may_be_one_number_or_infinite(limits, reached):
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
def test_a_cost_that_is_a_truth_value_is_summed_over_the_horizon(search):
    task = double_integrator(
        lambda p, x, u, e: x,
        lambda w, x, u, b, r: x[0] > 0.5,
        terminal=lambda w, x, r: x[0] > 0.5,
    )
    _, _, info = act(SEARCHES[search](task, iterations=1))
    assert float(info.plan.cost) == HORIZON + 1


@pytest.mark.parametrize(
    ("name", "value", "got"),
    [
        ("stage", lambda x, u: x[:1], "float32[1]"),
        ("stage", lambda x, u: x, "float32[2]"),
        ("stage", lambda x, u: x[None, :1], "float32[1, 1]"),
        ("stage", lambda x, u: [x[0]], "[float32[]]"),
        ("stage", lambda x, u: None, "None"),
        ("terminal", lambda x, u: u, "float32[1]"),
        ("dynamics", lambda x, u: x[:, None], "float32[2, 1]"),
        ("dynamics", lambda x, u: x[None], "float32[1, 2]"),
        ("dynamics", lambda x, u: [x[0], x[1]], "[float32[], float32[]]"),
        ("dynamics", lambda x, u: x.astype(int), "int32[2]"),
    ],
)
def test_what_a_function_of_a_task_returns_is_refused_by_its_name(name, value, got):
    functions = {
        "dynamics": dynamics,
        "stage": stage,
        "terminal": lambda w, x, r: 0.0,
        name: {
            "dynamics": lambda p, x, u, e: value(x, u),
            "stage": lambda w, x, u, b, r: value(x, u),
            "terminal": lambda w, x, r: value(x, jnp.zeros(1)),
        }[name],
    }
    planner = MPPI(control.free_task(**functions, weights=WEIGHTS), **FEW)
    with pytest.raises(ValueError, match=f"^{name} must return") as refused:
        jax.eval_shape(lambda: act(planner))
    assert str(refused.value).endswith(f", got {got}")
