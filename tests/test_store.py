"""Files come back as they were written, or are refused in one line that names them."""

import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import time

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusal_of
from safetensors.numpy import load_file, save

from sfkd_jax import store

CONFIG = {"steps": 100, "model": {"rank": 32, "bounds": [0.5, 1.0]}}
ARRAYS = {
    "networks/kernel": np.arange(6, dtype=np.float32).reshape(2, 3),
    "transposed": np.arange(6.0).reshape(2, 3).T,
    "count": np.asarray(3),
    "flags": np.array([True, False]),
    "empty": np.zeros((0, 4), np.float32),
    "extremes": np.array([np.nan, -0.0, np.inf, 5e-324, 1.8e308]),
}


def write(path, arrays=ARRAYS, **changes):
    return store.write_arrays(
        path, arrays, **{"kind": "policy", "config": CONFIG} | changes
    )


def read(path, **changes):
    return store.read_arrays(path, **{"kind": "policy"} | changes)


def refusal(action, *arguments, **options):
    line = refusal_of(lambda: action(*arguments, **options))
    assert line is not None
    return line


def names(folder):
    return sorted(os.listdir(folder))


@pytest.fixture
def path(tmp_path):
    """A name that a pattern would not match literally."""
    return tmp_path / "run[1],seed=0" / "policy.safetensors"


# ---- arrays


def test_arrays_come_back_bit_for_bit_with_their_manifest(path):
    written = write(path, made_from={"dataset": "0" * 64})
    arrays, manifest = read(path, config=CONFIG)
    assert manifest == written
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
        assert arrays[name].tobytes() == np.ascontiguousarray(array).tobytes()
    assert manifest["made_from"] == {"dataset": "0" * 64}
    assert manifest["versions"].keys() == {"python", "numpy", "jax", "sfkd_jax"}
    # Others read the file with safetensors alone.
    assert load_file(path).keys() == ARRAYS.keys()
    assert names(path.parent) == [path.name]


@pytest.mark.parametrize(
    "array",
    [
        np.array("text"),
        np.array([None]),
        np.zeros(2, "M8[s]"),
        jnp.zeros(1, "bfloat16"),
    ],
)
def test_arrays_without_a_portable_form_are_refused(path, array):
    assert "x is of dtype" in refusal(write, path, {"x": array})
    assert not path.exists()


def test_what_cannot_be_written_is_refused(path):
    assert "must end in .safetensors" in refusal(write, path.with_suffix(".npz"))
    assert "not written" in refusal(write, path, config={"a": object()})
    path.mkdir(parents=True)
    assert refusal(write, path) == f"{path}: Is a directory"
    assert names(path.parent) == [path.name]


def test_the_hash_sees_content_and_nothing_else():
    a, b = np.arange(6.0).reshape(2, 3), np.ones(2, np.float32)
    same = store.sha256_of_arrays({"a": a, "b": b})
    assert same == store.sha256_of_arrays({"b": b[::-1], "a": np.asfortranarray(a)})
    others = [
        {"a": a, "c": b},
        {"a": a.reshape(3, 2), "b": b},
        {"a": a.astype(np.float32), "b": b},
        {"a": np.nextafter(a, 9), "b": b},
    ]
    assert len({same, *map(store.sha256_of_arrays, others)}) == 5
    assert store.sha256({"b": 1, "a": [1, 2]}) == store.sha256({"a": (1, 2), "b": 1})
    assert store.sha256({"a": 1}) != store.sha256({"a": 2})


def test_other_kinds_formats_and_settings_are_refused(path):
    write(path)
    assert refusal(read, path, kind="dataset").endswith("kind policy, not dataset")
    line = refusal(read, path, config=CONFIG | {"steps": 4000})
    assert line == f"{path}: made with other settings: steps was 100, is now 4000"
    assert read(path, config=CONFIG | {"steps": 100.0})
    rewritten(path, format=1)
    assert "is of format 1, not 2" in refusal(read, path)
    absent = path.with_name("none")
    assert refusal(read, absent) == f"{absent}: No such file or directory"


def rewritten(path, drop=(), **changes):
    """Change the manifest in the file and leave everything else."""
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    manifest = json.loads(header["__metadata__"]["manifest"]) | changes
    manifest = {key: value for key, value in manifest.items() if key not in drop}
    header["__metadata__"]["manifest"] = json.dumps(manifest)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"config": CONFIG | {"steps": 99}}, "settings were changed"),
        ({"sha256": "0" * 64}, "settings were changed"),
        ({"config": []}, "malformed, config"),
        ({"kind": None}, "is of kind None"),
        ({"drop": ("content_sha256",)}, "malformed, KeyError: 'content_sha256'"),
    ],
)
def test_a_changed_manifest_is_refused(path, changes, says):
    write(path)
    rewritten(path, **changes)
    assert says in refusal(read, path)


def test_no_flipped_or_missing_byte_changes_what_is_read(path):
    written, random_ = write(path), random.Random(0)
    whole = path.read_bytes()
    places = [*range(0, 40), *(random_.randrange(len(whole)) for _ in range(300))]
    for place in [*places, len(whole) - 1]:
        spoiled = bytearray(whole)
        spoiled[place] ^= 1 << random_.randrange(8)
        path.write_bytes(spoiled)
        try:
            arrays, manifest = read(path)
        except store.ArtefactError:
            continue
        # A byte of the date, of versions or made_from.
        assert manifest["content_sha256"] == written["content_sha256"]
        assert store.sha256_of_arrays(arrays) == written["sha256"]
    for length in random_.sample(range(len(whole)), 40):
        path.write_bytes(whole[:length])
        assert str(path) in refusal(read, path)
    path.write_bytes(whole + b"more")
    assert str(path) in refusal(read, path)


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04", b"{}", b"\x80\x04pickle", save({"x": np.zeros(2)})]
)
def test_foreign_files_are_refused(path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    says = "no manifest" if b"F64" in content else "truncated, damaged or foreign"
    assert says in refusal(read, path)


# ---- JSON


def test_json_comes_back_with_arrays_as_lists_and_nan_as_null(path):
    document = {
        "a": np.arange(2),
        "b": float("nan"),
        "c": ("ä", path),
        "d": {"e": 1e-300},
    }
    store.write_json(path, document)
    back = {"a": [0, 1], "b": None, "c": ["ä", str(path)], "d": {"e": 1e-300}}
    assert store.read_json(path, keys=("a", "d")) == back
    assert "lacks f" in refusal(store.read_json, path, keys=("a", "f"))
    assert "not written" in refusal(store.write_json, path, {"a": object()})
    assert store.read_json(path) == back


@pytest.mark.parametrize(
    "text",
    [
        '{"a": NaN}', '{"a": -Infinity}', '{"a": 1e999}', "[1]", "", '{"a": ',
        "\x00", "nul", "[" * 200_000, '{"a": 1' + 5000 * "0" + "}",
    ],
)  # fmt: skip
def test_what_is_no_json_is_refused(path, text):
    path.parent.mkdir()
    path.write_text(text)
    assert str(path) in refusal(store.read_json, path)


def test_differences_are_listed_by_dotted_key():
    old = {"a": {"b": 1, "c": [1, 2]}, "d": True, "gone": 1}
    new = {"a": {"b": 1.0, "c": (1, 3)}, "d": 1, "new": "x" * 99}
    assert store.differences(old, new) == [
        "a.c was [1, 2], is now [1, 3]",
        "d was True, is now 1",
        "gone was 1, is now absent",
        f"new was absent, is now {'x' * 57}...",
    ]


def test_lines_that_are_none_are_left_out_and_the_others_stay(tmp_path, capsys):
    log = tmp_path / "metrics.jsonl"
    store.truncate_jsonl(log, lambda record: True)
    assert not log.exists()
    log.write_bytes(
        b'{"step": 1}\n{"st\xff\n[3]\n{"other": 4}\n{"step": 5}\n{"step": 6'
    )
    assert store.read_jsonl(log, keys=("step",)) == [{"step": 1}, {"step": 5}]
    told = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1][:6] for line in told] == ["line 2", "line 3", "line 4"]
    store.truncate_jsonl(log, lambda record: record["step"] < 5, keys=("step",))
    assert log.read_text() == '{"step": 1}\n'


# ---- a full disk, and kills


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_the_earlier_file(path, monkeypatch, call):
    write(path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, full)
    for action in (lambda: write(path, {}), lambda: store.write_json(path, {})):
        assert refusal_of(action) == f"{path}: No space left on device"
    assert read(path)[0].keys() == ARRAYS.keys()
    assert names(path.parent) == [path.name]


CHILD = """
import os, signal, sys, types
package = types.ModuleType("sfkd_jax")  # without the rest, which would import jax
package.__path__, package.__version__ = [sys.argv[1]], "0"
sys.modules["sfkd_jax"] = package
from pathlib import Path
import numpy as np
from sfkd_jax import store
path = Path(sys.argv[2])
def write(n):
    store.write_arrays(path, {"x": np.full(400_000, n, float)}, kind="k", config={"n": n})
"""


def child(path, code):
    source = CHILD + textwrap.dedent(code)
    package = os.path.dirname(store.__file__)
    command = [sys.executable, "-c", source, package, path]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def version(path):
    """Which write is on the disk; arrays and manifest must agree about it."""
    arrays, manifest = store.read_arrays(path, kind="k")
    assert np.all(arrays["x"] == manifest["config"]["n"])
    return manifest["config"]["n"]


def test_kills_at_random_moments_leave_one_whole_file(path):
    seen, wait = 0, random.Random(0)
    for _ in range(6):
        code = f"""
        for n in range({seen + 1}, {seen + 1000}):
            write(n)
            print(n, flush=True)
        """
        with child(path, code) as process:
            seen = int(process.stdout.readline())
            time.sleep(0.05 * wait.random())
            process.send_signal(signal.SIGKILL)
            rest = process.stdout.read().split()
        seen = version(path)
        assert not rest or seen >= int(rest[-1])


def test_two_writers_and_a_reader_of_one_path_do_not_disturb_each_other(path):
    code = "for n in range(1, 40): write(n)"
    with child(path, code) as first, child(path, code) as second:
        while first.poll() is None or second.poll() is None:
            if path.exists():
                version(path)
    assert (first.returncode, second.returncode) == (0, 0)
    assert version(path) == 39
    assert names(path.parent) == [path.name]
