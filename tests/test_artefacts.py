"""Files: round trips, errors of one line, and no loss by a kill or a full disk."""

import json
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import largest_file

from sfkd_jax import store
from sfkd_jax.store import ArtefactError, _provenance, provenance, source_hash

CONFIG = {
    "model": {"rank": 16, "layers": [32, 32]},
    "training": {"steps": 4000, "rate": 1e-3},
    "seed": 0,
}
ARRAYS = {
    "params/A": np.arange(12, dtype=np.float32).reshape(3, 4),
    "params/allow_pickle": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "scalar": np.array(2.5),
    "empty": np.zeros((0, 3), np.int8),
    "big_endian": np.array([1, 2], ">i4"),
    "flags": np.array([True, False]),
    "words": np.array(["S1", "σ"]),
    "complex": np.array([1 + 2j], np.complex64),
    "nan": np.array([np.nan, -0.0, np.inf]),
    "file": np.arange(3, dtype=np.uint16)[::-1],
}
OLD = {"x": np.arange(4.0)}


def write(path, arrays=ARRAYS, **changes):
    return store.write_arrays(
        path, arrays, **{"kind": "policy", "config": CONFIG, **changes}
    )


def read(path, **changes):
    return store.read_arrays(path, **{"kind": "policy", **changes})


def refusal(action, *arguments, **settings) -> str:
    """The one line that an action fails with."""
    with pytest.raises(ArtefactError) as caught:
        action(*arguments, **settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        np.testing.assert_array_equal(a[name], b[name], strict=True)


def names(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "run[1],seed=0" / "policy.npz"


# ---- content


def test_trees_come_back_from_flat_names():
    tree = {
        "params": {
            "dense": {"kernel": jnp.ones((2, 3)), "bias": np.zeros(3)},
            "none": {},
        },
        "step": 3,
        "scale": 0.5,
    }
    flat = store.flatten(tree)
    assert list(flat) == [
        "params/dense/kernel",
        "params/dense/bias",
        "params/none/",
        "step",
        "scale",
    ]
    assert all(isinstance(leaf, np.ndarray) for leaf in flat.values())
    back = store.unflatten(flat)
    assert back["params"]["none"] == {}
    assert back["step"].shape == ()
    np.testing.assert_array_equal(
        back["params"]["dense"]["kernel"], np.ones((2, 3), np.float32), strict=True
    )
    assert store.flatten(back).keys() == flat.keys()
    assert store.unflatten(store.flatten({})) == {}


@pytest.mark.parametrize(
    "tree", [{"a/b": 1.0}, {"": 1.0}, {"a": [1.0, 2.0]}, {"a": None}]
)
def test_trees_without_a_flat_form_are_refused(tree):
    with pytest.raises(ValueError, match="cannot flatten"):
        store.flatten(tree)


@pytest.mark.parametrize("flat_names", [("a", "a/b"), ("a/b", "a"), ("a/b/c", "a/b")])
def test_a_leaf_is_not_a_dict(flat_names):
    with pytest.raises(ValueError, match="leaf"):
        store.unflatten({name: np.zeros(1) for name in flat_names})


def test_hash_sees_content_and_nothing_else():
    digest = store.sha256(ARRAYS)
    assert digest == store.sha256(dict(reversed(ARRAYS.items())))
    assert digest == store.sha256(
        {name: np.array(array, order="F") for name, array in ARRAYS.items()}
    )
    strided = np.zeros((6, 8), np.float32)[::2, ::2]
    strided[:] = ARRAYS["params/A"]
    assert digest == store.sha256(ARRAYS | {"params/A": strided})
    a = ARRAYS["params/A"]
    assert store.sha256({"a": jnp.asarray(a)}) == store.sha256({"a": a})
    others = [
        {"b": a},
        {"a": a.T},
        {"a": a.ravel()},
        {"a": a.astype(float)},
        {"a": a + 1},
        {"a": a, "b": a},
        {},
    ]
    others += [{"a": a.astype(">f4")}, {"a": a.view(np.int32)}, {"a": a.tolist()}]
    assert (
        len({store.sha256(other) for other in [{"a": a}, *others]}) == len(others) + 1
    )


def test_hash_of_json_sees_content_and_nothing_else():
    digest = store.sha256(CONFIG)
    assert digest == store.sha256(dict(reversed(CONFIG.items())))
    assert digest == store.sha256(json.loads(json.dumps(CONFIG)))
    assert digest == store.sha256(CONFIG | {"seed": np.int64(0)})
    assert digest != store.sha256(CONFIG | {"seed": 1})
    assert store.sha256([1, 2]) == store.sha256((1, 2)) != store.sha256([2, 1])


def test_differences_are_listed_by_dotted_key():
    options = {
        "model": {"rank": 16.0, "layers": (32, 64)},
        "training": {"steps": 100, "rate": 1e-3},
        "name": "a" * 99,
    }
    assert store.differences(CONFIG, options) == [
        "model.layers was [32, 32], is now [32, 64]",
        "training.steps was 4000, is now 100",
        "seed was 0, is now absent",
        f"name was absent, is now {'a' * 57}...",
    ]
    assert store.differences(CONFIG, json.loads(json.dumps(CONFIG))) == []
    assert store.differences({"a": {"b": 1}}, {"a": 1}) == ["a was {'b': 1}, is now 1"]
    assert store.differences({"a": True, "b": None}, {"a": 1, "b": float("nan")}) == [
        "a was True, is now 1"
    ]


# ---- JSON


def test_json_comes_back_with_arrays_as_lists_and_nan_as_null(path):
    numbers = {
        "a": np.float32(0.5),
        "b": jnp.arange(3),
        "c": np.nan,
        "d": [np.inf, np.bool_(True)],
        "e": np.eye(2),
    }
    document = path.with_suffix(".json")
    store.write_json(
        document,
        numbers
        | {"at": Path("runs"), "none": None, "deep": {"f": np.array([1.0, -np.inf])}},
    )
    assert store.read_json(document, keys=("a", "at")) == {
        "a": 0.5,
        "b": [0, 1, 2],
        "c": None,
        "d": [None, True],
        "e": [[1.0, 0.0], [0.0, 1.0]],
        "at": "runs",
        "none": None,
        "deep": {"f": [1.0, None]},
    }
    assert names(path.parent) == ["policy.json"]


def test_json_that_cannot_be_read_is_refused(tmp_path):
    document = tmp_path / "a.json"
    assert refusal(store.read_json, document) == f"{document}: missing"
    whole = json.dumps(CONFIG).encode()
    for text in (
        b"",
        whole[:-1],
        whole[:10],
        b"\xff\xfe\x00",
        pickle.dumps(CONFIG),
        b"[" * 100_000,
    ):
        document.write_bytes(text)
        assert "truncated or not JSON" in refusal(store.read_json, document)
    document.write_bytes(b"[1]")
    assert refusal(store.read_json, document) == f"{document}: not a JSON object"
    document.write_bytes(whole)
    assert (
        refusal(store.read_json, document, keys=("seed", "rows", "b"))
        == f"{document}: lacks rows, b"
    )
    assert refusal(store.read_json, tmp_path) == f"{tmp_path}: Is a directory"


def test_a_value_that_is_not_json_leaves_the_earlier_file(tmp_path):
    document = tmp_path / "a.json"
    store.write_json(document, CONFIG)
    for value in ({1, 2}, b"bytes", object()):
        assert str(document) in refusal(store.write_json, document, {"a": value})
    assert store.read_json(document) == CONFIG


# ---- arrays


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_come_back_as_they_were(path, compressed):
    assert not store.exists(path)
    written = write(path, made_from={"dataset": "0" * 64}, compressed=compressed)
    assert store.exists(path)
    arrays, manifest = read(path, config=CONFIG)
    same(arrays, ARRAYS)
    assert manifest == written
    assert manifest["sha256"] == store.sha256(arrays) == store.sha256(ARRAYS)
    assert manifest["config"] == CONFIG
    assert manifest["made_from"] == {"dataset": "0" * 64}
    assert set(manifest["versions"]) == {"python", "numpy", "jax", "sfkd_jax"}
    assert manifest["created"].endswith("+00:00")
    assert names(path.parent) == ["policy.json", "policy.npz"]


def test_no_arrays_and_random_arrays_come_back(path):
    write(path, {})
    assert read(path)[0] == {}
    rng = np.random.default_rng(0)
    for dtype in ("f2", "f4", "f8", "i1", "i8", "u4", "c16", "?", "<M8[s]", "S3"):
        shapes = [tuple(rng.integers(0, 4, size=rank)) for rank in range(4)]
        arrays = {
            f"{n}": rng.integers(0, 99, size=shape).astype(dtype)
            for n, shape in enumerate(shapes)
        }
        write(path, arrays)
        same(read(path)[0], arrays)


def test_arrays_without_a_portable_form_are_refused(path):
    write(path)
    for odd in (
        np.array([{}]),
        np.asarray(jnp.ones(2, jnp.bfloat16)),
        np.zeros(2, [("a", "f4")]),
    ):
        assert "x is of dtype" in refusal(write, path, {"x": odd})
    assert "must end in .npz" in refusal(write, path.with_suffix(".json"))
    assert "not written" in refusal(write, path, config={"a": object()})
    same(read(path)[0], ARRAYS)


def test_other_settings_kinds_and_formats_are_refused(path):
    write(path)
    options = CONFIG | {"training": {"steps": 100, "rate": 1e-3}}
    assert (
        refusal(read, path, config=options)
        == f"{path}: made with other settings: training.steps was 4000, is now 100"
    )
    assert refusal(read, path, config={"a": 1, "b": 2}).endswith("and 2 more")
    assert (
        refusal(read, path, kind="dataset") == f"{path}: is of kind policy, not dataset"
    )
    manifest = store.read_json(path.with_suffix(".json"))
    store.write_json(path.with_suffix(".json"), manifest | {"format": 2})
    assert refusal(read, path) == f"{path}: is of format 2, this version reads 1"


def test_half_of_a_pair_is_refused(path):
    assert refusal(read, path) == f"{path}: missing"
    write(path)
    path.with_suffix(".json").unlink()
    assert not store.exists(path)
    assert (
        refusal(read, path)
        == f"{path}: incomplete, its manifest policy.json is missing"
    )
    write(path)
    path.unlink()
    assert not store.exists(path)
    assert refusal(read, path) == f"{path}: missing"


def test_a_damaged_manifest_is_refused_and_can_be_written_over(path):
    good = write(path)
    manifest = path.with_suffix(".json")
    for changes in (
        {"config": 1},
        {"sha256": "../../x"},
        {"sha256": None},
        {"sha256": "ab"},
    ):
        store.write_json(manifest, good | changes)
        assert "not a manifest" in refusal(read, path)
        write(path)
        same(read(path)[0], ARRAYS)
    store.write_json(
        manifest, {key: value for key, value in good.items() if key != "sha256"}
    )
    assert refusal(read, path) == f"{manifest}: lacks sha256"
    manifest.write_bytes(b'{"kind": "pol')
    assert "truncated or not JSON" in refusal(read, path)


def test_foreign_files_are_refused_each_in_its_own_words(path, tmp_path):
    write(path)
    np.save(tmp_path / "a.npy", np.zeros(3))
    random_bytes = np.random.default_rng(1).bytes(1000)
    for content in (
        random_bytes,
        pickle.dumps(ARRAYS),
        (tmp_path / "a.npy").read_bytes(),
        b"PX",
    ):
        path.write_bytes(content)
        assert refusal(read, path) == f"{path}: foreign, not a zip file of arrays"
    np.savez(path, a=np.zeros(3))
    assert "does not match its manifest: sha256" in refusal(read, path)
    np.savez(path, a=np.array([Unpicklable()]))
    assert "does not match its manifest: sha256" in refusal(read, path)
    without_file_hash(path)
    assert refusal(read, path) == f"{path}: holds pickled objects, refused"
    path.write_bytes(b"PK" + random_bytes)
    assert "truncated" in refusal(read, path)


def without_file_hash(path):
    """Make a manifest one of an earlier version, which knew no hash of the file."""
    manifest = store.read_json(path.with_suffix(".json"))
    del manifest["file_sha256"]
    store.write_json(path.with_suffix(".json"), manifest)


class Unpicklable:
    """Loading it fails the test."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was loaded",)


def test_the_manifest_of_another_array_is_refused(path):
    other = path.with_name("other.npz")
    write(path)
    write(other, OLD)
    os.replace(other.with_suffix(".json"), path.with_suffix(".json"))
    assert "does not match its manifest" in refusal(read, path)


def test_truncated_arrays_are_refused(path):
    write(path)
    whole = path.read_bytes()
    rng = random.Random(0)
    for size in {
        0,
        1,
        2,
        4,
        len(whole) - 1,
        *(rng.randrange(len(whole)) for _ in range(60)),
    }:
        path.write_bytes(whole[:size])
        assert (
            refusal(read, path)
            == f"{path}: truncated, the end of the zip file is missing"
        )


@pytest.mark.parametrize("compressed", [False, True])
def test_no_flipped_byte_changes_what_is_read(path, compressed):
    write(path, compressed=compressed)
    whole = path.read_bytes()
    rng = random.Random(0)
    refused = 0
    for at in rng.sample(range(len(whole)), 300):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            same(read(path)[0], ARRAYS)  # a byte that is not read, such as a date
        except ArtefactError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)  # noqa: PT017, PT018
            refused += 1
    assert refused > 150


def test_reading_while_another_process_writes_gives_the_new_arrays(path, monkeypatch):
    write(path, OLD)
    load, calls = store._arrays._load, []

    def overtaken(*arguments):
        calls.append(write(path) if not calls else None)
        return load(*arguments)

    monkeypatch.setattr(store._arrays, "_load", overtaken)
    same(read(path)[0], ARRAYS)
    assert len(calls) == 2


# ---- a full disk


def full(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("call", "working"), [("fsync", 0), ("fsync", 1), ("replace", 1), ("replace", 2)]
)
def test_a_full_disk_leaves_the_earlier_pair(path, monkeypatch, call, working):
    write(path, OLD)
    steps = [getattr(os, call)] * working
    monkeypatch.setattr(
        os, call, lambda *arguments: (steps.pop() if steps else full)(*arguments)
    )
    assert "No space left on device" in refusal(write, path)
    monkeypatch.undo()
    same(read(path)[0], OLD)
    assert names(path.parent) == ["policy.json", "policy.npz"]


@pytest.mark.parametrize("size", [0, 10, 100_000])
def test_a_write_that_ends_in_the_middle_leaves_the_earlier_files(path, size):
    document = path.with_name("results.json")
    write(path, OLD)
    store.write_json(document, CONFIG)
    with largest_file(size):
        assert "File too large" in refusal(write, path, {"x": np.zeros(1_000_000)})
        assert "File too large" in refusal(
            store.write_json, document, {"x": "0" * 1_000_000}
        )
    same(read(path)[0], OLD)
    assert store.read_json(document) == CONFIG
    assert names(path.parent) == ["policy.json", "policy.npz", "results.json"]


def test_a_directory_that_cannot_be_written_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    below = tmp_path / "file" / "policy.npz"
    assert str(below) in refusal(write, below).replace(".json", ".npz")
    for writer in (store.write_json, store.append_jsonl):
        assert refusal(writer, below, CONFIG) in (
            f"{below}: Not a directory",
            f"{below}: File exists",
        )
    (tmp_path / "policy.json").mkdir()
    assert (
        refusal(write, tmp_path / "policy.npz")
        == f"{tmp_path / 'policy.npz'}: Is a directory"
    )
    assert names(tmp_path) == ["file", "policy.json"]


# ---- a kill

CHILD = """
import os, signal, sys, types
package = types.ModuleType("sfkd_jax")  # without the rest of the package, which would import jax
package.__path__, package.__version__ = [sys.argv[1]], "0"
sys.modules["sfkd_jax"] = package
from pathlib import Path
import numpy as np
from sfkd_jax import store
path = Path(sys.argv[2])
def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)
def write(n):
    store.write_arrays(path, {"x": np.full(650_000, n, float)}, kind="policy", config={"n": n})
"""


def child(path, code):
    source = CHILD + textwrap.dedent(code)
    package = Path(store.__file__).parents[1]
    return subprocess.Popen(
        [sys.executable, "-c", source, package, path], stdout=subprocess.PIPE
    )


def version(path) -> int:
    """Which write is on the disk; arrays and manifest must agree about it."""
    arrays, manifest = read(path)
    n = manifest["config"]["n"]
    np.testing.assert_array_equal(arrays["x"], np.full(650_000, n, float))
    return n


@pytest.mark.parametrize(
    ("call", "nth", "second", "left"),
    [
        ("fsync", 1, 2, 1),
        ("fsync", 2, 2, 1),
        ("replace", 2, 2, 1),  # the first looks for a write to complete
        ("replace", 3, 2, 1),
        ("replace", 3, 1, 1),
        ("replace", 4, 2, 2),
    ],
)
def test_a_kill_at_each_step_of_a_write_leaves_one_of_the_two_pairs(
    path, call, nth, second, left
):
    code = f"""
    write(1)
    steps = [kill] + [os.{call}] * {nth - 1}
    os.{call} = lambda *arguments: steps.pop()(*arguments)
    write({second})
    """
    with child(path, code) as process:
        assert process.wait(20) == -signal.SIGKILL
    assert version(path) == left
    assert len(names(path.parent)) > 2
    store.write_arrays(
        path, {"x": np.full(650_000, 3.0)}, kind="policy", config={"n": 3}
    )
    assert version(path) == 3
    assert names(path.parent) == ["policy.json", "policy.npz"]


def test_kills_at_random_moments_leave_a_readable_pair(path):
    rng = random.Random(0)
    seen = 0
    for _ in range(10):
        first = seen + 1
        code = f"""
        for n in range({first}, {first + 1000}):
            write(n)
            print(n, flush=True)
        """
        with child(path, code) as process:
            process.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.15))
            process.kill()
            reported = [first, *map(int, process.stdout.read().split())][-1]
        seen = version(path)
        assert seen in (reported, reported + 1)
    write(path)
    assert names(path.parent) == ["policy.json", "policy.npz"]


def test_two_writers_of_one_path_do_not_disturb_each_other(path):
    code = """
    for _ in range(20):
        write(7)
    """
    with child(path, code) as one, child(path, code) as two:
        assert (one.wait(60), two.wait(60)) == (0, 0)
    assert version(path) == 7
    assert names(path.parent) == ["policy.json", "policy.npz"]


# ---- logs


def test_logs_grow_line_by_line_and_are_cut_for_a_resumed_run(tmp_path):
    log = tmp_path / "new" / "metrics.jsonl"
    store.truncate_jsonl(log, lambda record: True)
    assert refusal(store.read_jsonl, log) == f"{log}: missing"
    for step in range(5):
        store.append_jsonl(
            log, {"step": step, "loss": np.float32(0.5), "gap": float("nan")}
        )
    records = [{"step": step, "loss": 0.5, "gap": None} for step in range(5)]
    assert store.read_jsonl(log) == records
    store.truncate_jsonl(log, lambda record: record["step"] < 3)
    assert store.read_jsonl(log) == records[:3]
    store.truncate_jsonl(log, lambda record: False)
    assert store.read_jsonl(log) == []


def test_a_last_line_cut_short_is_dropped_and_not_built_on(tmp_path):
    log = tmp_path / "metrics.jsonl"
    lines = b'{"step": 0}\n{"step": 1}\n{"step": 2}\n'
    for size in range(len(lines) + 1):
        log.write_bytes(lines[:size])
        whole = [
            {"step": step} for step in range((size + 1) // 12)
        ]  # complete, with or without its end of line
        assert store.read_jsonl(log) == whole
        store.append_jsonl(log, {"step": 9})
        assert store.read_jsonl(log) == [*whole, {"step": 9}]


def test_a_bad_line_before_the_last_is_refused(tmp_path):
    log = tmp_path / "metrics.jsonl"
    log.write_bytes(b'{"step": 0}\n{"ste\n{"step": 2}\n')
    assert "line 2 truncated or not JSON" in refusal(store.read_jsonl, log)
    log.write_bytes(b'{"step": 0}\n\n7\n')
    assert refusal(store.read_jsonl, log) == f"{log}: line 3 not a JSON object"


def test_a_log_on_a_full_disk_keeps_its_lines(tmp_path, monkeypatch):
    log = tmp_path / "metrics.jsonl"
    store.append_jsonl(log, {"step": 0})
    with largest_file(log.stat().st_size + 5):
        assert (
            refusal(store.append_jsonl, log, {"step": 1})
            == f"{log}: No space left on device"
        )
    assert log.read_bytes() == b'{"step": 0}\n'
    with largest_file(4):
        assert (
            refusal(store.truncate_jsonl, log, lambda record: True)
            == f"{log}: File too large"
        )
    assert store.read_jsonl(log) == [{"step": 0}]
    assert names(tmp_path) == ["metrics.jsonl"]
    store.append_jsonl(log, {"step": 1})
    assert store.read_jsonl(log) == [{"step": 0}, {"step": 1}]


def test_the_source_hash_is_that_of_paths_and_contents(tmp_path, monkeypatch):
    def hashed(**files):
        shutil.rmtree(tmp_path)
        for name, text in files.items():
            file = tmp_path / f"{name.replace('_in_', '/')}.py"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        source_hash.cache_clear()
        return source_hash()

    monkeypatch.setattr(_provenance, "PACKAGE", tmp_path)
    first = hashed(a="x", b_in_c="y")
    assert first == hashed(b_in_c="y", a="x")
    changed = {
        hashed(a="x", b_in_c="z"),
        hashed(a="y", b_in_c="x"),
        hashed(a="x", b="y"),
    }
    assert len(changed | {first}) == 4
    source_hash.cache_clear()


def test_provenance_names_the_code_the_device_and_the_commit_of_a_checkout():
    about = provenance()
    assert about["source"] == source_hash()
    assert about["device"].startswith(jax.default_backend())
    checkout = (Path(_provenance.PACKAGE).parents[1] / ".git").exists()
    assert (about["commit"] is not None) == checkout
