"""Files made to make a reader hang, allocate, evaluate or believe: each is one line
that names it, at once.
"""

import json
import os
import shutil
import signal
import socket
import struct
import tracemalloc
import zipfile
from contextlib import contextmanager
from pathlib import Path

import fuzzing_readers
import numpy as np
import pytest
from fuzzing_mutations import bomb

from sfkd_jax import data as datasets
from sfkd_jax import demo, paper, policy, reporting, store
from sfkd_jax.export import _run_controller as loader
from sfkd_jax.store import ArtefactError

SHIPPED = demo.SHIPPED / "kinematic"
MIB = 1 << 20


@contextmanager
def bounded(seconds=20, mebibytes=64):
    """Neither so long nor so large: a hang or an allocation fails the test."""

    def expire(*_):
        raise AssertionError("hangs")

    before = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < mebibytes * MIB
    finally:
        tracemalloc.stop()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def refusal(action, *arguments, error=ArtefactError, **settings):
    """The one line with which an action fails, soon and without much memory."""
    with bounded(), pytest.raises(error) as caught:
        action(*arguments, **settings)
    assert type(caught.value) is error
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 1000
    return str(caught.value)


# ---- what is no regular file


def unix_socket(path, monkeypatch):
    monkeypatch.chdir(path.parent)  # the name of a socket has at most 107 bytes
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)


SPECIAL = {
    "pipe": lambda path, _: os.mkfifo(path),
    "socket": unix_socket,
    "device": lambda path, _: path.symlink_to("/dev/zero"),
    "folder": lambda path, _: path.mkdir(),
    "link to itself": lambda path, _: path.symlink_to(path.name),
}
FILES = {
    "policy.npz": lambda run: policy.load(run),
    "policy.json": lambda run: policy.load(run),
    "certificate.json": lambda run: policy.load(run),
    "metrics.jsonl": lambda run: store.read_jsonl(run / "metrics.jsonl"),
    "results.json": lambda run: reporting.write_report(run),
    "episodes.npz": lambda run: reporting.write_report(run),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", SPECIAL)
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, monkeypatch, name, kind):
    run = tmp_path / "run"
    shutil.copytree(SHIPPED, run)
    policy.load(run)  # what is compiled once is not what is timed
    (run / name).unlink(missing_ok=True)
    SPECIAL[kind](run / name, monkeypatch)
    if kind == "link to itself" and name not in (
        "policy.npz",
        "policy.json",
        "metrics.jsonl",
    ):
        pytest.skip("to a reader of what may be missing, such a link is missing")
    assert name.split(".")[0] in refusal(FILES[name], run)


@pytest.mark.parametrize("name", ["a.csv", "a.npz", "a.parquet"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_pipe_among_logs_is_refused_at_once(tmp_path, name, whole):
    os.mkfifo(tmp_path / name)
    path = str(tmp_path if whole else tmp_path / name)
    with (
        bounded(),
        pytest.raises(
            (ArtefactError, ValueError), match=f"{name}: (not a regular|no such)"
        ),
    ):
        datasets.from_logs(
            path, datasets.Columns(), dt=0.1, wheelbase=2.7, report=lambda line: None
        )


@pytest.mark.parametrize("name", ["controller.json", "act.stablehlo"])
@pytest.mark.parametrize("kind", SPECIAL)
def test_an_export_of_what_is_no_regular_file_is_refused_at_once(
    tmp_path, monkeypatch, name, kind
):
    fuzzing_readers.make_export(tmp_path)
    (tmp_path / name).unlink()
    SPECIAL[kind](tmp_path / name, monkeypatch)
    assert name in refusal(
        loader.ExportedController, tmp_path, error=loader.ExportError
    )


# ---- documents


@pytest.mark.parametrize(
    "text",
    [
        *(
            '{"a": NaN}',
            '{"a": -Infinity}',
            '{"a": 1e999}',
            '{"a": 1, "a": 2}',
            '{"b": {"a": 1, "a": 2}}',
        ),
        *(
            '{"a": 1' + "0" * 5000 + "}",
            '{"a": 18446744073709551616}',
            r'{"a": "\ud800"}',
            r'{"\udfff": 1}',
        ),
        *('{"a": ' + "[" * n + "]" * n + "}" for n in (65, 900, 3000, 100_000)),
    ],
)
def test_documents_that_readers_would_understand_differently_are_refused(
    tmp_path, text
):
    path = tmp_path / "a.json"
    path.write_text(text)
    assert refusal(store.read_json, path).startswith(f"{path}: truncated or not JSON (")
    path = tmp_path / "a.jsonl"
    path.write_text(f"{text}\n")
    assert refusal(store.read_jsonl, path).startswith(
        f"{path}: line 1 truncated or not JSON ("
    )


def test_a_mark_of_byte_order_and_whole_surrogate_pairs_are_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(
        b"\xef\xbb\xbf" + rb'{"a": "\ud83d\ude00", "b": 18446744073709551615}'
    )
    assert store.read_json(path) == {"a": "\U0001f600", "b": 2**64 - 1}


def test_a_document_is_not_read_beyond_its_bound(tmp_path):
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    assert refusal(store.read_json, path) == f"{path}: larger than 16 MiB"


@pytest.mark.parametrize("value", ["word", [], 3, None])
@pytest.mark.parametrize("name", ["versions", "config", "made_from"])
def test_a_manifest_whose_parts_are_no_dictionaries_is_refused(tmp_path, name, value):
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    manifest = json.loads((tmp_path / "policy.json").read_bytes())
    (tmp_path / "policy.json").write_text(json.dumps(manifest | {name: value}))
    assert (
        refusal(policy.load, tmp_path)
        == f"{tmp_path / 'policy.json'}: not a manifest, {name} is malformed"
    )


def test_a_long_value_is_not_repeated_in_the_line(tmp_path):
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    manifest = json.loads((tmp_path / "policy.json").read_bytes())
    (tmp_path / "policy.json").write_text(
        json.dumps(manifest | {"kind": "\x1b[31m\n" + "x" * 100_000})
    )
    line = refusal(policy.load, tmp_path)
    assert "is of kind \\x1b[31m xxx" in line


# ---- arrays


def write_zip(path, header, data=b"\0" * 24, *, declared=None):
    """An npz file of one array with any header."""
    length = len(header) if declared is None else declared
    member = b"\x93NUMPY\x01\0" + struct.pack("<H", length) + header + data
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("x.npy", member)
    return path


def header(descr="'<f8'", order="False", shape="(3,)"):
    return (
        f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            header(shape="(1000000000000,)"),
            "x.npy declares 8000000000000 bytes and holds 24",
        ),
        (header(shape="(99999, 99999, 99999)"), "and holds 24"),
        (header(shape="(2,)"), "x.npy declares 16 bytes and holds 24"),
        (header(descr="'<U999999999'"), "damaged"),
        (header(descr="'|O'"), "holds pickled objects, refused"),
        (header(descr="'|V8'"), "not portable"),
        (header(descr="[('a', '<f8')]"), "no header of plain numbers"),
        (header(shape="(3"), "no header of plain numbers"),
        (header(shape="(3)"), "no shape"),
        (header() + b"'''", "no header of plain numbers"),
        (b"(" * 1900, "no header of plain numbers"),
        (b"-" * 60_000, "has a header of 60000 bytes"),
        (header(descr="__import__('os').abort()"), "no header of plain numbers"),
    ],
)
def test_headers_are_compared_with_the_bytes_and_not_evaluated(tmp_path, text, message):
    path = write_zip(tmp_path / "x.npz", text)
    line = refusal(store.read_npz, path)
    assert line.startswith(f"{path}: ")
    assert message in line
    with bounded(), pytest.raises(ValueError, match=r"x\.npz"):
        datasets.from_logs(
            str(path),
            datasets.Columns(),
            dt=0.1,
            wheelbase=2.7,
            report=lambda line: None,
        )


def test_a_zip_file_of_another_compression_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_LZMA) as packed:
        packed.writestr("x.npy", b"\x93NUMPY")
    assert "another method than deflate" in refusal(store.read_npz, tmp_path / "x.npz")


def test_compressed_members_are_bounded_before_they_are_inflated(tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(bomb(600))
    assert "inflates to 600 MiB, more than 512" in refusal(store.read_npz, path)
    whole = bytearray(bomb(8))
    at = whole.rfind(b"PK\x01\x02") + 24
    whole[at : at + 4] = struct.pack(
        "<I", 1 << 28
    )  # declared larger than its 8 KiB can be
    path.write_bytes(whole)
    assert "larger than it can inflate to" in refusal(store.read_npz, path)


def test_nothing_is_inflated_that_is_not_what_the_manifest_records(tmp_path):
    path = tmp_path / "x.npz"
    store.write_arrays(path, {"x": np.zeros(3)}, kind="k", config={}, compressed=True)
    path.write_bytes(bomb(400))
    assert "does not match its manifest: sha256" in refusal(
        store.read_arrays, path, kind="k"
    )


def test_manifests_without_a_hash_of_the_file_stay_readable(tmp_path):
    path = tmp_path / "x.npz"
    manifest = store.write_arrays(path, {"x": np.arange(3)}, kind="k", config={})
    del manifest["file_sha256"]
    store.write_json(path.with_suffix(".json"), manifest)
    np.testing.assert_array_equal(
        store.read_arrays(path, kind="k")[0]["x"], np.arange(3)
    )
    store.write_json(path.with_suffix(".json"), manifest | {"file_sha256": "no hash"})
    assert "file_sha256 is malformed" in refusal(store.read_arrays, path, kind="k")


def test_the_same_arrays_make_the_same_file(tmp_path):
    made = [
        store.write_arrays(
            tmp_path / f"{name}.npz", {"x": np.eye(3)}, kind="k", config={}
        )
        for name in "ab"
    ]
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert made[0]["file_sha256"] == made[1]["file_sha256"]


@pytest.mark.parametrize("compressed", [False, True])
def test_other_bytes_of_the_same_content_that_wait_do_not_hide_those_recorded(
    tmp_path, monkeypatch, compressed
):
    path, replace = tmp_path / "x.npz", os.replace
    store.write_arrays(path, {"x": np.zeros(99)}, kind="k", config={})

    def killed(source, target):
        if Path(target).suffix == ".json":
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        store.write_arrays(
            path, {"x": np.zeros(99)}, kind="k", config={}, compressed=compressed
        )
    monkeypatch.undo()
    np.testing.assert_array_equal(
        store.read_arrays(path, kind="k")[0]["x"], np.zeros(99)
    )


def test_a_cell_of_a_csv_file_does_not_make_all_others_as_wide(tmp_path):
    rows = ["t,p_x,p_y,yaw,v,steering,acceleration,friction,wind,note"]
    rows += [f"{0.1 * k:.1f},{0.5 * k:.1f},0,0,5,0,0,0.9,0,a" for k in range(20_000)]
    rows[7] = rows[7][:-1] + "x" * 100_000
    (tmp_path / "a.csv").write_text("\n".join(rows))
    with (
        bounded(seconds=60, mebibytes=200),
        pytest.raises(ValueError, match="steering is always 0"),
    ):
        datasets.from_logs(
            str(tmp_path),
            datasets.Columns(),
            dt=0.1,
            wheelbase=2.7,
            report=lambda line: None,
        )


# ---- exported controllers


def forged(folder, change):
    """A manifest that was changed and sealed again."""
    manifest = json.loads((folder / "controller.json").read_bytes())
    change(manifest)
    (folder / "controller.json").write_bytes(fuzzing_readers.sealed(manifest))


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.pop("programs"),
        lambda m: m.update(programs=[1]),
        lambda m: m["programs"].pop("act"),
        lambda m: m["programs"]["act"].pop("sha256"),
        lambda m: m["programs"]["act"].update(bytes="many"),
        lambda m: m["programs"]["act"].update(file="../act.stablehlo"),
        lambda m: m["programs"]["act"].update(file="/dev/zero"),
        lambda m: m["programs"]["act"].update(file="act\0"),
        lambda m: m["programs"]["act"].update(file=""),
        lambda m: m["programs"]["act"].update(file=".."),
        lambda m: m["programs"]["act"].update(inputs=None),
        lambda m: m["programs"]["act"]["inputs"][1].update(name=["observation"]),
        lambda m: m["programs"]["act"]["inputs"][1].update(shape=[10**12]),
        lambda m: m["programs"]["act"]["outputs"].reverse(),
        lambda m: m.update(key_implementation="dice"),
        lambda m: m.update(key_implementation=None),
    ],
)
def test_an_export_that_contradicts_itself_is_refused(tmp_path, change):
    fuzzing_readers.make_export(tmp_path)
    loader.ExportedController(tmp_path)
    forged(tmp_path, change)
    assert str(tmp_path) in refusal(
        loader.ExportedController, tmp_path, error=loader.ExportError
    )


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 5000 + "1" + "}" * 5000, "NaN", "\ufeff{}", "[]"]
)
def test_a_manifest_of_an_export_that_is_none_is_refused(tmp_path, text):
    fuzzing_readers.make_export(tmp_path)
    (tmp_path / "controller.json").write_text(text)
    assert "controller.json: " in refusal(
        loader.ExportedController, tmp_path, error=loader.ExportError
    )


def test_an_export_changed_in_a_number_that_no_program_holds_is_refused(tmp_path):
    fuzzing_readers.make_export(tmp_path)
    path = tmp_path / "controller.json"
    path.write_bytes(
        path.read_bytes().replace(
            b'"sampling_period_s": 0.1', b'"sampling_period_s": 0.2'
        )
    )
    assert "changed, its sha256" in refusal(
        loader.ExportedController, tmp_path, error=loader.ExportError
    )


# ---- pages


def test_a_report_that_the_disk_refuses_is_one_line(tmp_path):
    fuzzing_readers.make_run(tmp_path)
    (tmp_path / "report").write_text("a file")
    assert "report" in refusal(reporting.write_report, tmp_path)
    (tmp_path / "report").unlink()
    (tmp_path / "report" / "figures" / "old.png").mkdir(parents=True)
    assert "old.png" in refusal(reporting.write_report, tmp_path)


def test_a_report_of_rows_that_are_none_names_the_file(tmp_path):
    fuzzing_readers.make_run(tmp_path)
    for rows in ("word", [1], {"a": 1}, 7):
        store.write_json(tmp_path / "results.json", {"rows": rows})
        assert "results.json: malformed" in refusal(reporting.write_report, tmp_path)


def test_a_row_cannot_name_arrays_outside_its_folder(tmp_path):
    document = json.loads(Path(__file__).with_name("rows.json").read_bytes())
    rows = [row | {"arrays": "../../outside.npz"} for row in document["rows"][:3]]
    store.write_json(tmp_path / "results.json", document | {"rows": rows})
    with pytest.raises(ArtefactError, match="outside this folder"):
        paper.write_results_page(tmp_path)
