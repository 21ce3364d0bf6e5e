"""Readers for the fuzzer: valid folders, changes of their files, expected results."""

import contextlib
import hashlib
import io
import json
import random
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import fuzzing_mutations as mutations
import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from sfkd_jax import data as datasets
from sfkd_jax import paper, policy, reporting, store
from sfkd_jax.export import _run_controller as loader

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "src" / "sfkd_jax" / "pretrained" / "kinematic"
Change = Callable[[random.Random, bytes], bytes]


class Reader(NamedTuple):
    """One way of reading.

    Attributes:
        make: writes a valid folder.
        files: file -> function that changes it.
        read: reads the folder.
        holds: whether the result agrees with the content of the folder.
        refusals: types of a refusal.
    """

    make: Callable[[Path], None]
    files: dict[str, Change]
    read: Callable[[Path], Any]
    holds: Callable[[Any, Path], bool]
    refusals: tuple[type[Exception], ...] = (store.ArtefactError,)


# ---- documents


def plain_json(content: bytes) -> Any:
    """Parse a document with Python's own reader; duplicate keys are refused."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    return json.loads(content.decode("utf-8-sig"), object_pairs_hook=once)


def equal(a: Any, b: Any) -> bool:
    """Whether two documents are the same, where 1, 1.0 and true differ."""
    return repr(a) == repr(b)


def make_document(folder: Path) -> None:
    shutil.copy(SHIPPED / "policy.json", folder / "a.json")


def read_document(folder: Path) -> Any:
    return store.read_json(folder / "a.json")


def document_holds(result: Any, folder: Path) -> bool:
    return equal(result, plain_json((folder / "a.json").read_bytes())) and equal(
        store.sha256(result)[:0], ""
    )


def make_lines(folder: Path) -> None:
    for step in range(12):
        store.append_jsonl(
            folder / "a.jsonl",
            {"step": step, "loss": 0.5**step, "parts": {"x": [step]}, "w": "é"},
        )


def read_lines(folder: Path) -> Any:
    return store.read_jsonl(folder / "a.jsonl")


def lines_hold(result: Any, folder: Path) -> bool:
    *lines, last = (folder / "a.jsonl").read_bytes().split(b"\n")
    expected = [plain_json(line) for line in lines if line.strip()]
    return equal(result, expected) or equal(result, [*expected, plain_json(last)])


# ---- arrays

ARRAYS = {
    "t": np.arange(20) * 0.1,
    "params/A": np.arange(12, dtype=np.float32).reshape(3, 4),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "scalar": np.array(2.5),
    "empty": np.zeros((0, 3), np.int8),
    "flags": np.array([True, False]),
    "words": np.array(["S1", "σ"]),
    "when": np.array(["2020-01-01"], "<M8[s]"),
}


def make_arrays(folder: Path) -> None:
    store.write_arrays(
        folder / "a.npz",
        ARRAYS,
        kind="fuzzed",
        config={"seed": 0, "model": {"rank": 3}},
    )
    manifest = store.read_json(folder / "a.json")
    manifest.pop("file_sha256", None)  # as an earlier version or an attacker writes it
    shutil.copy(folder / "a.npz", folder / "b.npz")
    store.write_json(folder / "b.json", manifest)


def read_arrays(folder: Path) -> Any:
    return [store.read_arrays(folder / f"{name}.npz", kind="fuzzed") for name in "ab"]


def arrays_hold(result: Any, folder: Path) -> bool:
    return all(
        same_arrays(arrays, ARRAYS)
        and equal(manifest, plain_json((folder / f"{name}.json").read_bytes()))
        for name, (arrays, manifest) in zip("ab", result, strict=True)
    )


def same_arrays(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Whether names, dtypes, shapes and every bit agree."""
    agree = (
        a[n].dtype == b[n].dtype
        and a[n].shape == b[n].shape
        and a[n].tobytes() == b[n].tobytes()
        for n in a
    )
    return a.keys() == b.keys() and all(agree)


def make_npz(folder: Path) -> None:
    with (folder / "a.npz").open("wb") as file:
        np.savez(
            file, **{name.replace("/", "_"): array for name, array in ARRAYS.items()}
        )


def read_npz(folder: Path) -> Any:
    return store.read_npz(folder / "a.npz")


def npz_holds(result: Any, folder: Path) -> bool:
    with np.load(folder / "a.npz", allow_pickle=False) as arrays_file:
        return same_arrays(
            result, {name: np.asarray(arrays_file[name]) for name in arrays_file.files}
        )


# ---- logs


@cache
def recorded() -> dict[str, np.ndarray]:
    sys.path.append(str(Path(__file__).parent / "datasets"))
    from recorded import drive

    return drive(seconds=6.0)


def make_csv(folder: Path) -> None:
    rows = zip(*recorded().values(), strict=True)
    body = "\n".join(",".join(f"{value:.9g}" for value in row) for row in rows)
    (folder / "a.csv").write_text(f"{','.join(recorded())}\n{body}\n")


def make_log_npz(folder: Path) -> None:
    np.savez(folder / "a.npz", **recorded())


def make_parquet(folder: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(recorded()), folder / "a.parquet")


def log_reader(name: str, make: Callable[[Path], None], change: Change) -> Reader:
    """Reading one log, as `generate` does."""

    def read(folder: Path) -> Any:
        file = str(folder / name)
        return datasets.from_logs(
            file,
            datasets.Columns(),
            dt=0.1,
            wheelbase=2.7,
            steps=5,
            report=lambda line: None,
        )

    return Reader(
        make, {name: change}, read, log_holds, (store.ArtefactError, ValueError)
    )


def log_holds(result: Any, folder: Path) -> bool:
    """Whether a data set is of finite numbers."""
    parts = [
        getattr(result.dataset, part)
        for part in ("train", "validation", "calibration", "test")
    ]
    return all(
        bool(np.isfinite(np.asarray(leaf)).all()) for part in parts for leaf in part
    )


# ---- runs


@cache
def results() -> dict[str, Any]:
    """Two rows as `evaluate` writes them."""
    return json.loads((ROOT / "tests" / "rows.json").read_bytes())


def make_run(folder: Path) -> None:
    store.write_json(folder / "results.json", results())
    shutil.copy(SHIPPED / "policy.json", folder / "policy.json")


def read_rows(folder: Path) -> Any:
    path = folder / "results.json"
    rows = store.read_json(path, keys=("rows",))["rows"]
    with store.as_artefact_error(path):
        return store.merge([], rows)


def rows_hold(result: Any, folder: Path) -> bool:
    return equal(
        result, list(plain_json((folder / "results.json").read_bytes())["rows"])
    )


def read_report(folder: Path) -> Any:
    return reporting.write_report(folder)


def page_holds(result: Any, folder: Path) -> bool:
    return Path(result["report"]).read_text().endswith("</html>\n")


def read_benchmark(folder: Path) -> Any:
    path = folder / "results.json"
    document = store.read_json(path, keys=("rows",))
    with store.as_artefact_error(path):
        return paper.results_markdown(document)


def make_runs(folder: Path) -> None:
    for seed in range(2):
        run = folder / "runs" / f"seed={seed}"
        make_run(run) if run.mkdir(parents=True) is None else None
        store.write_json(
            run / "settings.json",
            {"seed": seed, "model": {"system": "sfkd", "rho": 0.9, "beta": 0.1}},
        )


def read_comparison(folder: Path) -> Any:
    return paper.write_comparison(folder, "runs/*", "page")


def load(folder: Path) -> Any:
    return policy.load(folder)


def make_policy(folder: Path) -> None:
    for file in SHIPPED.iterdir():
        shutil.copy(file, folder / file.name)


def policy_holds(result: Any, folder: Path) -> bool:
    """Whether a certified policy is the shipped one, and an uncertified one has the
    settings of its file.
    """
    shipped, settings = (
        shipped_policy(),
        plain_json((folder / "policy.json").read_bytes())["config"],
    )
    pairs = zip(*map(jax.tree.leaves, (result.params, shipped.params)), strict=True)
    expected = (
        shipped.settings
        if result.certificate is not None
        else settings
        | {"environment": settings["environment"] | {"source": "measured"}}
    )
    return all(np.array_equal(a, b) for a, b in pairs) and equal(
        result.settings, expected
    )


@cache
def shipped_policy() -> policy.Policy:
    return policy.load(SHIPPED)


# ---- exported controllers


def make_export(folder: Path) -> None:
    """A folder as `export` writes it, of the smallest controller."""

    def init(key: jax.Array) -> tuple[jax.Array]:
        return (key,)

    def act(
        key: jax.Array, observation: jax.Array, env: jax.Array, reference: jax.Array
    ) -> tuple[jax.Array, ...]:
        return observation[:2] + env + reference[0, :2], key, observation.sum()

    key, leaves = (
        jax.ShapeDtypeStruct((2,), "uint32"),
        {"observation": (4,), "env": (2,), "reference": (3, 4)},
    )
    taken = {
        name: jax.ShapeDtypeStruct(shape, "float32") for name, shape in leaves.items()
    }
    programs = {}
    for name, function, inputs, outputs in (
        ("init", init, {"key": key}, ["state.key"]),
        ("act", act, {"state.key": key} | taken, ["control", "state.key", "info.cost"]),
    ):
        exported = jax.export.export(jax.jit(function), platforms=("cpu",))(
            *inputs.values()
        )
        content = bytes(exported.serialize())
        store.write_bytes(folder / f"{name}.stablehlo", content)
        programs[name] = {
            "file": f"{name}.stablehlo",
            "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
            "inputs": described(inputs, exported.in_avals),
            "outputs": described(outputs, exported.out_avals),
        }
    manifest = {
        "kind": "controller",
        "format": loader.FORMAT,
        "jax": jax.__version__,
        "programs": programs,
    }
    manifest |= {
        "key_implementation": "threefry2x32",
        "sampling_period_s": 0.1,
        "controls": [{"name": "a"}],
    }
    manifest |= {"environment": {"low": [0.3, -8.0], "high": [0.9, 8.0]}, "horizon": 3}
    (folder / "controller.json").write_bytes(sealed(manifest))


def described(names: Any, values: Any) -> list[dict[str, Any]]:
    pairs = zip(names, values, strict=True)
    return [
        {"name": name, "shape": list(value.shape), "dtype": str(value.dtype)}
        for name, value in pairs
    ]


def sealed(manifest: dict[str, Any]) -> bytes:
    """A manifest with the hash that belongs to it."""
    message = {name: value for name, value in manifest.items() if name != "sha256"}
    with contextlib.suppress(RecursionError, ValueError):
        message["sha256"] = hashlib.sha256(
            json.dumps(message, sort_keys=True).encode()
        ).hexdigest()
    return json.dumps(message).encode()


def manifest_change(draw: random.Random, content: bytes) -> bytes:
    """Change a manifest, every second time with a hash that matches the change."""
    changed = mutations.json_change(draw, content)
    if draw.random() < 0.5:
        with contextlib.suppress(ValueError, RecursionError, AttributeError):
            return sealed(json.loads(changed))
    return changed


def read_export(folder: Path) -> Any:
    controller = loader.ExportedController(folder)
    state = controller.init(3)
    measured = {
        leaf["name"]: jnp.ones(leaf["shape"])
        for leaf in controller.manifest["programs"]["act"]["inputs"][1:]
    }
    with contextlib.redirect_stdout(io.StringIO()):
        return controller.manifest, [state, measured]


def export_holds(result: Any, folder: Path) -> bool:
    return equal(result[0], plain_json((folder / "controller.json").read_bytes()))


READERS = {
    "read_json": Reader(
        make_document, {"a.json": mutations.json_change}, read_document, document_holds
    ),
    "read_jsonl": Reader(
        make_lines, {"a.jsonl": mutations.lines_change}, read_lines, lines_hold
    ),
    "read_arrays": Reader(
        make_arrays,
        {
            name: mutations.json_change
            if name.endswith("json")
            else mutations.npz_change
            for name in ("a.json", "b.json")
        }
        | {"a.npz": mutations.npz_change, "b.npz": mutations.npz_change},
        read_arrays,
        arrays_hold,
    ),
    "read_npz": Reader(make_npz, {"a.npz": mutations.npz_change}, read_npz, npz_holds),
    "log_csv": log_reader("a.csv", make_csv, mutations.csv_change),
    "log_npz": log_reader("a.npz", make_log_npz, mutations.npz_change),
    "log_parquet": log_reader("a.parquet", make_parquet, mutations.byte_change),
    "merge": Reader(
        make_run, {"results.json": mutations.json_change}, read_rows, rows_hold
    ),
    "report": Reader(
        make_run,
        dict.fromkeys(("results.json", "policy.json"), mutations.json_change),
        read_report,
        page_holds,
    ),
    "benchmark": Reader(
        make_run,
        {"results.json": mutations.json_change},
        read_benchmark,
        lambda result, _: bool(result),
    ),
    "comparison": Reader(
        make_runs,
        dict.fromkeys(
            ("runs/seed=0/settings.json", "runs/seed=0/results.json"),
            mutations.json_change,
        ),
        read_comparison,
        page_holds,
    ),
    "exported": Reader(
        make_export,
        {"controller.json": manifest_change, "act.stablehlo": mutations.byte_change},
        read_export,
        export_holds,
        (loader.ExportError,),
    ),
    "load": Reader(
        make_policy,
        {
            "policy.json": mutations.json_change,
            "certificate.json": mutations.json_change,
            "policy.npz": mutations.npz_change,
        },
        load,
        policy_holds,
    ),
}
