"""Damaged and foreign files are refused in one line that names them."""

import copy
import json
import os
import pickle
import random
import shutil
import warnings
from functools import cache
from pathlib import Path

import composing
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, SHARES, dataset, refusal_of
from jaxtyping import TypeCheckError

from sfkd_jax import data as datasets
from sfkd_jax import demo, policy, report, store, training
from sfkd_jax.experiment import data, runs
from sfkd_jax.settings import replace

SHIPPED = demo.SHIPPED / "kinematic"
WORSE = (None, "word", [], {}, -1, float("nan"), [[1, 2], 3], True, 10**400)
"""What a value of a document is replaced by."""
DOCUMENTS = {
    "policy.json": 60,
    "certificate.json": 60,
    "results.json": 20,
    "settings.json": 10,
}
"""Document -> how many times it is spoiled."""
BYTES = {"policy.npz": 12, "policy.json": 8, "certificate.json": 8, "dataset.npz": 12}
ROW = {"system": "sfkd", "scenario": "s3", "vehicle": "kinematic", "env": "measured"}


class Bomb:
    """Loading it fails the test."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was loaded",)


@pytest.fixture
def run(tmp_path):
    """A run directory with the documents that `train` writes."""
    run_dir = tmp_path / "runs" / "smoke" / "sfkd" / "seed=0"
    shutil.copytree(SHIPPED, run_dir)
    store.write_json(run_dir / "results.json", {"rows": [ROW]})
    store.write_json(
        run_dir / "settings.json",
        {"seed": 0, "model": {"rank": 32}, "training": {"steps": 100}},
    )
    return run_dir


def settings_of(run):
    """Settings that lead to a run directory."""
    root, name = run.parents[2], run.parents[1].name
    system = run.parent.name
    return composing.settings(f"root={root}", f"name={name}", f"model.system={system}")


@cache
def shipped():
    """The shipped policy; one object, so that it is compiled once."""
    return policy.load(SHIPPED)


def read_policy(run):
    """Read a policy and its certificate; one without a certificate counts as refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = policy.load(run)
        except TypeCheckError:  # tests check types before anything is verified
            raise ValueError("certificate: of other types") from None
    if result.certificate is None:
        raise ValueError(str(caught[-1].message))


def read(run, name):
    """Read a file as the commands do."""
    if name == "results.json":
        runs.read_results(run)
    elif name == "settings.json":
        runs.claim(settings_of(run))
    else:
        read_policy(run)


def paths_in(value, at=()):
    """The paths of all values in a document."""
    entries = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value[:2])
        if isinstance(value, list)
        else ()
    )
    for key, inner in entries:
        yield (*at, key)
        yield from paths_in(inner, (*at, key))


def spoiled(document, draw):
    """The document with one value gone or replaced."""
    changed, (*above, last) = (
        copy.deepcopy(document),
        draw.choice(list(paths_in(document))),
    )
    inner = changed
    for key in above:
        inner = inner[key]
    if isinstance(inner, dict) and draw.random() < 0.4:
        del inner[last]
    else:
        inner[last] = draw.choice(WORSE)
    return changed


def damaged(content, draw):
    """Bytes that were cut, changed, doubled, or that never were of this kind."""
    at = draw.randrange(len(content))
    flipped = bytes([content[at] ^ (1 << draw.randrange(8))])
    foreign = (
        b"",
        pickle.dumps(Bomb()),
        draw.randbytes(500),
        b"PK\x03\x04" + draw.randbytes(200),
        b"\xff\xfe\x00",
    )
    changes = (
        content[:at],
        content[:at] + flipped + content[at + 1 :],
        content[at:] + content,
        draw.choice(foreign),
    )
    return draw.choice(changes)


def snapshot(folder):
    return {
        file: file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()
    }


def survives(action, file, content):
    """Write what is wrong, read it, put back what was there: the line of the refusal;
    nothing else has changed.
    """
    folder, before = file.parent, file.read_bytes()
    file.write_bytes(content)
    held = snapshot(folder)
    line = refusal_of(action)
    assert snapshot(folder) == held
    file.write_bytes(before)
    return line


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_with_a_value_gone_or_of_another_kind_is_refused_in_one_line_or_does_as_well(
    run, name
):
    draw, good, lines = random.Random(1), json.loads((run / name).read_text()), []
    for _ in range(DOCUMENTS[name]):
        text = json.dumps(spoiled(good, draw)).encode()
        lines.append(survives(lambda: read(run, name), run / name, text))
    refused = [line for line in lines if line]
    # Most values of a certificate are informative only.
    assert len(refused) >= len(lines) // 5
    assert [
        line
        for line in refused
        if not any(word in line for word in (name, "certificate", run.name))
    ] == []
    assert refusal_of(lambda: read(run, "policy.json")) is None


@pytest.mark.parametrize("name", BYTES)
def test_damaged_bytes_are_refused_or_read_the_same(run, name):
    draw, file, read_it = random.Random(2), run / name, read_policy
    if name == "dataset.npz":
        settings = settings_of(run)
        data.write(data.source_of(settings), dataset(count=20, steps=8))
        file = data.source_of(settings).path

        def read_it(_):
            data.read(data.source_of(settings))

    lines = [
        survives(lambda: read_it(run), file, damaged(file.read_bytes(), draw))
        for _ in range(BYTES[name])
    ]
    refused = [line for line in lines if line]
    assert len(refused) >= 0.7 * len(lines)
    assert [line for line in refused if file.stem not in line] == []
    assert refusal_of(lambda: read_it(run)) is None


@pytest.mark.parametrize(
    "name",
    [
        "results.json",
        "open_loop.json",
        "certificate.json",
        "metrics.jsonl",
        "episodes.npz",
    ],
)
def test_a_report_names_the_file_that_it_cannot_draw(run, name):
    for text in (
        b'{"rows": [',
        b"\xff\xfe",
        b"[1, 2]",
        b"7\n7\n",
        b"PK\x03\x04 not a zip file",
    ):
        (run / name).write_bytes(text)
        line = refusal_of(lambda: report.run(settings_of(run)))
        assert line is None or name in line
    assert (name == "metrics.jsonl") or line


def test_lines_of_a_training_log_that_are_none_are_dropped(tmp_path):
    good = b'{"step": 5, "loss": 1.0}\n'
    for tail in (b"7\n", b"{}\n", b'{"step": "a"}\n', b'{"step": 1', b"\x00\n"):
        (tmp_path / "metrics.jsonl").write_bytes(good + tail)
        training._log.TrainingLog(tmp_path, steps=10, resumed_at=5)
        assert store.read_jsonl(tmp_path / "metrics.jsonl") == [json.loads(good)]


# ---- a command with what cannot be composed; a full disk; a directory that cannot be written


def full(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_is_one_line_keeps_what_was_there_and_the_same_call_continues(
    run, monkeypatch, call
):
    settings, root, drives = (
        settings_of(run),
        run.parents[2],
        dataset(count=20, steps=8),
    )

    def work():
        store.write_json(run / "results.json", {"rows": [ROW, ROW]})
        data.write(data.source_of(settings), drives)

    before = snapshot(root)
    with monkeypatch.context() as disk:
        disk.setattr(os, call, full)
        assert refusal_of(work) == f"{run / 'results.json'}: No space left on device"
    assert snapshot(root) == before
    work()
    assert len(store.read_json(run / "results.json")["rows"]) == 2
    data.read(data.source_of(settings))


def refuse(*_, **__):
    raise OSError(30, "Read-only file system", "runs")


@pytest.mark.parametrize("call", ["mkdir", "open"])
def test_a_read_only_directory_is_one_line_and_keeps_its_files(run, monkeypatch, call):
    settings, root = replace(settings_of(run), name="another"), run.parents[2]
    before = snapshot(root)
    with monkeypatch.context() as read_only:
        read_only.setattr(Path, call, refuse)
        assert "Read-only file system" in refusal_of(lambda: runs.claim(settings))
        assert "Read-only file system" in refusal_of(
            lambda: store.write_json(run / "results.json", {"rows": []})
        )
    assert {
        file: content for file, content in snapshot(root).items() if file in before
    } == before
    runs.claim(settings)


def test_segments_that_are_not_finite_are_no_data_set():
    good = dataset(count=20, steps=8).train
    for value in (np.nan, np.inf):
        bad = good._replace(states=good.states.at[0, 3, 3].set(value))
        low, high = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)
        with pytest.raises(
            ValueError, match="states of the trajectories are not finite"
        ):
            datasets.split(
                bad, jax.random.key(0), shares=SHARES, env_low=low, env_high=high
            )
