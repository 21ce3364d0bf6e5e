"""What `sfkd_jax.load` returns: it drives, is tuned, and refuses what does not fit it in
words about the right cause.
"""

import pickle
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import optimised, same, straight

import sfkd_jax
from sfkd_jax import control, policy
from sfkd_jax.driving import path_following
from sfkd_jax.info import ControllerInfo, PlanInfo, Reason
from sfkd_jax.types import Controller

KEY, ENV = jax.random.key(0), jnp.asarray([0.7, 0.0])
VEHICLES = sorted(entry.name for entry in policy.SHIPPED.iterdir())
load = cache(lambda name, **options: policy.load(policy.SHIPPED / name, **options))


def start(vehicle):
    """On a straight road at 10 m/s."""
    return jnp.zeros(4 if vehicle.startswith("kinematic") else 7).at[3].set(10.0)


def test_shipped_policies_also_work_with_an_estimated_environment():
    """And are tuned in flight, however deep the planner lies, without a compilation."""
    trained = load("kinematic_path", env_source="estimated")
    act, state = jax.jit(trained.controller.act), trained.controller.init(KEY)
    known = trained.params, state, jnp.asarray([0.0, 0.3, 0.0, 10.0])
    control_1, _, info = act(*known, jnp.full(2, jnp.nan, float), straight(20))
    other, after, _ = act(*known, jnp.asarray([0.3, 8.0]), straight(20))
    np.testing.assert_array_equal(control_1, other)
    # Nothing has moved yet.
    np.testing.assert_allclose(info.adaptation.env, [0.6, 0.0], atol=1e-4)
    tuned = control.tuned(after, noise_std=[1e-6, 1e-6], elapsed=2)
    assert type(tuned) is type(after)
    _, later, quiet = act(trained.params, tuned, known[2], ENV, straight(20))
    assert act._cache_size() == 1
    # All samples are the plan itself, but that of the law alone.
    np.testing.assert_allclose(quiet.plan.cost, quiet.plan.mean_cost, rtol=1e-2)
    with pytest.raises(ValueError, match="unknown entry of tuning temprature"):
        control.tuned(later, temprature=1.0)
    with pytest.raises(ValueError, match="holds no state of a planner"):
        control.tuned((), elapsed=1.0)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_printed_it_says_where_it_applies_and_what_of_it_is_proved(vehicle):
    trained = load(vehicle)
    document, text = trained.certificate, repr(trained)
    assert len(text.splitlines()) <= 10
    # Anybody can print it, whatever the encoding of the output.
    assert text.isascii()
    for fact in ("p_x [m]", "steering [rad] -0.5 to 0.5", "-6 to 3", "-8 to 8"):
        assert fact in text
    (proved,) = (line for line in text.splitlines() if "proved" in line)
    (measured,) = (line for line in text.splitlines() if "measured, unsigned" in line)
    assert f"alpha {document.proof.alpha:.4f}" in proved
    assert f"{document.measured.d_bar.one_step['latent']:.3g}" in measured
    if "_" in vehicle:
        curvature = "curvature [1/m] -0.05 to 0.05"
        for fact in ("v_ref [m/s] 3 to 12", curvature, "each for 3 to 6 s"):
            assert fact in text
        assert f"{document.corridor.corridor_m:.3f} m" in measured
    assert "nothing is proved" in repr(replace(trained, certificate=None))


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_arguments_of_another_shape_are_refused_by_name(vehicle):
    trained = load(vehicle)
    act = partial(trained.controller.act, trained.params, trained.controller.init(KEY))
    x, r = start(vehicle), straight(20)
    for wrong, name in (
        ((jnp.zeros(11 - x.size), ENV, r), r"observation .*p_x, p_y, yaw, v.*got"),
        ((x[None], ENV, r), "observation"),
        ((x, jnp.zeros(3), r), r"env must have shape \(2,\), got \(3,\)"),
        ((x, ENV, r[:10]), r"reference must have shape \(20, 4\)"),
    ):
        with pytest.raises(ValueError, match=name):
            jax.eval_shape(act, *wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"adaptive": True}, "^adaptation .* need a model in path coordinates"),
        ({"env_source": "estimated"}, "^adaptation .* need a model in path coord"),
        ({"env_source": "estimate"}, "^env_source must be measured or estimated"),
        ({"env_source": "none"}, "^env_source must .* reads .*, got 'none'"),
        ({"controller": {"planner": "mpi"}}, "^unknown controller.planner .mpi"),
    ],
)
def test_what_the_caller_asked_for_is_not_blamed_on_the_file(options, message):
    with pytest.raises(ValueError, match=message):
        policy.load(policy.SHIPPED / "kinematic", **options)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("numpy_rank_promotion", "raise"), ("numpy_dtype_promotion", "strict")],
)
def test_strict_numerics_of_the_caller_reach_no_policy(setting, value, caplog):
    """Nor are there more programs than weights, explicit weights, limits and state."""
    policy._trained._built_from_json.cache_clear()
    inputs = start("kinematic"), ENV, straight(20)
    with getattr(jax, setting)(value), jax.log_compiles():
        trained = policy.load(policy.SHIPPED / "kinematic_path")
        state, act = trained.controller.init(KEY), trained.controller.act
        jax.eval_shape(act, trained.params, state, *inputs)
    assert 3 <= sum("XLA compilation of" in text for text in caplog.messages) <= 5


def scripted(controls):
    """A planner in the world that gives these controls one after another, whatever it
    sees.
    """

    def act(params, memory, observation, env, reference):
        script, k = memory
        return script[k], (script, k + 1), {"mine": observation[0]}

    return Controller(lambda key: (controls, jnp.zeros((), int)), act)


@pytest.mark.parametrize("vehicle", ["dynamic_path", "kinematic_path"])
def test_any_planner_stays_in_the_corridor_behind_the_shield(vehicle):
    """On the true plant, while friction and wind jump; one program for all planners."""
    trained, steps, draw = load(vehicle), 150, np.random.default_rng(0)
    swerving = np.sign(np.sin(2 * np.pi * np.arange(steps) / 40))
    scripts = {
        "nothing": np.full((steps, 2), np.nan),
        "garbage": 10.0 ** draw.uniform(-3, 30, (steps, 2)) * draw.choice([-1, 1], 2),
        "full lock": np.tile([0.5, 0.0], (steps, 1)),
        "swerving": np.stack([swerving, 0.0 * swerving], 1),
        "coasting": np.zeros((steps, 2)),
    }
    controls = jnp.asarray(np.stack([*scripts.values()]), jnp.float32)
    envs = jnp.asarray([[0.9, 8.0], [0.3, 8.0], [0.3, -8.0], [0.6, 0.0]])
    plant = trained.vehicle

    @jax.jit
    @jax.vmap
    def drive(script):
        shielded = trained.shield(scripted(script))

        def step(carry, k):
            x, memory = carry
            e, road = envs[k // 40], straight(20, speed=9.5).at[:, 0].add(x[0])
            u, memory, info = shielded.act(trained.params, memory, x, e, road)
            return (plant.step(x, u, e), memory), (x[1], info)

        begin = start(vehicle).at[3].set(9.5), shielded.init(KEY)
        return jax.lax.scan(step, begin, jnp.arange(steps))[1]

    lateral, info = drive(controls)
    worst = np.max(np.abs(lateral), axis=1)
    assert np.all(worst <= trained.certificate.corridor.corridor_m), worst
    assert not np.any(info.healthy[0])
    assert np.all(worst[2:4] > 0.02)  # as far as the filter lets them
    assert info.planner["mine"].shape == lateral.shape


def test_what_planners_add_to_the_model_reaches_no_shield():
    """And of what is not finite the law drives, inside the corridor."""
    trained, x = load("kinematic_path"), start("kinematic").at[1].set(0.05)
    shielded = trained.shield(scripted(jnp.tile(jnp.asarray([0.1, 0.0]), (20, 1))))
    act, shielded_act = jax.jit(trained.controller.act), jax.jit(shielded.act)
    told, memory, weights = [], trained.controller.init(KEY), trained.params.weights
    for size in (0.0, 1.0, 1e30, np.nan):
        more = jax.tree.map(lambda leaf, size=size: leaf + size, weights["planning"])
        params = trained.params._replace(weights={**weights, "planning": more})
        control, _, info = shielded_act(
            params, shielded.init(KEY), x, ENV, straight(20)
        )
        # What the gate expects of the next step is the planners' prediction.
        told.append((control, info))
        u, _, info = act(params, memory, x, ENV, straight(20))
        assert bool(info.claim.holds)
        assert float(info.shield.margin) > 0.0
        if not size < 1e30:
            assert not bool(info.healthy)
            xi, road = jnp.asarray([0.05, 0.0, 10.0]), jnp.asarray([0.0, 10.0])
            np.testing.assert_allclose(u, trained.law(xi, *road, ENV), atol=1e-5)
    assert all(same(one, told[0], rtol=0, atol=0) for one in told[1:])


def test_a_planner_in_a_shield_sees_what_the_gate_believes():
    """The observation bit for bit, or where the car would be, if that has jumped."""
    trained = load("kinematic_path")
    plan = lambda params, state, x, env, road: (jnp.zeros(2), state, {"seen": x})
    shielded = trained.shield(Controller(lambda key: (), plan))
    state, act = shielded.init(KEY), jax.jit(shielded.act)
    x, faults = start("kinematic").at[1].set(0.05), {3: [0.0, 3.0, 0.0, 0.0]}
    faults |= {4: [-7.0, 1.0, 0.3, 0.0], 5: [np.nan] * 4}
    for k in range(7):
        told = x + jnp.asarray(faults.get(k, [0.0] * 4))
        road = straight(20).at[:, 0].add(x[0])
        u, state, info = act(trained.params, state, told, ENV, road)
        most = np.asarray([0.1, 0.1, 0.1, 0.15]) * (k in faults)
        np.testing.assert_array_less(np.abs(info.planner["seen"] - x), most + 1e-6)
        x = trained.vehicle.step(x, u, ENV)


def test_a_shield_needs_a_corridor_and_a_control_of_the_vehicle():
    with pytest.raises(ValueError, match="no certified corridor"):
        load("dynamic").shield(scripted(jnp.zeros((1, 2))))
    trained = load("kinematic_path")
    inputs = start("kinematic"), ENV, straight(20)
    wide, own = map(trained.shield, (scripted(jnp.zeros((1, 3))), trained.controller))
    with pytest.raises(ValueError, match=r"control has shape \(2,\), got \(3,\)"):
        jax.eval_shape(wide.act, trained.params, wide.init(KEY), *inputs)
    _, state, info = jax.eval_shape(own.act, trained.params, own.init(KEY), *inputs)
    assert jax.tree.structure(state) == jax.tree.structure(own.init(KEY))
    assert info.plan.states.shape == (20, 4)
    lawful = path_following.in_the_world(scripted(jnp.zeros((1, 2))))
    along = trained.shield(lawful, along_path=True)
    jax.eval_shape(along.act, trained.params, along.init(KEY), *inputs)


@pytest.mark.parametrize("vehicle", ["kinematic", "kinematic_path"])
def test_a_policy_drives_on_earth_as_it_does_at_the_origin(vehicle):
    """On a road of any yaw, told in float64; in float32 alone it says that it cannot."""
    trained = load(vehicle)
    act, step = optimised(trained.controller.act), jax.jit(trained.vehicle.step)

    def drive(far, yaw, convert):
        turn = np.asarray([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

        def away(points):
            points = np.asarray(points, np.float64)
            turned = points[..., :2] @ turn + far
            return np.concatenate([turned, points[..., 2:3] + yaw, points[..., 3:]], -1)

        x, state = start(vehicle).at[1].set(0.25), trained.controller.init(KEY)
        errors = []
        for k in range(25):
            ahead = np.add(straight(20), [float(k), 0.0, 0.0, 0.0])
            seen, ahead, _ = convert(away(x), away(ahead))
            u, state, info = act(trained.params, state, seen, ENV, ahead)
            x = step(x, u, ENV)
            errors.append(float(x[1]))
        precise = Reason(int(info.claim.reason)) != Reason.IMPRECISE
        assert precise == bool(info.healthy)
        return np.sqrt(np.mean(np.square(errors))), precise

    home, _ = drive(np.zeros(2), 0.0, sfkd_jax.relative)
    utm = np.asarray([500000.13, 4500000.23])
    there, precise = drive(utm, 0.7, sfkd_jax.relative)
    assert precise
    assert there <= 1.01 * home
    assert not drive(utm, 0.7, lambda *places: (*places, None))[1]


def test_positions_are_relative_before_the_cast_and_reported_in_the_world():
    trained = load("kinematic_path")

    def act(params, state, observation, env, reference):
        info = ControllerInfo(plan=PlanInfo(states=jnp.tile(observation, (2, 1))))
        return reference[0, :2] - observation[:2], state, info

    echo = policy._calling.entrance(Controller(lambda key: key, act), trained)
    near = np.float64(straight(20))
    far = np.add(near, [5e5 + 0.13, 4.5e6, 0.0, 0.0])
    expected = near[0, :2] - near[1, :2]
    ahead, _, info = echo.act({}, (), far[1], ENV, far)
    np.testing.assert_allclose(ahead, expected, atol=1e-4)
    np.testing.assert_allclose(info.plan.states[0], far[1], atol=1e-4)
    with jax.enable_x64(True):
        ahead, _, info = jax.jit(echo.act)({}, (), far[1], ENV, far)
        np.testing.assert_allclose(ahead, expected, atol=1e-4)
        np.testing.assert_allclose(info.plan.states[0], far[1], atol=1e-4)
    # A reference that is not finite moves nothing; near the origin nothing changes.
    assert not sfkd_jax.relative(far[1], np.nan * far)[2].any()
    kept = sfkd_jax.relative(near[1], near)
    np.testing.assert_array_equal(kept[1], near)
    with jax.debug_nans(True), pytest.raises(ValueError, match="jax_debug_nans"):
        echo.init(KEY)
    with pytest.raises(TypeError, match="load it in that process"):
        pickle.dumps(trained)
