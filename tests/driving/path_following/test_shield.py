"""The safety filter: what passes, what it guarantees, and what it reports."""

from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law, jit, tiny

import sfkd_jax
from sfkd_jax import assembly
from sfkd_jax.certificate import Boxes, read
from sfkd_jax.control import FILTER_SCALES
from sfkd_jax.driving import path_following, paths, scenarios
from sfkd_jax.driving.certificate import (
    DrivingCertificate,
    JointBounds,
    LateCorridor,
    Recorded,
    RecordedConditions,
)
from sfkd_jax.driving.path_coordinates import PATH_FRAME, vehicle_state
from sfkd_jax.driving.path_following import Conditions, along_reference, corridor_filter
from sfkd_jax.driving.plants import kinematic
from sfkd_jax.geometry import without_pose
from sfkd_jax.info import ControllerInfo, PlanInfo, Reason
from sfkd_jax.latency import Latency
from sfkd_jax.policy import SHIPPED
from sfkd_jax.rollout import unfold
from sfkd_jax.types import BODY, Controller, Model

LAW = any_law()
ENV = jnp.asarray([0.6, 2.0])
LOW, HIGH = (-0.4, -5.0), (0.4, 5.0)
LIMIT = np.asarray(LAW.perturbation)
WIDTH, HORIZON, STEPS, SPEED = 0.2, 20, 300, 9.0
DISTURBANCE = np.asarray([0.002, 0.0005, 0.01])
"""Largest |d| per step of e_y [m], e_psi [rad], v [m/s]."""
A = np.asarray([[1.0, 0.9, 0.0], [-0.018, 0.82, 0.0], [0.0, 0.0, 0.9]])
B = np.asarray([[0.0, 0.0], [0.36, 0.0], [0.0, 0.1]])


def toy():
    """xi+ = A xi + B nu + (0, wind and curvature, v_ref / 10), in a latent whose unit
    depends on friction.
    """

    def step(env, latent, inputs):
        heading = 2e-4 * env[1] + 0.3 * inputs[2]
        push = jnp.stack([jnp.zeros(()), heading, 0.1 * inputs[3]])
        unit = 1.0 + env[0]
        moved = jnp.asarray(A) @ (latent / unit) + jnp.asarray(B) @ inputs[:2]
        return unit * (moved + push)

    return Model(
        init=lambda key: {},
        fiber=lambda params, env: env,
        encode=lambda env, state: (1.0 + env[0]) * state[BODY],
        step=step,
        decode=lambda env, latent: without_pose(latent / (1.0 + env[0])),
        transport=lambda env, after, latent: latent * (1.0 + after[0]) / (1.0 + env[0]),
        observe=lambda env, latent, state: (1.0 + env[0]) * state[BODY],
        vector=lambda latent: latent,
        frame=PATH_FRAME,
    )


TOY = toy()
POWERS = [np.linalg.matrix_power(A, k)[0] for k in range(STEPS)]
TUBE = 1.001 * float(sum(np.abs(row) @ DISTURBANCE for row in POWERS))
"""The largest possible |e_y - nominal e_y| after `STEPS` bounded disturbances, and a
margin for rounding.
"""
WORST = np.asarray([np.sign(row) * DISTURBANCE for row in reversed(POWERS)])
"""The disturbances that attain it at the last step."""


def circle(curvature=0.0, horizon=HORIZON, speed=SPEED):
    """A reference window along a circle through the origin."""
    ahead = speed * 0.1 * jnp.arange(1, horizon + 1)
    half = 0.5 * curvature * ahead
    chord = ahead * jnp.sinc(half / jnp.pi)
    points = chord * jnp.cos(half), chord * jnp.sin(half), 2 * half
    return jnp.stack([*points, jnp.full(horizon, speed)], axis=1)


def driven(xi, reference, progress):
    """The vehicle and its reference after `progress` metres along a straight road."""
    return vehicle_state(xi).at[0].add(progress), reference.at[:, 0].add(progress)


def about(xi, preview):
    """What the adapter needs of a planner."""
    ahead = jnp.tile(xi, (preview.road.shape[0], 1))
    return ControllerInfo(plan=PlanInfo(states=ahead))


def scripted():
    """A planner that adds params[k] to the law at step k."""

    def act(params, k, xi, env, preview):
        wanted = LAW(xi, *preview.road[0], env) + unfold(params)[k]
        return wanted, k + 1, about(xi, preview)

    return Controller(lambda key: jnp.zeros((), jnp.int32), act)


def filtered(**changes):
    options = {"inner": scripted(), "model": TOY, "law": LAW, "width": WIDTH}
    options |= {"tube": TUBE, "control": (LOW, HIGH)}
    shield = path_following.Shield(**options | changes)
    return gated(shield.controller(), conditions=shield.conditions)


def gated(inner, **changes):
    """A controller along a path behind the gate, in the world."""
    conditions = changes.pop("conditions", path_following.Conditions())
    prediction = path_following.Prediction(
        model=changes.pop("model", TOY), law=LAW, dt=0.1, conditions=conditions
    )
    options = {"prediction": prediction, "horizon": HORIZON}
    gate = path_following.Gate(inner=inner, **options | changes)
    return along_reference(gate.controller(), coordinates=3)


def drive(controller, script, disturbances, start=(0.0, 0.0, SPEED), seen=None):
    """xi before every step, controls and info of the disturbed toy; `seen` is 1 or NaN."""
    reference, env = circle(), ENV
    seen = jnp.ones(len(disturbances)) if seen is None else seen

    def step(carry, inputs):
        xi, memory, progress = carry
        disturbance, mask = inputs
        state, window = driven(xi, reference, progress)
        action, memory, info = controller.act(script, memory, state * mask, env, window)
        road = jnp.asarray([0.0, SPEED])
        nu = action - LAW(xi, *road, env)
        latent = TOY.encode(env, without_pose(xi))
        after = TOY.step(env, latent, jnp.concatenate([nu, road]))
        after = TOY.decode(env, after)[BODY] + disturbance
        return (after, memory, progress + 0.1 * xi[2]), (xi, action, info)

    carry = (jnp.asarray(start), controller.init(jax.random.key(0)), jnp.zeros(()))
    steps = jnp.asarray(disturbances, dtype=float), seen
    return jax.lax.scan(step, carry, steps)[1]


def scripts():
    """Adversarial planners, (script, step, 2)."""
    noise = np.random.default_rng(0)
    resonant = np.sign(np.sin(2 * np.pi * np.arange(STEPS) / 50))[:, None] * LIMIT
    return {
        "resonant": resonant,
        "bang-bang": noise.choice([-1.0, 1.0], (STEPS, 2)) * LIMIT,
        "constant": np.tile(LIMIT, (STEPS, 1)),
        "huge": np.tile([-1e6, 1e6], (STEPS, 1)),
        # Braking harder than the class would pass, and void the claim.
        "random": np.maximum(noise.uniform(-3, 3, (STEPS, 2)), (-3, -1)) * LIMIT,
        "nan": np.full((STEPS, 2), np.nan),
        "sometimes infinite": np.where(
            noise.random((STEPS, 1)) < 0.3, np.inf, resonant
        ),
    }


@cache
def attacked():
    """All of them against the worst disturbances: xi, controls, info by name."""
    named = scripts()
    together = jnp.asarray(np.stack(list(named.values())), dtype=float)
    tracks = jit(jax.vmap(lambda script: drive(filtered(), script, WORST)))(together)
    return {
        name: jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), tracks)
        for k, name in enumerate(named)
    }


@pytest.mark.parametrize("name", scripts())
def test_car_and_nominal_model_stay_in_their_corridors_whatever_is_planned(name):
    xi, controls, info = attacked()[name]
    assert np.all(np.isfinite(controls))
    assert np.max(np.abs(info.shield.nominal_state[:, 0])) <= WIDTH + 1e-6
    assert np.max(np.abs(xi[:, 0])) <= WIDTH + TUBE + 1e-5
    assert np.max(np.abs(xi[:, 0] - info.shield.nominal_state[:, 0])) <= TUBE
    assert np.all(np.abs(info.shield.perturbation) <= LIMIT)
    assert np.all(info.claim.reason == Reason.CERTIFIED)
    np.testing.assert_allclose(info.claim.bound, WIDTH + TUBE, rtol=1e-6)
    if name == "nan":  # the tube is not far too wide
        assert abs(xi[-1, 0] - info.shield.nominal_state[-1, 0]) > 0.99 * TUBE
    # The preview is constant, so the filter has already predicted the law's next steps.
    assert np.all(info.shield.margin >= 0.0)
    assert np.array_equal(info.claim.holds, np.ones(STEPS, bool))


def test_without_the_filter_the_same_planners_leave_the_corridor():
    names = ("resonant", "constant", "huge")
    clipped = np.stack([np.clip(scripts()[name], -LIMIT, LIMIT) for name in names])
    alone = partial(drive, along_reference(scripted(), coordinates=3))
    xi, _, _ = jit(jax.vmap(lambda script: alone(script, WORST)))(jnp.asarray(clipped))
    assert np.all(np.max(np.abs(xi[:, :, 0]), axis=1) > 1.5 * (WIDTH + TUBE))
    for name in names:
        assert np.sum(attacked()[name][2].shield.intervention > 0.0) > 10


def test_who_asks_for_little_is_left_alone():
    """Up to the rounding of another program."""
    script, reference = jnp.tile(0.05 * jnp.asarray(LIMIT), (40, 1)), circle()
    xi, controls, info = jit(partial(drive, filtered()))(
        script, jnp.zeros((40, 3)), (0.05, 0.0, 8.0)
    )
    planner = along_reference(scripted(), coordinates=3)
    memory = planner.init(jax.random.key(0))
    planned = jit(
        jax.vmap(
            lambda xi: planner.act(script, memory, vehicle_state(xi), ENV, reference)[0]
        )
    )(xi)
    np.testing.assert_allclose(controls, planned, rtol=1e-6)
    np.testing.assert_allclose(info.shield.perturbation, script, atol=1e-6)
    assert not np.any(info.shield.intervention)
    # Of bounds that are not the vehicle's own nothing is claimed, and all is driven.
    unclaimed = jit(partial(drive, filtered(claimed=False)))
    _, again, info = unclaimed(script, jnp.zeros((40, 3)), (0.05, 0.0, 8.0))
    np.testing.assert_array_equal(again, controls)
    assert np.all(np.isnan(info.claim.bound))


def margin_of(xi, nu, road):
    """The margin from its definition, in float64."""
    largest = 0.0
    for k in range(HORIZON):
        push = np.asarray([0.0, 2e-4 * float(ENV[1]) + 0.3 * road[0], 0.1 * road[1]])
        xi = A @ xi + B @ (nu if k == 0 else np.zeros(2)) + push
        largest = max(largest, abs(xi[0]))
    return WIDTH - largest


ROAD = np.asarray([0.002, SPEED])
filter_from = jit(
    partial(
        corridor_filter,
        TOY,
        ENV,
        preview=jnp.tile(jnp.asarray(ROAD), (HORIZON, 1)),
        width=WIDTH,
    )
)


def apply_filter(xi, nu, limit=LIMIT):
    latent = 1.6 * jnp.asarray(xi, dtype=float)
    return filter_from(
        latent, jnp.asarray(nu, dtype=float), limit=jnp.asarray(limit, dtype=float)
    )


def test_the_largest_scale_that_keeps_the_nominal_model_inside_is_chosen():
    random = np.random.default_rng(1)
    scales = []
    for _ in range(100):
        edge, heading = random.uniform(0.6, 1.0) * WIDTH, random.uniform(-0.02, 0.02)
        xi, nu = np.asarray([edge, heading, SPEED]), random.uniform(-1, 1, 2) * LIMIT
        shares = FILTER_SCALES
        margins = np.asarray([margin_of(xi, share * nu, ROAD) for share in shares])
        if np.min(np.abs(margins)) < 1e-5 or np.max(margins) < 0:
            continue
        result = apply_filter(xi, nu)
        first = np.argmax(margins >= 0)
        scales.append(shares[first])
        assert float(result.scale) == shares[first]
        np.testing.assert_allclose(result.nu, shares[first] * nu, rtol=1e-6)
        np.testing.assert_allclose(result.margin, margins[first], atol=1e-6)
        assert bool(result.feasible)
    assert 1.0 in scales
    assert 0.0 in scales
    assert len(set(scales)) > 4


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("lateral", "enough"), [(0.15, True), (0.17, False)])
def test_where_the_law_alone_leaves_the_corridor_the_nominal_model_is_steered_back(
    lateral, enough, side
):
    """Heading outward near the edge, one step of the largest steering is sufficient or
    an improvement.
    """
    xi = np.asarray([side * lateral, side * 0.03, SPEED])
    alone, back = margin_of(xi, np.zeros(2), ROAD), -side * LIMIT * (1, 0)
    result = apply_filter(xi, LIMIT * (side, 1.0))
    assert alone < min(0.0, margin_of(xi, back, ROAD))
    np.testing.assert_allclose(result.nu, back)
    np.testing.assert_allclose(result.margin, margin_of(xi, back, ROAD), atol=1e-6)
    assert bool(result.feasible) == enough
    assert float(result.scale) == 0.0


def test_what_is_not_finite_is_never_applied():
    lost = apply_filter([np.nan, 0.0, SPEED], LIMIT)
    np.testing.assert_array_equal(lost.nu, np.zeros(2))
    assert float(lost.margin) == -np.inf
    assert not bool(lost.feasible)
    for nu in ([np.nan, 0.5], [0.01, np.inf]):
        result = apply_filter([0.0, 0.0, SPEED], nu)
        np.testing.assert_array_equal(result.nu, np.zeros(2))
        assert bool(result.feasible)


def test_a_second_without_observations_is_driven_by_the_nominal_model():
    seen = jnp.ones(60).at[20:30].set(jnp.nan)
    disturbances = DISTURBANCE * np.random.default_rng(2).choice([-1.0, 1.0], (60, 3))
    resonant = jnp.asarray(scripts()["resonant"][:60], dtype=float)
    xi, controls, info = jit(partial(drive, filtered()))(
        resonant, disturbances, seen=seen
    )
    assert list(np.flatnonzero(info.claim.reason == Reason.NOT_MEASURED)) == list(
        range(20, 30)
    )
    # At 30 the nominal model starts anew, and there is nothing to compare.
    unknown = np.flatnonzero(np.isnan(info.shield.nominal_distance))
    assert list(unknown) == [0, *range(20, 31)]
    assert not np.any(info.claim.holds[20:30])
    assert np.all(np.isfinite(controls))
    # It may start outside its corridor, and is steered back before anything is claimed.
    nominal = np.abs(info.shield.nominal_state[:, 0])
    claimed = np.asarray(info.claim.holds)
    assert np.all(nominal[claimed] <= WIDTH + 1e-6)
    assert np.all(np.abs(xi[:, 0]) <= WIDTH + TUBE)
    assert np.all(claimed[40:])


def test_a_switch_of_the_environment_moves_nominal_model_and_car_alike():
    """The latent is transported to the new fibre: its unit changes, its state does not.
    Gaps in e are bridged.
    """
    envs = jnp.tile(ENV, (40, 1)).at[10:].set(jnp.asarray([0.3, -6.0]))
    observed_envs = envs.at[20:25, 1].set(jnp.nan)
    controller = filtered()
    quiet = jnp.zeros((40, 2))
    reference = circle()
    xi, memory = jnp.asarray([0.1, 0.0, SPEED]), controller.init(jax.random.key(0))
    act, distances, inside = jit(controller.act), [], []
    for k in range(40):
        seen, window = driven(xi, reference, 0.1 * SPEED * k)
        action, memory, info = act(quiet, memory, seen, observed_envs[k], window)
        assert np.all(np.isfinite(action))
        distances.append(float(jnp.abs(xi - info.shield.nominal_state)[0]))
        inside.append(bool(info.env_inside))
        inputs = jnp.concatenate([info.shield.perturbation, jnp.asarray([0.0, SPEED])])
        xi = TOY.decode(
            envs[k], TOY.step(envs[k], TOY.encode(envs[k], without_pose(xi)), inputs)
        )[BODY]
    assert max(distances) < 1e-6
    assert list(np.flatnonzero(~np.asarray(inside))) == list(range(20, 25))


def test_a_car_outside_its_bound_is_reported_and_followed():
    """Displaced by 0.4 m: the bound is exceeded once, then the nominal model is there."""
    kick = np.zeros((20, 3))
    kick[9, 0] = 0.4
    controller = filtered(width=1.0, noise_allowance=0.01)
    xi, _, info = jit(partial(drive, controller))(jnp.zeros((20, 2)), kick)
    np.testing.assert_array_equal(
        np.flatnonzero(info.claim.reason == Reason.BOUND_EXCEEDED), [10]
    )
    np.testing.assert_allclose(info.shield.nominal_distance[10], 0.4, atol=1e-4)
    np.testing.assert_allclose(info.shield.nominal_state[10:], xi[10:], atol=1e-4)
    assert not info.claim.holds[10]


def test_outside_a_box_the_law_drives_alone():
    """The certificate does not apply there; inside the boxes the same request passes."""
    conditions = Conditions(
        state=((-5.0, -1.0, 0.0), (5.0, 1.0, SPEED + 1.5)),
        road=((-0.1, 0.0), (0.005, 12.0)),
        env=((0.0, -8.0), (0.8, 8.0)),
    )
    wanted = jnp.tile(0.1 * jnp.asarray(LIMIT), (2, 1))
    controller = filtered(conditions=conditions)
    act, memory = jit(controller.act), controller.init(jax.random.key(0))
    inside = {"state": jnp.asarray([0.0, 0.005, SPEED + 1.0])}
    inside |= {"env": ENV, "road": circle(0.002)}
    strayed = {"state": jnp.asarray([0.0, 0.005, SPEED + 2.0])}
    strayed |= {"env": jnp.asarray([0.9, 2.0]), "road": circle(0.01)}
    for name in (None, *strayed):
        seen = inside | ({name: strayed[name]} if name else {})
        observed = vehicle_state(seen["state"]), seen["env"], seen["road"]
        _, _, info = act(wanted, memory, *observed)
        outside = name is not None
        expected = Reason.OUTSIDE_BOX if outside else Reason.CERTIFIED
        assert Reason(int(info.claim.reason)) == expected
        assert bool(info.claim.holds) != outside
        expected = 0 * LIMIT if outside else wanted[0]
        np.testing.assert_allclose(info.shield.perturbation, expected, atol=1e-6)
        assert float(info.shield.intervention) == float(outside)
        assert bool(info.env_inside) == (name != "env")


def test_before_anything_is_seen_the_planner_passes_within_the_limits():
    silent = Controller(
        lambda key: (),
        lambda params, state, xi, env, ahead: (params, (), about(xi, ahead)),
    )
    controller = filtered(inner=silent, control=((-0.4, 0.5), HIGH), width=1.0)
    act, start = jit(controller.act), controller.init(jax.random.key(0))
    xi, reference = vehicle_state(jnp.asarray([0.1, 0.0, SPEED])), circle()
    # What is planned, and what passes of it.
    cases = [([0.1, 0.7],) * 2, ([9.0, 0.7], [0.4, 0.7]), ([np.nan, 1.0], [0.0, 0.5])]
    for seen in ((xi * jnp.nan, ENV, reference), (xi, ENV, reference * jnp.nan)):
        for planned, passed in cases:
            action, after, info = act(jnp.asarray(planned), start, *seen)
            np.testing.assert_allclose(action, passed)
            assert not bool(after.inner.inner.nominal.started | info.claim.holds)
            unreadable = not np.all(np.isfinite(seen[2]))
            reason = Reason.BAD_REFERENCE if unreadable else Reason.NOT_MEASURED
            assert Reason(int(info.claim.reason)) == reason
            assert np.isnan(float(info.shield.margin))
    _, after, info = act(jnp.asarray([0.1, 0.7]), after, xi, ENV, reference)
    assert bool(after.inner.inner.nominal.started & info.claim.holds)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"width": float("nan")}, r"width must be in \(0, inf\)"),
        ({"tube": float("inf")}, r"tube must be in \(0, inf\)"),
        ({"horizon": 0}, r"horizon must be in \[1, inf\)"),
        ({"control": ((0.5, -5.0), HIGH)}, "the box of control needs 2 lower limits"),
        (
            {"conditions": Conditions(env=((0.9, 0.0), (0.3, 1.0)))},
            "the box of env needs 2 lower limits below 2 upper ones",
        ),
        ({"model": tiny()}, r"model\.frame=path"),
    ],
)
def test_invalid_settings_are_refused_in_one_line(changes, line):
    with pytest.raises(ValueError, match=line) as refusal:
        filtered(**changes)
    assert "\n" not in str(refusal.value)


def test_the_box_of_a_certificate_holds_its_corridor(monkeypatch):
    """A data set on one side of the path must not put the other side outside."""
    certificate = read(
        SHIPPED / "kinematic_path" / "certificate.json", DrivingCertificate
    )
    bounds = replace(
        certificate.corridor.bounds, nominal=0.08, vehicle_to_nominal_position=0.06
    )
    corridor = replace(
        certificate.corridor,
        bounds=bounds,
        corridor_m=0.14,
        late_sensors=(),
        late_controls=(),
        conditions=replace(
            certificate.corridor.conditions, sensor_noise=(0.01, 0.01, 0.002)
        ),
    )
    boxes = Boxes(
        state=((-0.05, -0.1, 7.0), (0.4, 0.1, 11.0)),
        env=((0.3, -8.0), (0.9, 8.0)),
        control=((-0.03, -1.0, -0.02, 8.0), (0.03, 1.0, 0.02, 10.0)),
    )
    measured = replace(certificate.measured, boxes=boxes)
    made, shield = {}, path_following.Shield
    record = lambda **options: made.update(options) or shield(**options)
    monkeypatch.setattr(path_following, "Shield", record)
    in_corridor = partial(assembly.in_corridor, scripted(), TOY, kinematic(), LAW)

    def build_with(corridor, **options):
        corridor = replace(certificate, measured=measured, corridor=corridor)
        in_corridor(corridor, **options)

    build_with(corridor)
    low, high = made["conditions"].state
    # Other coordinates have the box of the data and a quarter of its width.
    assert low == pytest.approx((-0.17, -0.15, 6.0))
    assert high == pytest.approx((0.4, 0.15, 12.0))
    expected = (0.08, 0.06, pytest.approx(0.03))
    assert (made["width"], made["tube"], made["noise_allowance"]) == expected
    # A vehicle that is later has the tube that was measured for it.
    wider = JointBounds(
        nominal=0.09, vehicle_to_nominal_position=0.11, vehicle_to_nominal_yaw=0.0
    )
    row = LateCorridor(later_s=0.2, bounds=wider, coverage=corridor.coverage)
    late = replace(corridor, late_controls=(row,))
    build_with(late)
    assert made["tube"] == 0.06
    assert made["late"] == ((0.0, 0.06), (2.0, pytest.approx(0.12)))
    build_with(late, latency=Latency((0.1,), (0.05,)))
    assert made["claimed"]
    assert made["tube"] == pytest.approx(0.12)
    # One that is less late than stated has that of the corridor on time.
    on_time = (pytest.approx(-1.5), 0.06)
    assert made["late"] == (on_time, (pytest.approx(0.5), pytest.approx(0.12)))
    build_with(late, latency=Latency((0.3,)))
    assert not made["claimed"]
    # Where only the sensors are later, e is known in time.
    bounds = replace(wider, vehicle_to_nominal_position=0.08)
    late = replace(late, late_sensors=(replace(row, bounds=bounds),))
    build_with(late, latency=Latency((0.2,)))
    assert made["tube"] == pytest.approx(0.09)
    assert made["late"] == ((-2.0, 0.06), (0.0, pytest.approx(0.09)))
    build_with(late, latency=Latency((), (0.2,)))
    assert made["tube"] == pytest.approx(0.12)
    # It is never narrower than that of a vehicle on time.
    bounds = replace(wider, vehicle_to_nominal_position=0.0, nominal=0.0)
    late = replace(late, late_controls=(replace(row, bounds=bounds),))
    build_with(late, latency=Latency((), (0.2,)))
    assert made["tube"] == 0.06
    # Measured on a model of logs, it claims nothing of the car before its own runs do.
    identified = replace(corridor.conditions, identified_from="contents")
    corridor = replace(corridor, conditions=identified)
    build_with(corridor)
    assert not made["claimed"]
    recorded = Recorded(
        bounds=JointBounds(
            nominal=0.08, vehicle_to_nominal_position=0.1, vehicle_to_nominal_yaw=0.1
        ),
        corridor_m=0.18,
        level=0.8,
        conditions=RecordedConditions(
            runs=9, contents="", duration_s=60.0, lateral_m=0.1
        ),
    )
    build_with(replace(corridor, recorded=recorded))
    assert (made["claimed"], made["tube"]) == (True, 0.1)


BOX = Conditions(state=((-0.3, -0.1, 8.0), (0.3, 0.1, 10.0)))
"""Where the toy's model predicts; a step may be off by a share of half its widths."""


def told(tamper, steps=120, disturbances=None, lag=None, begins=None, **changes):
    """True xi and info where the vehicle's state is told wrong: (observation, k) -> it,
    or late: k -> steps; or where the reference begins elsewhere: k -> m.
    """
    lag = lag or (lambda k: 0)
    begins = begins or (lambda k: 0.0)
    inner = path_following.Shield(
        inner=scripted(),
        model=TOY,
        law=LAW,
        width=WIDTH,
        tube=TUBE,
        start_error=0.05,
        control=(LOW, HIGH),
        conditions=BOX,
    ).controller()
    controller = gated(inner, conditions=BOX, **changes)
    script, road = jnp.zeros((steps, 2)), jnp.asarray([0.0, SPEED])
    random = np.random.default_rng(3).choice([-0.3, 0.3], (steps, 3))
    pushed = jnp.asarray(random * DISTURBANCE if disturbances is None else disturbances)

    def step(carry, inputs):
        (xi, past, memory), (k, push) = carry, inputs
        past = jnp.concatenate([xi[None], past[:-1]])
        late, window = driven(past[lag(k)], circle(), 0.1 * SPEED * k)
        # The reference goes on with the vehicle: what is late lies behind.
        seen = tamper(late.at[0].add(-0.1 * SPEED * lag(k)), k)
        window = window.at[:, 0].add(begins(k))
        action, memory, info = controller.act(script, memory, seen, ENV, window)
        nu = action - LAW(xi, *road, ENV)
        after = A @ xi + B @ nu + jnp.asarray([0.0, 2e-4 * ENV[1], 0.1 * SPEED])
        return (after + push, past, memory), (xi, info)

    start = jnp.asarray([0.0, 0.0, SPEED])
    carry = start, jnp.tile(start, (12, 1)), controller.init(jax.random.key(0))
    return jit(lambda: jax.lax.scan(step, carry, (jnp.arange(steps), pushed))[1])()


def between(k, first, last):
    return (first <= k) & (k < last)


FAULTS = {
    "jump": lambda o, k: o.at[1].add(jnp.where(between(k, 40, 58), 3.0, 0.0)),
    "half a meter": lambda o, k: o.at[1].add(jnp.where(between(k, 40, 45), 0.5, 0.0)),
    "yaw": lambda o, k: o.at[2].add(jnp.where(between(k, 40, 58), jnp.pi, 0.0)),
    "behind": lambda o, k: o.at[:2].add(jnp.where(between(k, 40, 58), -5.0, 0.0)),
    "alternating": lambda o, k: o.at[1].add(jnp.where(k % 2 == 0, 2.0, 0.0) * (k > 40)),
    "frozen": lambda o, k: jnp.where(between(k, 40, 50), jnp.arange(4.0) / 8, o),
    "standing still": lambda o, k: o.at[0].set(
        jnp.where(between(k, 40, 50), 0.1 * SPEED * 39 + 0.02 * (k % 2), o[0])
    ),
    "silent": lambda o, k: jnp.where(between(k, 40, 50), jnp.nan, o),
    "infinite": lambda o, k: jnp.where(between(k, 40, 50), jnp.inf, o),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_one_step_cannot_explain_is_not_followed(name):
    xi, info = told(FAULTS[name])
    lost = np.asarray(info.claim.reason == Reason.NOT_MEASURED)
    assert np.max(np.abs(xi[:, 0])) < 0.1
    assert lost.any()
    assert np.all(np.flatnonzero(lost) >= 40)
    # No claim and no health while something is not measured, and both afterwards.
    assert not np.any(info.healthy[lost])
    assert np.all(np.isnan(np.asarray(info.claim.bound)[lost]))
    assert np.all(np.asarray(info.healthy)[~lost])
    if name == "jump":
        # The heading is still measured, the position is not.
        assert (
            np.asarray(info.gate.measured)[lost].tolist() == [[False, True, True]] * 18
        )


def heading_test():
    """The test of innovations of a toy whose heading is within 10 deviations."""
    size = jnp.full((len(path_following.WINDOWS), 4), jnp.inf)
    test = path_following.InnovationTest(
        levels=jnp.zeros(1),
        deviation=0.002 * jnp.ones((1, 4)),
        threshold=size.at[0, 1].set(10.0),
    )
    return path_following.MeasurementTests(innovation=test)


@pytest.mark.parametrize("angle", [-0.05, 0.03])
def test_a_yaw_that_is_wrong_by_a_little_is_not_followed(angle):
    """The limit of a whole box would let it pass, and the vehicle follow it."""

    def turned(o, k):
        return o.at[2].add(jnp.where(between(k, 40, 80), angle, 0.0))

    xi, info = told(turned, tests=heading_test())
    trusting, _ = told(turned)
    lost = np.asarray(info.claim.reason == Reason.NOT_MEASURED)
    assert np.all(lost == between(np.arange(len(lost)), 40, 80))
    assert np.max(np.abs(xi[:, 0])) < 0.5 * np.max(np.abs(trusting[:, 0]))
    measured = np.asarray(info.gate.measured)[lost]
    assert np.all(measured == [True, False, True])


def test_a_yaw_is_measured_while_a_position_is_wrong():
    """Its noise is no reason to refuse it."""

    def jumped(o, k):
        noise = 1e-3 * (1.0 - 2.0 * (k % 2))
        return FAULTS["jump"](o, k).at[2].add(noise)

    _, info = told(jumped, tests=heading_test())
    lost = np.asarray(info.claim.reason == Reason.NOT_MEASURED)
    assert np.asarray(info.gate.measured)[lost].tolist() == [[False, True, True]] * 18


def test_a_vehicle_that_really_turned_is_believed_once_its_position_shows_it():
    """As after a push on ice. Then nothing is claimed for a while."""
    pushed = np.zeros((200, 3))
    pushed[40, 1] = 0.05
    xi, info = told(lambda o, k: o, 200, pushed, tests=heading_test())
    lost = np.flatnonzero(info.claim.reason == Reason.NOT_MEASURED)
    assert lost[0] == 41
    assert lost[-1] < 41 + 15
    assert info.claim.reason[lost[-1] + 1] == Reason.TRIAL
    assert np.all(info.gate.measured[lost[-1] + 1 :])
    np.testing.assert_allclose(xi[-1, :2], xi[40, :2], atol=0.01)


BEGINNINGS = {
    "once 4 m ahead": lambda k: jnp.where(k == 50, 4.0, 0.0),
    "4 m ahead from then on": lambda k: jnp.where(k >= 50, 4.0, 0.0),
    "at way-points 5 m apart": lambda k: -jnp.mod(0.1 * SPEED * k, 5.0),
}


@pytest.mark.parametrize("name", BEGINNINGS)
def test_a_reference_may_begin_anywhere(name):
    """The place of a vehicle is known in the world, and not by its reference."""
    xi, info = told(lambda o, k: o, begins=BEGINNINGS[name])
    usual, _ = told(lambda o, k: o)
    assert np.all(info.gate.measured)
    assert np.all(info.healthy)
    np.testing.assert_allclose(xi, usual, atol=2e-3)


def test_in_its_own_frame_a_vehicle_does_not_stand_still():
    """Pose 0, and a reference relative to the vehicle, as the planner of a robot has."""
    controller = gated(scripted(), conditions=BOX)
    act, state = jit(controller.act), controller.init(jax.random.key(0))
    for _ in range(8):
        seen = vehicle_state(jnp.asarray([0.0, 0.0, SPEED]))
        _, state, info = act(jnp.zeros((8, 2)), state, seen, ENV, circle())
        # With noise of the speed, since what repeats itself is frozen.
        state = state._replace(
            observations=state.observations.at[:, 3].add(1e-3),
        )
        assert np.all(info.gate.measured)


def test_a_model_that_nothing_is_known_of_overrules_no_measurement():
    def wrong(env, latent, inputs):
        return TOY.step(env, latent, inputs) + jnp.asarray([0.0, 1.0, 0.0])

    controller = gated(scripted(), model=TOY._replace(step=wrong))
    _, _, info = drive(controller, jnp.zeros((50, 2)), np.zeros((50, 3)))
    assert np.all(info.gate.measured)


def test_a_delay_is_recognised_and_made_up_for_far_beyond_the_patience():
    """Under a push that would drive a car without measurements off its path."""
    push = np.tile(0.5 * DISTURBANCE * [0.0, 1.0, 0.0], (160, 1))
    late = partial(told, lambda o, k: o, 160, push)
    for lag in (3, 10):
        xi, info = late(lambda k, lag=lag: jnp.where(between(k, 40, 90), lag, 0))
        assert np.all(
            (info.claim.reason == Reason.NOT_MEASURED)
            == between(np.arange(160), 40, 90)
        )
        assert not np.any(info.healthy[40:90])
        assert np.max(np.abs(xi[:, 0])) < 0.1
    blind = lambda o, k: jnp.where(between(k, 40, 90), jnp.nan, o)
    assert np.max(np.abs(told(blind, 160, push, patience=9.0)[0][:, 0])) > 0.2


def test_after_its_patience_a_measurement_is_believed_and_nothing_claimed_for_a_while():
    xi, info = told(FAULTS["jump"], patience=1.0, trial=3.0)
    believed = 40 + 10
    assert np.asarray(info.claim.reason == Reason.NOT_MEASURED)[40:believed].all()
    assert np.asarray(info.gate.measured)[believed].all()
    # True again at 58, but not before its patience: only then the trial begins anew.
    assert np.max(np.abs(xi[:believed, 0])) < 0.1
    assert np.max(np.abs(xi[:, 0])) < 3.1
    assert not np.any(info.claim.holds[40 : believed + 30])


def test_an_alarm_ends_the_claim_outlasts_a_blind_sensor_and_ends_with_its_cause():
    """A push of the heading over 2 s, each step as small as the class's own."""
    pushed = np.random.default_rng(3).choice([-0.3, 0.3], (160, 3)) * DISTURBANCE
    pushed[40:60, 1] += 0.6 * DISTURBANCE[1]
    weights = np.asarray(path_following.WINDOWS)[:, None]
    test = path_following.InnovationTest(
        levels=jnp.zeros(1),
        deviation=jnp.asarray([*DISTURBANCE, DISTURBANCE[1]], float)[None],
        # The law knows no turn of the toy.
        threshold=jnp.asarray(
            1.8 * np.sqrt(weights / (2.0 - weights)) * [1.0, 1.0, 1.0, np.inf]
        ),
    )
    blind = lambda o, k: jnp.where(between(k, 61, 66), jnp.nan, o)
    tests = path_following.MeasurementTests(innovation=test)
    _, info = told(blind, steps=160, disturbances=pushed, tests=tests)
    alarm = np.asarray(info.gate.alarm)
    assert not alarm[:41].any()
    assert alarm[55:66].all()
    assert not alarm[140:].any()
    assert not np.any(info.healthy[alarm])
    assert np.isnan(np.asarray(info.claim.bound)[alarm]).all()
    assert np.all(np.isfinite(np.asarray(info.claim.bound)[140:]))
    assert np.all(info.healthy[140:])


def test_who_is_blind_for_good_brakes():
    xi, info = told(lambda o, k: jnp.where(k < 40, o, jnp.nan), steps=140)
    assert not np.any(info.healthy[40:])
    # The toy's law wants back to the old speed; the car slows down all the same.
    assert xi[-1, 2] < 6.0


def test_the_bound_of_a_start_at_a_measurement_decays_to_the_certified_one():
    _, info = told(lambda o, k: o, steps=60)
    corridor = np.asarray(info.claim.bound)
    expected = WIDTH + TUBE + 0.05 * 0.9 ** np.arange(60)
    np.testing.assert_allclose(corridor, expected, rtol=1e-5)


def test_of_a_vehicle_that_is_later_the_bound_of_that_delay_is_claimed():
    """Nothing is claimed where none is known."""
    earlier = 0.2
    wider = 0.3
    options = {"tube": TUBE, "late": ((-1.0, earlier), (0.0, TUBE), (1.0, wider))}
    options |= {"inner": scripted(), "model": TOY, "law": LAW, "width": WIDTH}
    shield = path_following.Shield(control=(LOW, HIGH), **options).controller()

    @jit
    def claim(later):
        def act(params, state, xi, env, preview):
            return shield.act(params, state, xi, env, preview._replace(later=later))

        controller = gated(Controller(shield.init, act))
        start = controller.init(jax.random.key(0))
        seen = vehicle_state(jnp.asarray([0.1, 0.0, SPEED]))
        script = jnp.zeros((1, 2))
        return controller.act(script, start, seen, ENV, circle())[2].claim

    tubes = ((-1.0, earlier), (0.0, TUBE), (0.5, wider), (1.0, wider))
    for later, tube in tubes:
        bound = claim(jnp.asarray(later)).bound
        np.testing.assert_allclose(bound, WIDTH + tube, rtol=1e-6)
    for unknown in (1.5, -2.0):
        nothing = claim(jnp.asarray(unknown))
        assert nothing.reason == Reason.NOT_CALIBRATED
        assert np.isnan(nothing.bound)


def test_before_the_first_environment_the_law_drives_with_the_middle_of_its_box():
    conditions = Conditions(env=((0.2, -8.0), (1.0, 8.0)))
    controller = filtered(conditions=conditions)
    start, xi = controller.init(jax.random.key(0)), jnp.asarray([0.1, 0.0, SPEED])
    action, _, info = jit(controller.act)(
        jnp.zeros((1, 2)), start, vehicle_state(xi), jnp.full(2, jnp.nan), circle()
    )
    road = jnp.asarray([0.0, SPEED])
    wanted = LAW(xi, *road, jnp.asarray([0.6, 0.0]))
    np.testing.assert_allclose(action, wanted, rtol=1e-6)
    assert not bool(info.healthy)
    assert not bool(info.env_inside)


def test_braking_passes_and_the_steering_stays_with_the_filter():
    script = jnp.tile(jnp.asarray([0.4, -4.0]), (3, 1))
    xi, controls, info = jit(partial(drive, filtered()))(script, jnp.zeros((3, 3)))
    road = jnp.asarray([0.0, SPEED])
    for k in range(3):
        steering, drive_of_law = LAW(xi[k], *road, ENV)
        assert abs(controls[k, 0] - steering) <= LIMIT[0] + 1e-6
        np.testing.assert_allclose(controls[k, 1], drive_of_law - 4.0, rtol=1e-5)
    assert np.all(info.claim.reason == Reason.BRAKING)
    assert not np.any(info.healthy)
    assert np.all(np.isnan(info.claim.bound))


def test_another_call_rate_is_not_healthy():
    planner = Controller(
        lambda key: _Timed(jnp.asarray(1.0)),
        lambda params, state, xi, env, ahead: (
            LAW(xi, *ahead.road[0], env),
            state,
            about(xi, ahead),
        ),
    )
    controller = filtered(inner=planner)
    start, xi = controller.init(jax.random.key(0)), jnp.asarray([0.1, 0.0, SPEED])
    for elapsed, healthy in ((1.0, True), (2.0, False), (0.2, False), (np.nan, True)):
        gate = start.inner
        late = gate.inner._replace(inner=_Timed(jnp.asarray(elapsed)))
        state = start._replace(inner=gate._replace(inner=late))
        _, _, info = jit(controller.act)({}, state, vehicle_state(xi), ENV, circle())
        assert bool(info.healthy) == healthy
        assert np.isfinite(info.claim.bound) == healthy


class _Tuning(NamedTuple):
    elapsed: jax.Array


class _Timed(NamedTuple):
    elapsed: jax.Array

    @property
    def tuning(self):
        return _Tuning(self.elapsed)


@pytest.mark.parametrize("car", ["dynamic", "kinematic"])
def test_a_car_stops_stands_and_starts_again_in_a_corridor_that_rolls_with_it(car):
    """From 10 m/s at 2.5 m/s², in S3's schedule, with sensor noise and a hard planner."""
    policy = sfkd_jax.load(f"{car}_path")
    plant, law, count = policy.vehicle, policy.law, len(policy.vehicle.state_names)

    def follows(params, memory, xi, env, preview):
        control = law(xi, *preview.road[0], env) + 0.3 * LIMIT
        return control, memory, about(xi, preview)

    planner = Controller(lambda key: (), follows)
    shielded = policy.shield(planner, along_path=True)
    time = 0.1 * np.arange(200)
    stop = np.clip(10.0 - 2.5 * (time - 1.5), 0.0, 10.0)
    speed = np.where(time < 12.5, stop, np.clip(2.0 * (time - 12.5), 0.0, 8.5))
    # Where the reference is at those times; the window is that of 20 steps later.
    along = np.cumsum(0.05 * (speed + np.roll(speed, 1)) * (time > 0.0))
    noise = jnp.asarray([0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001][:count])
    sample = scenarios.scenario(name="s3", duration=18.5, state_size=count, dt=0.1)

    def run(key):
        road, sensors = sample(key), jax.random.split(key, 179)
        at = jax.vmap(paths.point_at, in_axes=(None, 0))
        points = at(road.path, jnp.asarray(along, jnp.float32))
        points = points.at[:, 3].set(jnp.asarray(speed, jnp.float32))

        def step(carry, k):
            state, memory = carry
            window = jax.lax.dynamic_slice_in_dim(points, k + 1, HORIZON)
            foot = paths.project(road.path, state[:2], jnp.asarray(along)[k])
            seen = state + noise * jax.random.normal(sensors[k], state.shape)
            action, memory, info = shielded.act(
                policy.params, memory, seen, road.envs[k], window
            )
            after = plant.step(state, action, road.envs[k])
            told = info.claim.bound, info.shield.rolling, info.claim.holds
            return (after, memory), (*foot, state[3], *told)

        start = road.initial_state, shielded.init(key)
        return jax.lax.scan(step, start, jnp.arange(179))[1]

    seeds = jax.random.split(jax.random.key(5), 4)
    foot, left, moving, corridor, rolling, holds = map(
        np.asarray, jit(jax.vmap(run))(seeds)
    )
    # Standing from 7.5 s on: 5 s, while the sensors say that it moves either way.
    assert moving[:, 75:125].max() < 0.02
    assert np.all(np.abs(foot[:, 125] - foot[:, 75]) < 0.01)
    assert moving[:, -1].min() > 7.6
    assert holds[:, 1:].all()  # a first reading may be farther off than the strip is
    assert np.all(np.abs(left[:, 1:]) <= corridor[:, 1:])
    # The bound grows while it rolls, not while it stands, and is forgotten afterwards.
    grown = rolling[:, 125]
    assert np.all((grown > 0.0) & (grown < 0.2))
    assert np.all(grown - rolling[:, 75] < 0.005)
    assert np.all(rolling[:, -1] == 0.0)
