"""What every controller promises, whatever it plans with; `test_mppi.py` asserts the
rest for `mppi` alone.
"""

from functools import cache, partial

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

from sfkd_jax import control, evaluation, models, scenarios, vehicle
from sfkd_jax.core.folding import fold

PLANT = vehicle.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
HORIZON = 5
OFFSET = np.float32([0.0, 0.3, 0.0, 10.0])
ENV = np.float32([0.7, 3.0])
REFERENCE = straight(HORIZON)
BLACKOUTS = {"observation": 1, "infinite": 3, "env": 5}
"""Steps of the drive at which something cannot be read; the step after each is clean."""


def along_path(law, **settings):
    """The task of following a path with the textbook bicycle, and its parameters."""
    model, params = model_and_params("nominal")
    cost = control.tracking_cost(dt=PLANT.dt)
    return control.path_tracking(
        model, cost, law, dt=PLANT.dt, **LIMITS, **settings
    ), params


def mppi(law, **settings):
    """A tiny planner, and its parameters."""
    task, params = along_path(law)
    return control.mppi(
        task, num_samples=16, horizon=HORIZON, **BOX, **settings
    ), params


def searched(search, **settings):
    """The same by another search, and with slew limits."""
    task, params = along_path(FEEDBACK, control_rate=(0.5, 20.0))
    return search(task, horizon=HORIZON, **BOX, **settings), params


def delay_compensated():
    """For actuators two steps late."""
    controller, params = mppi(FEEDBACK)
    return control.delay_compensated(
        controller, model_and_params("nominal")[0], delay=2
    ), params


def monitored():
    """The same, watched, with a fallback that keeps on planning."""
    controller, params = mppi(FEEDBACK)
    boxes = {"state_low": (0.0,), "state_high": (30.0,)} | LIMITS | BOX
    watched = control.monitored(
        controller,
        model_and_params("nominal")[0],
        bounds=(1e-4,) * 4,
        fallback="slow",
        release=2,
        **boxes,
    )
    return watched, params


def shielded():
    """A planner in path coordinates, filtered; with a tiny model as it is drawn,
    folded.
    """
    law, limits = any_law(), LIMITS | BOX
    model = models.sfkd(path_space(), **TINY | {"budget": "joint"}, frame="path")
    task = control.following_law(
        model, control.tracking_cost(dt=PLANT.dt), law, dt=PLANT.dt, **LIMITS
    )
    planner = control.mppi(
        task, num_samples=16, horizon=HORIZON, noise_std=(0.01, 0.3), **BOX
    )
    filtered = control.shielded(
        planner, model, law, width=0.5, tube=0.2, horizon=8, **limits
    )
    return filtered, jit(partial(fold, model))(jit(model.init)(jax.random.key(0)))


def koopman_mpc():
    """Over a linear predictor with generic parameters."""
    model, params = model_and_params("koopman_mpc")
    return control.koopman_mpc(
        model, dt=PLANT.dt, horizon=HORIZON, **LIMITS, **BOX
    ), params


FEEDBACK = control.path_feedback(wheelbase=PLANT.wheelbase)
BUILDERS = {
    "mppi": partial(mppi, FEEDBACK),
    "mppi_plain": partial(mppi, control.no_feedback(), noise_std=(0.06, 0.6)),
    "mppi_smoothed": partial(mppi, FEEDBACK, smoothing_window=5),
    "mppi_knots": partial(
        mppi, FEEDBACK, noise="rbf", noise_knots=3, effective_samples=4.0, iterations=2
    ),
    "cem": partial(searched, control.cem, num_samples=16, elites=4, iterations=2),
    "gradient": partial(searched, control.gradient_planner, iterations=2, steps=4),
    "compensated": delay_compensated,
    "monitored": monitored,
    "shielded": shielded,
    "koopman_mpc": koopman_mpc,
}
"""Name -> () -> (controller, params), for `HORIZON` steps of the kinematic plant within
`LIMITS`.
"""
SAMPLING = (
    "mppi",
    "mppi_plain",
    "mppi_smoothed",
    "mppi_knots",
    "cem",
    "compensated",
    "monitored",
)
"""Those whose plan depends on the key."""

every = pytest.mark.parametrize("name", BUILDERS)
every_other = pytest.mark.parametrize(
    "name", [name for name in BUILDERS if name != "mppi"]
)
every_other_sampling = pytest.mark.parametrize(
    "name", [name for name in SAMPLING if name != "mppi"]
)


@cache
def compiled(name):
    """A controller by name, its parameters, its compiled act, and a list with an entry
    for every trace of it.
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
    """Controls and infos of eight steps in one scan, with blackouts and a car far off
    the road at the end.
    """
    controller, params = BUILDERS[name]()
    observations, envs = np.tile(OFFSET, (8, 1)), np.tile(ENV, (8, 1))
    observations[:, 1] -= 0.05 * np.arange(8)
    observations[BLACKOUTS["observation"]] = np.nan
    observations[BLACKOUTS["infinite"], 2] = np.inf
    envs[BLACKOUTS["env"], 1] = np.nan
    observations[7] = [50.0, -1e4, 3.0, 90.0]

    @jit
    def run(key):
        def step(state, inputs):
            action, state, info = controller.act(params, state, *inputs, REFERENCE)
            return state, (action, info, state)

        return jax.lax.scan(step, controller.init(key), (observations, envs))[1]

    return run(jax.random.key(0))


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
def test_an_episode_finds_in_info_what_it_records(name):
    """`simulate` reads it by name; only shapes are computed."""
    controller, params = BUILDERS[name]()
    road = scenarios.Scenario(
        jnp.asarray(OFFSET),
        *[jnp.tile(jnp.asarray(ENV), (7, 1))] * 2,
        scenarios.path_from_curvature(jnp.zeros(40), spacing=0.5),
        jnp.asarray(10.0),
    )
    simulate = partial(
        evaluation.simulate,
        PLANT.step,
        controller,
        params,
        dt=PLANT.dt,
        horizon=HORIZON,
    )
    episode = jax.eval_shape(simulate, road, jax.random.key(0))
    assert episode.controls.shape == (7, 2)
    for field in (
        "effective_samples",
        "healthy",
        "prediction_error",
        "breach",
        "box_exit",
    ):
        assert getattr(episode, field).shape == (7,)
    assert all(
        getattr(episode, flag).dtype == bool
        for flag in ("healthy", "breach", "box_exit")
    )


@every
def test_controls_are_finite_and_within_the_limits_whatever_is_seen(name):
    controls, info, _ = drive(name)
    low, high = np.float32(PLANT.control_low), np.float32(PLANT.control_high)
    assert np.all(np.isfinite(controls))
    assert np.all((low <= controls) & (controls <= high))
    assert info["predicted_states"].shape == (8, HORIZON, 4)


@every
def test_what_cannot_be_read_is_reported_and_the_next_clean_step_recovers(name):
    _, info, _ = drive(name)
    healthy = np.asarray(info["healthy"])[:7]
    assert list(np.flatnonzero(~healthy)) == list(BLACKOUTS.values())
    assert np.all(np.isfinite(np.asarray(info["predicted_states"])[:7][healthy]))


@every_other
def test_compiling_does_not_change_the_action(name):
    controller, params, _, _ = compiled(name)
    alone = controller.act(
        params,
        controller.init(jax.random.key(0)),
        *map(jnp.asarray, (OFFSET, ENV, REFERENCE)),
    )
    assert same(act_once(name), alone, rtol=1e-4, atol=1e-5)


@every_other
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
        rtol=1e-4,
        atol=1e-5,
    )
    assert len(np.unique(np.asarray(batch[0]), axis=0)) == 3


@every_other
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


@every_other_sampling
def test_the_same_key_makes_the_same_plan_and_another_key_another(name):
    first, again, other = (act_once(name, seed) for seed in (1, 1, 2))
    assert same(first, again, rtol=0, atol=0)
    for entry in ("cost", "predicted_states"):
        assert not np.array_equal(first[2][entry], other[2][entry])
    assert not np.array_equal(first[0], other[0])
