"""A system from its equations to a certified policy, every way to spoil it, and its uses."""

import json
import shutil
import subprocess
import sys
from functools import partial

import composing
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import proofs
import pytest
from documents import hashed
from helpers import put, refusal_of
from hub import served
from loops import DT, FASTEST, LIMIT, frame, loop, mass, pushed, tracked

import sfkd_jax
from experiments.systems import share_back
from sfkd_jax import export
from sfkd_jax.adapters import GymnasiumShield
from sfkd_jax.experiment.system_runs import compared, drive_beside_rivals, first_run
from sfkd_jax.experiment.systems import certify_system
from sfkd_jax.export import __main__ as exporting
from sfkd_jax.export import _proof
from sfkd_jax.info import ControllerInfo, PlanInfo, Reason
from sfkd_jax.policy import SystemPolicy, is_system, restore_system, save_system
from sfkd_jax.report.system import COMPARISON, FIRST_RUN, write_system_report
from sfkd_jax.schedules import random_switching
from sfkd_jax.store import ArtefactError
from sfkd_jax.systems import ClosedLoop, random_reference, spread_of
from sfkd_jax.tubes import measure_tubes
from sfkd_jax.types import Controller

SETTINGS = {
    "rate": 0.86,
    "points": 3,
    "segments": 0.02,
    "steps": 50,
    "runs": 40,
    "duration": 6.0,
    "samples": 16,
    "horizon": 5,
}
STEPS = 60
FILES = ("system.safetensors", "certificate.json", "settings.json")


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """The run directory, and the policy as it was returned."""
    root = tmp_path_factory.mktemp("systems") / "mass"
    return root, certify_system(mass(), frame(), root=root, **SETTINGS)


@pytest.fixture
def copied(certified, tmp_path):
    """A copy of the run directory to spoil."""
    for name in FILES:
        shutil.copy(certified[0] / name, tmp_path / name)
    return tmp_path


def test_the_policy_is_loaded_with_its_verified_certificate(certified):
    root, policy = certified
    for name in FILES:
        assert (root / name).is_file()
    assert is_system(root)
    again = sfkd_jax.load(root)
    assert isinstance(again, SystemPolicy)
    assert again.certificate == policy.certificate
    assert again.reference_names == ("x", "v")
    assert again.outputs == ("position",)
    assert again.horizon == SETTINGS["horizon"]
    lines = repr(again).splitlines()
    assert len(lines) <= 10
    assert repr(again).isascii()
    bounds = again.certificate.tubes.outputs["position"]
    assert f"|position| <= {bounds.total:.4g} m" in lines[-1]
    assert bounds.total == bounds.tube + bounds.nominal
    assert 0.86 - 0.05 < again.certificate.proof.alpha < 1.0


def test_it_is_loaded_from_the_hub_as_it_was_pushed(certified, tmp_path):
    policy = certified[1]
    with served(tmp_path) as hub:
        address = policy.push("someone/mass")
        again = sfkd_jax.load(address)
        files = hub.files("someone/mass")
    assert {".gitattributes", "README.md", *FILES} - set(files) == {"settings.json"}
    assert again.certificate == policy.certificate
    assert again.sha256 == policy.sha256
    state = policy.controller.init(jax.random.key(0))
    given = state, jnp.asarray([0.01, 0.0]), jnp.asarray([1.0, 0.2]), jnp.zeros((6, 2))
    first, second = (
        jax.jit(each.controller.act)(each.params, *given)[0] for each in (policy, again)
    )
    np.testing.assert_array_equal(first, second)
    assert "under: mass [kg] 0.8 to 1.2" in files["README.md"].decode()


def test_starts_come_back_if_the_controls_allow_it(certified):
    _, policy = certified
    near = policy.certificate.tubes.outputs["position"].total
    starts = {"x": (-3.0 * near, 3.0 * near), "v": (-0.1, 0.1)}
    share = partial(share_back, policy, mass(), duration=5.0, runs=8)
    assert share(starts) == 1.0
    # Within 5 s the force moves the mass by 4 / 0.8 * 5**2 / 4 m at most.
    assert share({"x": (40.0, 50.0)}) == 0.0


def written(root):
    """When each file of a run was written, but for its lock."""
    return {
        path: path.stat().st_mtime_ns
        for path in root.rglob("*")
        if not path.name.startswith(".lock")
    }


def test_the_same_call_does_nothing_and_another_is_refused(certified):
    root, policy = certified
    before = written(root)
    again = certify_system(mass(), frame(), root=root, **SETTINGS)
    assert again.certificate == policy.certificate
    assert written(root) == before

    def heavier(state, control, env):
        return pushed(state, 0.9 * control, env)

    others = {
        "seed": lambda: certify_system(mass(), frame(), root=root, **SETTINGS, seed=1),
        "step": lambda: certify_system(mass(heavier), frame(), root=root, **SETTINGS),
        "dwell": lambda: certify_system(
            mass(), frame(dwell=(1.0, 2.0)), root=root, **SETTINGS
        ),
        "mass": lambda: certify_system(
            mass(environment={"mass [kg]": (0.8, 1.3), "wind [N]": (-0.5, 0.5)}),
            frame(),
            root=root,
            **SETTINGS,
        ),
    }
    for named, other in others.items():
        line = refusal_of(other)
        assert line is not None, named
        assert "was made with other settings" in line
        assert named in line


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"points": 1}, "points"),
        ({"steps": 0}, "steps"),
        ({"steps": 40}, "steps"),
        ({"segments": -1.0}, "segments"),
        ({"segments": float("nan")}, "segments"),
        ({"rate": 1.0}, "rate"),
        ({"level": 0.0}, "level"),
        ({"dwell": (2.0, 1.0)}, "dwell"),
        ({"duration": 0.01}, "duration"),
        ({"runs": 5}, "runs"),
        ({"perturbation": 0.0}, "perturbation"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_done(
    changed, named, tmp_path
):
    root = tmp_path / "run"
    settings = {**SETTINGS, **changed}
    line = refusal_of(lambda: certify_system(mass(), frame(), root=root, **settings))
    assert line is not None
    assert named in line
    assert not root.exists()


def forged(run, path, value):
    """Change an entry of a certificate, with the hash that belongs to it."""
    file = run / "certificate.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(hashed(put(document, path, value))))
    return refusal_of(lambda: sfkd_jax.load(run))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("tubes.outputs.position.tube", 1e-4, "position.total"),
        ("tubes.outputs.position.total", 1e-4, "position.total"),
        ("tubes.conditions.perturbation", [0.1], "perturbation"),
        ("tubes.conditions.input_box", [[-2.0], [2.0]], "input_box"),
        ("tubes.conditions.env_box", [[0.8, -0.5], [1.3, 0.5]], "env_box"),
        ("tubes.conditions.sensor_noise", [0.0, 0.0], "sensor_noise"),
        ("tubes.conditions.sensor_noise", [0.001], "sensor_noise"),
        ("tubes.conditions.reference_dwell_s", [1.0, 2.0], "reference_dwell_s"),
        ("tubes.conditions.env_dwell_s", [9.0, 10.0], "env_dwell_s"),
        ("tubes.conditions.duration_s", 60.0, "duration_s"),
        ("tubes.level", 0.99, "level"),
        ("tubes.runs", 4000, "runs"),
        ("proof.alpha", 0.5, "alpha"),
    ],
)
def test_a_forged_certificate_is_refused(path, value, named, copied):
    line = forged(copied, path, value)
    assert line is not None
    assert named in line


def test_a_certificate_changed_by_hand_is_refused(copied):
    file = copied / "certificate.json"
    document = json.loads(file.read_text())
    tube = 0.5 * document["tubes"]["outputs"]["position"]["tube"]
    changed = put(document, "tubes.outputs.position.tube", tube)
    file.write_text(json.dumps(changed))
    assert refusal_of(lambda: sfkd_jax.load(copied)) is not None
    outputs = document["tubes"]["outputs"]
    renamed = put(document, "tubes.outputs", {"height": outputs["position"]})
    file.write_text(json.dumps(hashed(renamed)))
    line = refusal_of(lambda: sfkd_jax.load(copied))
    assert line is not None
    assert "tubes.outputs must be position" in line
    file.unlink()
    line = refusal_of(lambda: sfkd_jax.load(copied))
    assert line is not None
    assert "certificate.json" in line


@pytest.mark.parametrize("table", ["gain", "control", "state", "perturbation", "low"])
def test_another_law_needs_another_certificate(table, copied):
    trained = restore_system(copied)
    law = trained.loop.law
    changed = law._replace(**{table: 1.05 * getattr(law, table) + 0.01})
    save_system(
        copied / "system.safetensors", trained.params, changed, trained.settings
    )
    line = refusal_of(lambda: sfkd_jax.load(copied))
    assert line is not None
    assert "certify again" in line


def test_other_settings_in_the_file_need_another_certificate(copied):
    trained = restore_system(copied)
    path = copied / "system.safetensors"
    for entry, value in (
        ("system.controls", {"force [N]": [-9.0, 9.0]}),
        ("system.dt", 0.2),
        ("frame.outputs", {"position": ["v"]}),
        ("controller.horizon", 7),
    ):
        changed = put(trained.settings, entry, value)
        save_system(path, trained.params, trained.loop.law, changed)
        line = refusal_of(lambda: sfkd_jax.load(copied))
        assert line is not None, entry
    save_system(
        path,
        trained.params,
        trained.loop.law._replace(gain=jnp.zeros((3, 3, 3, 1, 1))),
        trained.settings,
    )
    line = refusal_of(lambda: sfkd_jax.load(copied))
    assert line is not None
    assert "tables of the law" in line


def test_the_bounds_hold_on_fresh_runs(certified):
    policy = certified[1]
    of = ClosedLoop(loop().tracked, policy.loop.law)
    spread = spread_of(of, jax.random.key(1), steps=100, dwell=(1.0, 4.0))
    measured = measure_tubes(
        of,
        policy.model,
        policy.params,
        policy.certificate.proof.outputs,
        jax.random.key(77),
        spread=spread,
        runs=100,
        duration=6.0,
    )
    assert 0.86 <= measured.coverage.share <= 1.0
    before = policy.certificate.tubes.outputs["position"]
    after = measured.outputs["position"]
    assert 0.5 * before.tube < after.tube < 2.0 * before.tube
    assert after.system <= after.total


def driven(controller, policy, key, step=pushed):
    """The true system behind a controller: ξ, u and what it reports."""
    of = tracked()
    reference_key, env_key, noise_key, key = jax.random.split(key, 4)
    horizon = policy.horizon
    drawn = random_reference(of, reference_key, steps=STEPS + horizon)
    low, high = of.system.env_box
    envs = random_switching(
        env_key, steps=STEPS, dt=DT, low=low, high=high, dwell=(1.0, 4.0)
    )
    noise = jnp.asarray(of.system.sensor_noise)

    def body(carry, time):
        state, memory = carry
        ahead = jax.lax.dynamic_slice_in_dim(drawn.points, time, horizon + 1)
        off = noise * jax.random.normal(jax.random.fold_in(noise_key, time), (2,))
        u, memory, info = controller.act(
            policy.params, memory, state + off, envs[time], ahead
        )
        after = step(state, jnp.clip(u, -LIMIT, LIMIT), envs[time])
        return (after, memory), (of.coordinates(state, ahead[0]), u, info)

    first = (drawn.points[0], controller.init(key))
    return jax.lax.scan(body, first, jnp.arange(STEPS))[1]


def check(run, policy):
    """No step is beyond its claim, and there are claims."""
    errors, controls, info = jax.tree.map(np.asarray, run)
    assert np.all(np.isfinite(controls))
    claims = info.claim.bound[..., 0]
    held = np.isfinite(claims)
    assert held.mean() > 0.5
    assert np.all(np.abs(errors[..., 0][held]) <= claims[held])
    total = policy.certificate.tubes.outputs["position"].total
    np.testing.assert_allclose(claims[held], total, rtol=1e-5)


def test_the_controller_keeps_its_claims_around_the_true_system(certified):
    policy = certified[1]
    run = jax.jit(jax.vmap(partial(driven, policy.controller, policy)))
    check(run(jax.random.split(jax.random.key(3), 6)), policy)


def test_any_planner_can_be_shielded(certified):
    policy = certified[1]

    def act(params, state, error, env, inputs):
        u = jnp.where(state // 9 % 2, LIMIT, -LIMIT)[None]
        u = jnp.where(state % 5 == 4, jnp.nan, u)
        return u, state + 1, ControllerInfo(plan=PlanInfo(healthy=jnp.asarray(True)))

    own = policy.shield(Controller(lambda key: jnp.zeros((), int), act))
    run = jax.jit(jax.vmap(partial(driven, own, policy)))
    check(run(jax.random.split(jax.random.key(4), 6)), policy)


def test_arguments_of_another_shape_are_refused(certified):
    policy = certified[1]
    controller = policy.controller
    state = controller.init(jax.random.key(0))
    good = (jnp.zeros(2), jnp.asarray([1.0, 0.0]), jnp.zeros((6, 2)))
    for index, bad, named in (
        (0, jnp.zeros(3), "observation must have shape (2,): x, v"),
        (1, jnp.zeros(1), "env must have shape (2,): mass [kg], wind [N]"),
        (2, jnp.zeros((6, 1)), "reference must have shape (horizon + 1, 2): x, v"),
        (2, jnp.zeros((5, 2)), "reference must have"),
    ):
        given = [*good]
        given[index] = bad
        line = refusal_of(
            lambda given=given: controller.act(policy.params, state, *given)
        )
        assert line is not None
        assert named in line


def test_a_wrong_system_is_noticed(certified):
    policy = certified[1]

    def windy(state, control, env):
        return pushed(state, control + 0.4, env)

    run = partial(driven, policy.controller, policy, step=windy)
    errors, _, info = jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(5)))
    claims = info.claim.bound[:, 0]
    held = np.isfinite(claims)
    assert held.mean() < 0.5
    assert np.all(np.abs(errors[held, 0]) <= claims[held])
    noticed = {Reason.BOUND_EXCEEDED, Reason.OUTSIDE_BOX}
    assert noticed & set(info.claim.reason.tolist())


def test_a_reference_that_jumps_is_not_certified(certified):
    """Its places do not follow from its velocities."""
    policy = certified[1]
    controller = policy.controller
    state = controller.init(jax.random.key(0))
    act = jax.jit(controller.act)
    env = jnp.asarray([1.0, 0.0])
    still = jnp.zeros((6, 2))
    _, state, info = act(policy.params, state, jnp.zeros(2), env, still)
    assert info.claim.reason == Reason.CERTIFIED
    jumps = still.at[3:, 0].set(0.5)
    _, state, info = act(policy.params, state, jnp.zeros(2), env, jumps)
    assert info.claim.reason == Reason.BAD_REFERENCE
    assert np.all(np.isnan(info.claim.bound))
    for spoilt in (still.at[0, 0].set(jnp.nan), still.at[4, 0].set(jnp.nan)):
        u, state, info = act(policy.params, state, jnp.zeros(2), env, spoilt)
        assert info.claim.reason == Reason.BAD_REFERENCE
        assert np.all(np.isfinite(u))


def test_the_law_of_a_file_is_that_of_the_run(certified):
    law = certified[1].loop.law
    for mine, stored in zip(loop().law, law, strict=True):
        np.testing.assert_allclose(mine, stored, rtol=1e-4, atol=1e-5)
    assert float(jnp.max(jnp.abs(law.low - jnp.asarray([-FASTEST, 0.8, -0.5])))) < 1e-6


SCRIPT = """
import sys, json, numpy as np
from run_controller import ExportedController

controller = ExportedController(".")
state = controller.init(seed=0)
found = []
for given in zip(*json.loads(sys.stdin.read())):
    u, state, info = controller.act(state, *(np.asarray(a, float) for a in given))
    found.append([*u.tolist(), *np.atleast_1d(info.claim.bound).tolist()])
assert "sfkd_jax" not in sys.modules
print(json.dumps(found))
"""
"""Steps an export with the inputs from stdin."""


def inputs(steps=4):
    """Of a few steps: states, e, and a reference that stands still."""
    rng = np.random.default_rng(1)
    states = rng.normal(size=(steps, 2)).astype(np.float32) * 0.01
    envs = np.asarray([[1.0, 0.2]] * steps, np.float32)
    return states, envs, np.zeros((steps, SETTINGS["horizon"] + 1, 2), np.float32)


def test_an_export_repeats_every_step_in_a_process_without_this_package(certified):
    root, policy = certified
    run = composing.run(f"root={root.parent}", "name=mass", "system=nowhere:make")
    written = exporting.main(run)
    folder = root / "export"
    assert written["policy"] == str(folder / "system.safetensors")
    given = json.dumps([values.tolist() for values in inputs()])
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input=given,
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    state = policy.controller.init(jax.random.key(0))
    act = jax.jit(policy.controller.act)
    expected = []
    for x, e, r in zip(*inputs(), strict=True):
        u, state, info = act(policy.params, state, x, e, r)
        expected.append([*np.asarray(u), *np.atleast_1d(info.claim.bound)])
    np.testing.assert_allclose(json.loads(result.stdout), expected, atol=1e-5)
    # It steps itself too, and is read like the run.
    stepped = subprocess.run(
        [sys.executable, "run_controller.py", "--steps", "2"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(stepped.stdout)["names"] == ["force [N]"]
    again = sfkd_jax.load(folder)
    assert again.certificate.tubes == policy.certificate.tubes
    with pytest.raises(ValueError, match=r"export.lane is for vehicles"):
        export.write_controller(policy, folder, lane=(10, 1, 1))


@proofs.needs_compiler
def test_the_proof_of_a_system_is_accepted_in_c(certified, tmp_path):
    _, policy = certified
    proof = _proof.exported_proof(policy)
    program = proofs.compiled(tmp_path)
    (accepted,), (lines,) = proofs.verdicts(program, [proof], tmp_path)
    assert accepted
    assert lines[0] == f"proved about the weights {policy.weights_sha256}"
    assert lines[1:] == [
        f"{name}: alpha {claim.alpha:.17g}, L {claim.lipschitz:.17g}"
        for name, claim in policy.certificate.proof.outputs.items()
    ]


def test_the_page_says_what_the_certificate_says(certified):
    root, policy = certified
    page = root / "report" / "index.html"
    write_system_report(root)
    assert "comparison.json is missing" in page.read_text("utf-8")
    driven = drive_beside_rivals(policy, mass(), runs=2, duration=3.0)
    (root / COMPARISON).write_text(json.dumps(compared(driven)), "utf-8")
    (root / FIRST_RUN).write_text(json.dumps(first_run(policy, driven)), "utf-8")
    pages = write_system_report(root)
    text = page.read_text("utf-8")
    bounds = policy.certificate.tubes.outputs["position"]
    for shown in (
        f"{bounds.total:.3g}",
        f"{bounds.tube:.3g}",
        f"{policy.certificate.proof.alpha:.4f}",
        "position [m]",
        "e: mass [kg]",
        "reference: rate of v",
    ):
        assert shown in text, shown
    assert any("first_run" in picture for picture in pages["figures"])
    with pytest.raises(ArtefactError, match=r"train system=… makes a run"):
        write_system_report(root.parent)


class MassEnv(gymnasium.Env):
    """The mass as an environment of gymnasium, whose actions are shares of the force."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(2)
        return self.x, {}

    def step(self, action):
        env = jnp.asarray([1.0, 0.3])
        self.x = np.asarray(pushed(self.x, self.control(action), env))
        return self.x, 0.0, False, False, {}

    def situation(self):
        return self.x, np.asarray([1.0, 0.3]), np.zeros((SETTINGS["horizon"] + 1, 2))

    def control(self, action):
        return LIMIT * np.asarray(action)

    def action(self, control):
        return np.asarray(control) / LIMIT


def test_random_actions_stay_within_the_bounds_behind_the_shield(certified):
    _, policy = certified
    env = GymnasiumShield(MassEnv(), policy)
    unshielded = MassEnv()
    env.reset(seed=0)
    unshielded.reset(seed=0)
    rng = np.random.default_rng(0)
    total = policy.certificate.tubes.outputs["position"].total
    farthest = 0.0
    claims = []
    for _ in range(round(8.0 / DT)):
        action = rng.choice([-1.0, 1.0], p=[0.4, 0.6], size=1)
        state, _, _, _, info = env.step(action)
        unshielded.step(action)
        claims.append(info["reason"] == Reason.CERTIFIED)
        if claims[-1]:
            assert abs(state[0]) <= info["claim"][0] == pytest.approx(total)
        assert abs(state[0]) <= 3.0 * total
        farthest = max(farthest, info["intervention"])
    assert np.mean(claims) > 0.5
    assert farthest > 0.5
    assert abs(unshielded.x[0]) > 10.0 * total
