"""What is exported runs without this package, to the last bit, and a damaged file is
named in one line.
"""

import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import composing
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, SHARES, dataset, jit, space, straight

import sfkd_jax
from sfkd_jax import assembly, certification, policy, store
from sfkd_jax import export as exporting
from sfkd_jax.certificate import Boxes, Provenance, Refusal, read, write
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.lanes import Lane, Obstacles
from sfkd_jax.driving.paths import Path as Road
from sfkd_jax.export import __main__ as export
from sfkd_jax.types import Controller

HORIZON, STEPS = 5, 6
SMALL = (
    "+experiment=smoke",
    "model.rank=8",
    "model.vertices=3",
    *(f"model.{name}=[8]" for name in ("residual_hidden", "decoder_hidden")),
    *("model.encoder_hidden=8", "model.embedding=4"),
    *("controller.mppi.num_samples=16", f"controller.mppi.horizon={HORIZON}"),
)
BOXES = Boxes(
    state=((0.0,), (20.0,)),
    control=((-0.5, -5.0), (0.5, 5.0)),
    env=(ENV_LOW, ENV_HIGH),
)
HEAVY = {"sfkd_jax", "flax", "hydra", "optax", "jaxtyping", "matplotlib", "iree"}


def run(root, *overrides):
    return composing.run(*SMALL, f"root={root}", *overrides)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A certified run with weights as they were drawn; what the command wrote and printed."""
    requested = run(tmp_path_factory.mktemp("export") / "runs")
    chosen = requested.settings
    params = jit(assembly.build_model(chosen.model, space(), requested.plant).init)(
        jax.random.key(0)
    )
    stored = store.plain(vars(chosen) | {"space": space()._asdict()})
    stored["dataset"] |= {"segments": 120, "shares": SHARES}
    requested.claim()
    run_dir = requested.directory
    policy.save(
        run_dir / "policy.safetensors", params, stored, made_from={"dataset": "d" * 64}
    )
    trained, data = policy.restore(run_dir), dataset()
    splits = {
        "validation": data.validation,
        "calibration": data.calibration,
        "held_out": dict.fromkeys(("test", "uniform", "s3"), data.test),
    }
    proof = certification.prove(
        trained.model,
        trained.params,
        BOXES.env,
        validation=data.validation,
        attack_starts=0,
    )
    measured = certification.measure(
        trained.model, trained.params, proof, **splits, boxes=BOXES, level=0.9
    )
    provenance = Provenance(
        policy_sha256=trained.sha256,
        weights_sha256=trained.weights_sha256,
        versions=store.versions(),
        seconds=0.0,
    )
    write(
        run_dir / "certificate.json",
        DrivingCertificate(
            proof=proof, measured=measured, corridor=None, provenance=provenance
        ),
    )
    return requested, export.main(requested)


@pytest.fixture(scope="module")
def loaded(exported):
    return sfkd_jax.load(Path(exported[1]["policy"]).parent)


@pytest.fixture
def spoiled(exported, tmp_path):
    """The root of all runs, to spoil."""
    return Path(shutil.copytree(exported[0].settings.root, tmp_path / "runs"))


@pytest.fixture
def folder(exported, tmp_path):
    """The export folder, to spoil."""
    return Path(shutil.copytree(Path(exported[1]["blob"]).parent, tmp_path / "export"))


def shipped(folder):
    """The script of an export folder as a module."""
    spec = importlib.util.spec_from_file_location(
        "run_controller", folder / "run_controller.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measurements():
    """Of a few steps; one is not finite, and friction and wind switch."""
    noise = 0.3 * np.random.default_rng(3).standard_normal((STEPS, 4))
    observations = np.asarray([0.0, 0.2, 0.0, 9.0]) + noise
    observations[3, 2] = np.nan
    envs = np.where(np.arange(STEPS)[:, None] < 2, [0.9, 0.0], [0.4, 6.0])
    reference = np.asarray(straight(HORIZON))
    return observations.astype(np.float32), envs.astype(np.float32), reference


def plain(tree):
    """Leaves as numpy arrays, keys as their data."""
    leaves = jax.tree.leaves(tree)
    opened = (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        for x in leaves
    )
    return [np.asarray(leaf) for leaf in opened]


@pytest.fixture(scope="module")
def in_process(loaded):
    """Every leaf of every step of the policy's own controller, jitted here."""
    act, steps = jit(loaded.controller.act), []
    state = loaded.controller.init(jax.random.key(7))
    observations, envs, reference = measurements()
    for observation, env in zip(observations, envs, strict=True):
        control, state, info = act(loaded.params, state, observation, env, reference)
        parts = {"healthy": info.healthy, **info._asdict()}
        steps.append(plain((control, state, parts)))
    return steps


def repeated(folder, observations, envs, **ahead):
    """Leaves of every step of an export, by name, in a process without this package."""
    given = {f"ahead/{name}": value for name, value in ahead.items()}
    np.savez(folder / "measured.npz", observations=observations, envs=envs, **given)
    program = f"""
        import sys
        for name in {HEAVY!r}:
            sys.modules[name] = None  # an import of it fails
        import numpy as np
        from run_controller import ExportedController
        def leaves_of(node):
            if not hasattr(node, "__dict__") or hasattr(node, "shape"):
                return [node]
            return [leaf for part in vars(node).values() for leaf in leaves_of(part)]
        controller = ExportedController()
        state, arrays = controller.init(seed=7), {{}}
        with np.load("measured.npz") as given:
            for k, (observation, env) in enumerate(zip(given["observations"], given["envs"])):
                ahead = {{name[6:]: given[name][k] for name in given.files if name[:6] == "ahead/"}}
                control, state, info = controller.act(state, observation, env, ahead)
                leaves = [control, *state.values(), *leaves_of(info)]
                arrays |= {{f"{{k}}/{{i}}": np.asarray(leaf) for i, leaf in enumerate(leaves)}}
        np.savez("steps.npz", **arrays)
        packages = {{name.split(".")[0] for name, module in sys.modules.items() if module is not None}}
        assert not packages & {HEAVY!r}, packages
        assert "flatbuffers" in packages
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    manifest = json.loads((folder / "controller.json").read_text())
    names = [leaf["name"] for leaf in manifest["programs"]["act"]["outputs"]]
    with np.load(folder / "steps.npz") as result:
        assert len(result.files) == len(names) * len(observations)
        return [
            {name: result[f"{k}/{i}"] for i, name in enumerate(names)}
            for k in range(len(observations))
        ]


def test_a_process_without_this_package_repeats_every_step(folder, in_process):
    """Up to rounding: with several platforms a product of matrices is a choice."""
    observations, envs, reference = measurements()
    steps = repeated(
        folder, observations, envs, reference=np.stack([reference] * STEPS)
    )
    for step, leaves in zip(steps, in_process, strict=True):
        for theirs, ours in zip(step.values(), leaves, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    healthy = [bool(step["info.healthy"]) for step in steps]
    assert healthy == [True, True, True, False, True, True]


def test_in_a_lane_the_road_is_a_window_that_moves_on(tmp_path):
    """Padding may hold anything, an obstacle that is not finite makes the car stop."""
    shipped_policy = f"{sfkd_jax.__path__[0]}/pretrained/kinematic_path"
    few = policy.restore(shipped_policy).settings["controller"]
    few = few | {"mppi": few["mppi"] | {"num_samples": 16}}
    trained = sfkd_jax.load(shipped_policy, controller=few)
    size = {"platforms": ("cpu",), "lane": (260, 2, 1), "car": (4.0, 1.8)}
    manifest = exporting.write_controller(trained, tmp_path, **size)
    shapes = {x["name"]: x["shape"] for x in manifest["programs"]["act"]["inputs"]}
    assert (shapes["road"], shapes["position"]) == ((260, 4), (2, 1, 2))
    assert manifest["car_m"] == [4.0, 1.8]
    # The proof and its checker are in the same folder.
    proof = (tmp_path / "proof.bin").read_bytes()
    assert manifest["proof"]["sha256"] == hashlib.sha256(proof).hexdigest()
    assert bytes.fromhex(manifest["weights_sha256"]) in proof
    assert "int main" in (tmp_path / "check_proof.c").read_text()
    line = np.zeros((300, 4), np.float32)
    line[:, 0] = 0.5 * np.arange(300) - 5.0
    first = np.array([0, 0, 0, 0, 8])
    observations = np.zeros((5, 4), np.float32)
    observations[:, 0], observations[:, 3] = np.arange(5), 10.0
    observations[2, 2] = np.nan
    position = np.full((5, 2, 1, 2), np.nan, np.float32)
    position[:, 0, 0] = 40.0, 0.5
    position[3, 0] = np.nan
    every = np.ones((5, 260), np.float32)
    rows = {
        "road": np.stack([line[i : i + 260] for i in first]),
        "spacing": np.full(5, 0.5, np.float32),
        "left": 5.0 * every,
        "right": 5.0 * every,
        "speed": 10.0 * every,
        "position": position,
        "yaw": np.zeros((5, 2), np.float32),
        "half": np.zeros((5, 2, 2), np.float32),
        "radius": np.full((5, 2), 0.8, np.float32),
        "present": np.stack([[True, False]] * 5),
        "moved": first,
    }
    envs = np.full((5, 2), [0.9, 0.0], np.float32)
    steps = repeated(tmp_path, observations, envs, **rows)
    driver = trained.in_lane(car=(4.0, 1.8))
    act, state = jax.jit(driver.act), driver.init(jax.random.key(7))
    for k, step in enumerate(steps):
        road, spacing, *lane = (rows[name][0] for name in [*rows][:5])
        scene = (
            Lane(Road(road, spacing), *lane),
            Obstacles(*(rows[x][k] for x in [*rows][5:-1])),
        )
        control, state, info = act(
            trained.params, state, observations[k], envs[k], scene
        )
        # Up to the rounding of another program, also where the window has moved on.
        np.testing.assert_allclose(step["control"], control, rtol=0.0, atol=1e-4)
        # After the stop for what was not finite nothing is claimed for a while.
        assert step["info.healthy"] == info.healthy == (k < 2)
    assert steps[3]["info.lane.stopping"]
    ahead = steps[4]["state.progress"] - state.progress
    np.testing.assert_allclose(ahead, -4.0, atol=1e-4)
    with pytest.raises(ValueError, match=r"export.lane must be \[points"):
        exporting.write_controller(trained, tmp_path, lane=(260, 2))


def test_the_manifest_lists_the_inputs_of_programs_and_what_they_were_made_from(
    exported, loaded
):
    requested, printed = exported
    manifest = json.loads(Path(printed["manifest"]).read_text())
    run_dir = Path(printed["blob"]).parent
    for program in manifest["programs"].values():
        content = (run_dir / program["file"]).read_bytes()
        assert program["sha256"] == hashlib.sha256(content).hexdigest()
        read = jax.export.deserialize(bytearray(content))
        assert read.platforms == ("cpu", "cuda") == tuple(manifest["platforms"])
    act = manifest["programs"]["act"]
    measured = ["observation", "env", "reference"]
    assert [leaf["name"] for leaf in act["inputs"][-3:]] == measured
    assert act["outputs"][0]["name"] == "control"
    states = [leaf for leaf in act["outputs"] if leaf["name"].startswith("state.")]
    assert states == act["inputs"][:-3] == manifest["programs"]["init"]["outputs"]
    weights = policy.restore(requested.directory).weights_sha256
    assert manifest["weights_sha256"] == weights
    certificate = hashlib.sha256((run_dir / "certificate.json").read_bytes())
    assert manifest["certificate_sha256"] == certificate.hexdigest()
    assert (manifest["sampling_period_s"], manifest["horizon"]) == (0.1, HORIZON)
    highest = tuple(control["high"] for control in manifest["controls"])
    assert highest == requested.plant.control_high
    assert manifest["environment"]["low"] == list(ENV_LOW)
    assert loaded.certificate.measured.boxes == BOXES


def test_an_export_does_not_contain_paths_of_this_machine(exported):
    """Nor in the programs, which jax annotates with source files; a jax setting that is
    made for it is given back.
    """
    run_dir = Path(exported[1]["blob"]).parent
    folders = {
        str(Path(name).resolve().parent).encode()
        for name in (sfkd_jax.__file__, jax.__file__, __file__)
    }
    programs = sorted(run_dir.glob("*.stablehlo"))
    assert len(programs) == 2
    for content in (path.read_bytes() for path in programs):
        assert not re.search(rb"[\w.-]\.py\b", content)
        assert not [folder for folder in folders if folder in content]
    assert jax.config.jax_traceback_in_locations_limit > 0


def test_the_controller_of_the_command_is_exported_and_no_refused_certificate(
    spoiled, capsys
):
    requested = run(spoiled, "controller.mppi.horizon=4", "export.platforms=[cpu]")
    run_dir = requested.directory
    for name in ("proof.bin", "check_proof.c"):
        (run_dir / "export" / name).touch()
    assert (run_dir / "export" / "certificate.json").exists()
    provenance = read(run_dir / "certificate.json", DrivingCertificate).provenance
    refusal = Refusal(reason="alpha is not below 1", provenance=provenance)
    write(run_dir / "certificate.json", refusal)
    printed = export.main(requested)
    assert "exported without a certificate" in capsys.readouterr().err
    manifest = json.loads(Path(printed["manifest"]).read_text())
    assert (manifest["horizon"], manifest["certificate_sha256"]) == (4, None)
    folder = Path(printed["policy"]).parent
    assert manifest["proof"] is None
    for name in ("certificate.json", "proof.bin", "check_proof.c"):
        assert not (folder / name).exists()
    horizons = [
        sfkd_jax.load(one).settings["controller"]["mppi"]["horizon"]
        for one in (folder, folder.parent)
    ]
    assert horizons == [4, HORIZON]


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        ("controller.stablehlo", lambda x: x[:-1], "changed, its sha256"),
        ("initial_state.stablehlo", None, "No such file"),
        ("controller.json", lambda x: x[:50], "malformed, JSONDecodeError"),
        ("controller.json", lambda x: b"[1]", "malformed, TypeError"),
        ("controller.json", lambda x: b"[" * 200_000, "malformed, RecursionError"),
        ("controller.json", lambda x: b'{"kind": "policy"}', "not the manifest"),
        (
            "controller.json",
            lambda x: x.replace(b'"format": 3', b'"format": 1'),
            "format 1",
        ),
        (
            "controller.json",
            lambda x: x.replace(b'"horizon": 5', b'"horizon": 6'),
            "changed, its sha256",
        ),
    ],
)
def test_a_damaged_export_is_named_in_one_line(folder, file, damage, message):
    if damage is None:
        (folder / file).unlink()
    else:
        (folder / file).write_bytes(damage((folder / file).read_bytes()))
    run_controller = shipped(folder)
    with pytest.raises(run_controller.ExportError, match=message) as raised:
        run_controller.ExportedController(folder)
    assert file in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_blob_that_jax_refuses_is_named_with_the_jax_that_wrote_it(folder):
    (folder / "initial_state.stablehlo").write_bytes(b"no program")
    manifest = json.loads((folder / "controller.json").read_text())
    about = {"bytes": 10, "sha256": hashlib.sha256(b"no program").hexdigest()}
    manifest["programs"]["init"] |= about
    del manifest["sha256"]
    manifest["jax"] = "9.9"
    manifest["sha256"] = store.sha256(manifest)
    (folder / "controller.json").write_text(json.dumps(manifest))
    run_controller = shipped(folder)
    with pytest.raises(run_controller.ExportError, match=r"written by jax 9\.9"):
        run_controller.ExportedController(folder)


def test_arguments_of_the_wrong_shape_are_named(exported):
    controller = shipped(Path(exported[1]["blob"]).parent).ExportedController()
    observations, envs, reference = measurements()
    state = controller.init()
    with pytest.raises(
        ValueError, match=r"observation must have shape \(4,\), got \(3,\)"
    ):
        controller.act(state, observations[0, :3], envs[0], reference)
    with pytest.raises(ValueError, match=r"reference must have shape \(5, 4\)"):
        controller.act(state, observations[0], envs[0], reference[:-1])
    with pytest.warns(UserWarning, match=r"e left friction \[-\] 0\.3 … "):
        controller.act(state, observations[0], 1e3 * envs[0], reference)
    # On Earth it drives as at home if it is told in float64, and says so if not.
    far, home = np.asarray([2048.0 * 250, 2048.0 * 2200]), (observations[0], reference)
    there = [np.float64(one) + np.append(far, [0.0, 0.0]) for one in home]
    near, _, _ = controller.act(state, home[0], envs[0], home[1])
    away, _, info = controller.act(state, there[0], envs[0], there[1], elapsed=1)
    np.testing.assert_array_equal(away, near)
    assert info.healthy
    assert np.abs(info.plan.states[:, :2] - far).max() < 100.0
    rounded = [one.astype(np.float32) for one in there]
    assert not controller.act(state, rounded[0], envs[0], rounded[1])[2].healthy
    (elapsed,) = (name for name in state if name.endswith("tuning.elapsed"))
    late = state | {elapsed: np.float32(2.5)}
    for one, options in ((state, {"elapsed": 2.5}), (late, {})):
        after = controller.act(one, home[0], envs[0], home[1], **options)[1]
        assert float(after[elapsed]) == 1.0
        assert np.any(np.asarray(after[elapsed.replace("tuning.elapsed", "plan")]))
    with pytest.raises(ValueError, match="state must be"):
        controller.act(
            dict(list(state.items())[1:]), observations[0], envs[0], reference
        )


def test_the_script_steps_a_controller_by_itself(exported):
    script = Path(exported[1]["blob"]).with_name("run_controller.py")
    done = subprocess.run(
        [sys.executable, script, "--steps", "2"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["controls"]) == 2


def test_a_run_without_a_policy_is_sent_to_train(tmp_path):
    with pytest.raises(store.ArtefactError, match="run train with the same options"):
        export.main(run(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported_is_refused(loaded, tmp_path):
    with pytest.raises(ValueError, match="platforms must be some of cpu, cuda"):
        exporting.write_controller(loaded, tmp_path, platforms=("gpu",))

    def act(params, state, *measured):
        control, after, info = loaded.controller.act(params, state, *measured)
        return control, (after, control), info

    growing = replace(loaded, controller=Controller(loaded.controller.init, act))
    with pytest.raises(ValueError, match="state changes"):
        exporting.flat_programs(growing)


def test_warm_up_gives_the_same_bits_for_these_shapes_only(loaded):
    def act(params, key, observation, env, reference):
        key, noise = jax.random.split(key)
        control = jnp.tanh(env * observation[1]) + jax.random.normal(noise, (2,))
        return control, key, {"speed": reference[0, 3]}

    simple = replace(loaded, controller=Controller(lambda key: key, act))
    observations, envs, reference = map(jnp.asarray, measurements())
    measured = (observations[0], envs[0], reference)
    expected = plain(jax.jit(act)(simple.params, jax.random.key(7), *measured))
    compiled = sfkd_jax.warm_up(simple)
    result = plain(compiled(simple.params, jax.random.key(7), *measured))
    assert [leaf.tobytes() for leaf in result] == [leaf.tobytes() for leaf in expected]
    with pytest.raises(TypeError):
        compiled(simple.params, jax.random.key(7), measured[0][:3], *measured[1:])


def test_iree_runs_the_controller_without_jax(loaded, in_process, tmp_path):
    pytest.importorskip("iree.compiler")
    runtime = pytest.importorskip("iree.runtime")
    with pytest.raises(ValueError, match="nonsense"):
        exporting.write_controller(
            loaded, tmp_path, iree=True, iree_flags=("--nonsense",)
        )
    assert list(tmp_path.iterdir()) == []
    manifest = exporting.write_controller(loaded, tmp_path, iree=True)
    modules = {}
    for name, entry in manifest["iree"].items():
        content = (tmp_path / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"]
        modules[name] = runtime.load_vm_flatbuffer(content, driver="local-sync")["main"]
    state = modules["init"](np.asarray(jax.random.key_data(jax.random.key(7))))
    count, (observations, envs, reference) = len(state), measurements()
    for observation, env, leaves in zip(observations, envs, in_process, strict=True):
        control, *rest = map(
            np.asarray,
            modules["act"](*map(np.asarray, state), observation, env, reference),
        )
        state = rest[:count]
        np.testing.assert_allclose(control, leaves[0], atol=1e-5)


@pytest.mark.skipif(
    importlib.util.find_spec("iree") is not None, reason="IREE is installed"
)
def test_iree_that_is_not_installed_is_named_with_its_extra(loaded, tmp_path):
    with pytest.raises(ValueError, match=r"sfkd-jax\[cpp\]"):
        exporting.write_controller(loaded, tmp_path, iree=True)
    assert list(tmp_path.iterdir()) == []
