"""Planners with the states, types, limits and settings that other projects have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization
from flax.struct import dataclass

from sfkd_jax import control
from sfkd_jax.control import temperature_for_sample_size, tuned

HORIZON = 6
REFERENCE = jnp.zeros((HORIZON, 2))


def dynamics(params, x, u, e):
    return x + 0.1 * jnp.stack([x[1], u[0]])


def stage(weights, x, u, before, target):
    return jnp.sum((x - target) ** 2) + weights["effort"] * u[0] ** 2


def task(dynamics=dynamics, stage=stage, **settings):
    options = {"weights": {"effort": 0.01}, "control_low": -2.0, "control_high": 2.0}
    return control.free_task(dynamics, stage, **(options | settings))


def mppi(of=None, **settings):
    options = {"num_samples": 64, "horizon": HORIZON, "noise_std": (1.0,)}
    options |= {"temperature": 0.05}
    return control.mppi(of or task(), **(options | settings))


PLANNERS = {
    "mppi": mppi,
    "adapted": lambda: mppi(adapt=0.5, iterations=2, effective_samples=8.0),
    "smoothed": lambda: mppi(smoothing_window=3, smoothing_order=1, halton=True),
    "control cost": lambda: mppi(control_cost=0.1),
    "cem": lambda: control.cem(
        task(), num_samples=64, elites=8, horizon=HORIZON, noise_std=(1.0,)
    ),
    "gradient": lambda: control.gradient_planner(
        task(), horizon=HORIZON, noise_std=(1.0,)
    ),
}
every = pytest.mark.parametrize("name", PLANNERS)
START = jnp.asarray([1.0, 0.0])
ENV = jnp.zeros(1)


def act(planner, observation=START, env=ENV, reference=REFERENCE, params=None):
    state = planner.init(jax.random.key(0))
    return jax.jit(planner.act)(params, state, observation, env, reference)


@every
def test_the_state_can_be_donated(name):
    planner = PLANNERS[name]()
    step = jax.jit(planner.act, donate_argnums=1)
    state, kept = (planner.init(jax.random.key(1)) for _ in range(2))
    for _ in range(2):
        u, state, _ = step({}, state, START, ENV, REFERENCE)
    for _ in range(2):
        v, kept, _ = jax.jit(planner.act)({}, kept, START, ENV, REFERENCE)
    assert u == v


@every
def test_the_state_is_plain_arrays_that_flax_stores(name):
    planner = PLANNERS[name]()
    state = planner.init(jax.random.key(2))
    state = planner.act({}, state, START, ENV, REFERENCE)[1]
    stored = serialization.to_bytes(state)
    empty = planner.init(jax.random.key(0))
    back = serialization.from_bytes(empty, stored)
    first, second = (
        jax.jit(planner.act)({}, kept, START, ENV, REFERENCE)[0]
        for kept in (state, back)
    )
    assert first == second


@every
def test_strict_promotion_of_types_and_ranks_is_no_obstacle(name):
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert bool(act(PLANNERS[name]())[2]["healthy"])


@every
@pytest.mark.parametrize("kind", [np.float32, np.int32, np.int8])
@pytest.mark.parametrize("double", [False, True])
def test_observations_of_any_type_are_planned_from(name, kind, double):
    """Also single precision where double is enabled."""
    with jax.enable_x64(double):
        planner = PLANNERS[name]()
        given = (
            np.asarray([1, 0], kind),
            np.zeros(1, np.float32),
            np.zeros((HORIZON, 2)),
        )
        u, state, info = act(planner, *given)
        assert bool(info["healthy"])
        assert u.dtype == state.plan.dtype == (jnp.float64 if double else jnp.float32)
        assert u < 0


def test_neither_environment_nor_reference_is_needed():
    alone = task(stage=lambda weights, x, u, before, target: jnp.sum(x**2))
    u, _, info = act(mppi(alone), env=None, reference=None)
    assert bool(info["healthy"])
    assert u < 0


@dataclass
class Body:
    """A state as brax and MJX have them: a dataclass with a counter and a key."""

    position: jax.Array
    velocity: jax.Array
    steps: jax.Array
    note: None = None


def body_dynamics(params, x, u, e):
    return Body(
        x.position + 0.1 * x.velocity, x.velocity + 0.1 * u[0] * e["gain"], x.steps + 1
    )


def body_stage(weights, x, u, before, target):
    return (x.position - target["place"]) ** 2 + weights["effort"] * u[0] ** 2


@pytest.mark.parametrize("chunk", [0, 20])
def test_state_environment_and_reference_may_be_any_trees(chunk):
    planner = mppi(task(body_dynamics, body_stage), chunk=chunk)
    start = Body(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(0))
    goals = {"place": jnp.zeros(HORIZON)}
    u, _, info = act(planner, start, {"gain": jnp.asarray(1.0)}, goals)
    plain = mppi(task(stage=lambda w, x, u, b, t: x[0] ** 2 + w["effort"] * u[0] ** 2))
    np.testing.assert_allclose(u, act(plain)[0], atol=1e-6)
    predicted = info["predicted_states"]
    assert predicted.position.shape == (HORIZON,)
    np.testing.assert_array_equal(predicted.steps, np.arange(1, HORIZON + 1))


def test_several_trees_of_environments_are_planned_for_at_once():
    planner = mppi(task(body_dynamics, body_stage), several=True, risk="worst")
    start = Body(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(0))
    goals = {"place": jnp.zeros(HORIZON)}
    u, _, info = act(planner, start, {"gain": jnp.ones(3)}, goals)
    one = mppi(task(body_dynamics, body_stage))
    alone = act(one, start, {"gain": jnp.asarray(1.0)}, goals)[0]
    np.testing.assert_allclose(u, alone, atol=1e-6)
    assert bool(info["healthy"])


def test_costs_and_dynamics_get_what_they_name():
    """The step, the parameters, the environment: a cost of the last step alone moves
    nothing that the first control cannot reach.
    """
    seen = {}

    def noted(weights, x, u, before, target, *, params, env, step):
        seen["stage"] = params.shape, env.shape, step.dtype
        return jnp.where(step == 0, jnp.sum((x - params) ** 2), 0.0) + 0.0 * env[0]

    def end(weights, x, target, *, params, env):
        seen["terminal"] = params.shape, env.shape
        return 0.0 * x[0]

    def pushed(params, x, u, e, *, step):
        seen["dynamics"] = step.dtype
        return jnp.where(step == 0, x + u[0], x)

    planner = mppi(task(pushed, noted, terminal=end), num_samples=500, temperature=0.01)
    params = jnp.asarray([1.5, 0.5])
    state = planner.init(jax.random.key(0))
    for _ in range(8):
        held = tuned(state, elapsed=0.0)
        u, state, _ = jax.jit(planner.act)(params, held, START, ENV, REFERENCE)
    assert u[0] == pytest.approx(0.5, abs=0.05)
    assert seen["stage"] == ((2,), (1,), jnp.int32)
    assert seen["terminal"] == ((2,), (1,))
    assert seen["dynamics"] == jnp.int32


def test_noise_of_the_dynamics_is_the_same_for_all_samples_and_new_at_every_step():
    def noisy(params, x, u, e, *, key):
        return jnp.stack([u[0], jax.random.normal(key)])

    planner = mppi(task(noisy, lambda w, x, u, before, target: u[0] ** 2))
    state = planner.init(jax.random.key(3))
    drawn = []
    for _ in range(2):
        _, state, info = jax.jit(planner.act)({}, state, START, ENV, REFERENCE)
        drawn += [*np.asarray(info["predicted_states"][:, 1])]
    assert len(set(drawn)) == 2 * HORIZON
    several = jnp.zeros((4, 1))
    spread = mppi(task(noisy, lambda w, x, u, before, target: x[1]), risk="worst")
    assert act(spread, env=several)[2]["mean_cost"] > act(spread)[2]["mean_cost"] - 9.0


@pytest.mark.parametrize(
    ("limits", "reached"),
    [
        ({"control_low": None, "control_high": None}, -6.0),
        ({"control_low": -np.inf, "control_high": 1.0}, -6.0),
        ({"control_low": (-0.5,), "control_high": None}, -0.5),
        (
            {"control_low": -0.5, "control_high": 0.5, "control_rate": 0.25, "dt": 1.0},
            -0.25,
        ),
        (
            {
                "control_low": -0.5,
                "control_high": 0.5,
                "control_rate": (np.inf,),
                "dt": 1.0,
            },
            -0.5,
        ),
    ],
)
def test_limits_may_be_one_number_infinite_or_missing(limits, reached):
    """A cost that asks for as little as there is: with samples of deviation 2 the best
    of a thousand is near −6.
    """
    least = task(stage=lambda w, x, u, before, target: u[0], **limits)
    planner = mppi(least, num_samples=1000, noise_std=(2.0,), temperature=1e-3)
    u, _state, info = act(planner)
    assert bool(info["healthy"])
    assert bool(jnp.isfinite(u).all())
    assert u[0] == pytest.approx(reached, abs=0.01) if reached > -1 else u[0] < -1.5


@pytest.mark.parametrize("unroll", [1, 3, HORIZON, 100])
def test_steps_that_are_compiled_together_change_no_plan(unroll):
    plans = [act(mppi(unroll=number))[1].plan for number in (2, unroll)]
    np.testing.assert_allclose(*plans, atol=1e-6)


def test_no_steps_compiled_together_are_refused():
    with pytest.raises(ValueError, match="unroll"):
        mppi(unroll=0)


def test_a_slew_limit_without_a_sampling_period_is_refused():
    with pytest.raises(ValueError, match="needs dt"):
        task(control_rate=0.25)


def test_several_controls_without_limits_are_counted():
    plain = control.free_task(
        lambda params, x, u, e: x + u,
        lambda weights, x, u, before, target: jnp.sum(x**2),
        num_controls=2,
    )
    u, _, info = act(mppi(plain, noise_std=(0.3, 0.3)))
    assert u.shape == (2,)
    assert bool(info["healthy"])


@pytest.mark.parametrize("temperature", [0.0, -1.0, np.nan])
def test_a_temperature_that_is_not_positive_is_reported_and_changes_no_plan(
    temperature,
):
    """Otherwise the worst sample would win."""
    planner = mppi()
    _u, state, _ = act(planner)
    bad = tuned(state, temperature=temperature)
    after, state, info = jax.jit(planner.act)({}, bad, START, ENV, REFERENCE)
    assert not bool(info["healthy"])
    assert after == pytest.approx(np.asarray(bad.controls[0]))
    good = tuned(state, temperature=5.0)
    assert bool(jax.jit(planner.act)({}, good, START, ENV, REFERENCE)[2]["healthy"])
    with pytest.raises(ValueError, match="temperature must be positive"):
        mppi(temperature=temperature)


@pytest.mark.parametrize("horizon", [0, -1])
def test_a_horizon_that_is_not_positive_is_refused(horizon):
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        mppi(horizon=horizon, noise="white")


def test_what_the_user_tunes_compiles_nothing_again_and_a_late_call_counts_once():
    planner = mppi(effective_samples=10.0)
    traces = []

    @jax.jit
    def step(state):
        traces.append(1)
        return planner.act({}, state, START, ENV, REFERENCE)[1]

    state = step(step(planner.init(jax.random.key(0))))
    changes = {"effective_samples": 20, "temperature": 3, "noise_std": [0.5]}
    state = step(tuned(state, **changes, cost={"effort": 1}, elapsed=2))
    assert len(traces) == 1
    assert float(state.tuning.elapsed) == 1.0
    assert float(state.tuning.effective_samples) == 20.0
    assert float(state.tuning.cost["effort"]) == 1.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"temprature": 1.0}, "choose of temperature"),
        ({"noise_std": [1.0, 2.0]}, r"noise_std must have shape \(1,\), got \(2,\)"),
        ({"cost": {"effrt": 1.0}}, "no weights effrt"),
    ],
)
def test_what_cannot_be_tuned_is_one_line(changes, says):
    with pytest.raises(ValueError, match=says):
        tuned(mppi().init(jax.random.key(0)), **changes)


@pytest.mark.parametrize("broken", [None, jnp.inf, jnp.nan])
def test_the_temperature_has_the_derivative_of_the_implicit_equation(broken):
    """Against central differences; a cost that is not finite changes nothing."""
    with jax.enable_x64(True):
        costs = jnp.asarray(np.random.default_rng(0).gamma(2.0, 3.0, 40))
        if broken is not None:
            costs = costs.at[3].set(broken)
        wanted = jnp.asarray(12.0)
        slopes = jax.grad(temperature_for_sample_size, argnums=(0, 1))(costs, wanted)

        def difference(towards, size):
            ends = [
                temperature_for_sample_size(costs + t * towards, wanted + t * size)
                for t in (0.05, -0.05)
            ]
            return (ends[0] - ends[1]) / 0.1

        for entry in (0, 7, 20):
            unit = jnp.zeros(40).at[entry].set(1.0)
            np.testing.assert_allclose(
                slopes[0][entry], difference(unit, 0.0), rtol=0.05
            )
        np.testing.assert_allclose(slopes[1], difference(jnp.zeros(40), 1.0), rtol=0.05)
        assert bool(jnp.isfinite(slopes[0]).all())
        assert float(jnp.sum(slopes[0])) == pytest.approx(0.0, abs=1e-6)


def test_a_plan_of_fixed_sample_size_has_the_gradient_of_finite_differences():
    with jax.enable_x64(True):
        planner = mppi(effective_samples=10.0)
        state = planner.init(jax.random.key(5))

        def control_at(position):
            x = jnp.stack([position, jnp.zeros(())])
            return planner.act({}, state, x, ENV, REFERENCE)[0][0]

        slope = jax.grad(control_at)(jnp.asarray(1.0))
        ends = [control_at(jnp.asarray(1.0 + t)) for t in (1e-3, -1e-3)]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-3, rtol=0.05)
