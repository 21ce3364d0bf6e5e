"""Files: arrays with their manifest (safetensors), JSON and locks.

Every failure is an `ArtefactError`, one line that names the file. A file is replaced
atomically, so a writer that is killed leaves the old file or the new one.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import secrets
import shlex
import socket
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from datetime import UTC, datetime
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

SUFFIX = ".safetensors"
FORMAT = 2
"""Version of the manifest; a reader refuses every other one."""
MAX_LINE = 400
"""The most characters of a message, which may quote the file that it is about."""
LOCK = ".lock"
"""The file in a directory whose lock a writer holds."""
HOLDER = ".lock.holder"
"""The file beside it that names the writer."""
GRACE_S = 2.0
"""Time to wait for a writer that is about to finish [s]."""


class ArtefactError(Exception):
    """A file cannot be read or written; one line with its name and the reason."""


class DirectoryLocked(ArtefactError):
    """Another process writes into a directory; the message names the process."""


def failure(path: Path, reason: object) -> ArtefactError:
    """Return the error to raise about `path`; `reason` may be an exception."""
    text = reason.strerror or reason if isinstance(reason, OSError) else reason
    return ArtefactError(f"{path}: {one_line(text)}")


def one_line(text: object) -> str:
    """Shorten a reason to one printable line, without control characters."""
    line = " ".join(str(text)[: 4 * MAX_LINE].split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return line if len(line) <= MAX_LINE else f"{line[:MAX_LINE]}..."


@contextmanager
def as_artefact_error(
    path: Path, *also: type[Exception], advice: str = ""
) -> Iterator[None]:
    """Turn exceptions about a file or its content into an ArtefactError.

    These exceptions are OSError, those of missing keys and wrong types, and `also`. An
    OSError that names another file is reported about that file.

    Args:
        path: the file.
        also: further exceptions that a wrong content may raise.
        advice: what a message about the content ends with.
    """
    usual = (KeyError, TypeError, IndexError, AttributeError, OverflowError)
    try:
        yield
    except OSError as reason:
        named = Path(os.fsdecode(reason.filename)) if reason.filename else path
        raise failure(named, reason) from reason
    except (*usual, RecursionError, *also) as reason:
        message = f"malformed, {type(reason).__name__}: {reason}"
        if advice:
            message = f"{message}; {advice}"
        raise failure(path, message) from reason


def print_message(message: str) -> None:
    """Print a message for a person to stderr; stdout is for the result of a command."""
    print(message, file=sys.stderr, flush=True)


# ---- content


def sha256(document: Any) -> str:
    """Hash the JSON that a value would become, whatever the order of its keys."""
    text = json.dumps(plain(document), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_of_arrays(arrays: Mapping[str, Any]) -> str:
    """Hash names, dtypes, shapes and values, whatever their order and layout."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def content_hash(manifest: Mapping[str, Any]) -> str:
    """Return the hash of the arrays and all settings that a manifest describes."""
    return sha256({"weights": manifest["sha256"], "settings": manifest["config"]})


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List where settings differ, as "steps was 4000, is now 100"; 1 equals 1.0."""

    def short(value: Any) -> str:
        text = "absent" if value is ... else str(plain(value))
        return text if len(text) <= 60 else f"{text[:57]}..."

    lines = []
    for key in dict.fromkeys([*old, *new]):
        before = old.get(key, ...)
        after = new.get(key, ...)
        # True == 1 in Python, but a switch is no number.
        one_is_switch = isinstance(before, bool) != isinstance(after, bool)
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            lines += [f"{key}.{line}" for line in differences(before, after)]
        elif one_is_switch or plain(before) != plain(after):
            lines.append(f"{key} was {short(before)}, is now {short(after)}")
    return lines


def plain(value: Any) -> Any:
    """Convert a value, also arrays and settings, to JSON types; NaN becomes None."""
    if is_dataclass(value):
        value = vars(value)
    if hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


# ---- bytes


def read_bytes(path: Path) -> bytes:
    """Return the content of `path`, or raise an ArtefactError."""
    with as_artefact_error(path, ValueError):  # ValueError: an impossible file name
        return path.read_bytes()


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` atomically; if the disk refuses, an earlier file stays."""
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            file.write(content)
            file.flush()
            # On the disk before the name is: a crash must not leave half a file.
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise failure(path, error) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


# ---- arrays


def write_arrays(
    path: Path,
    arrays: Mapping[str, Any],
    *,
    kind: str,
    config: Mapping[str, Any],
    made_from: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Write arrays and their manifest to one file, and return the manifest.

    `sha256` in the manifest identifies the arrays, and `content_sha256` the arrays with
    all settings. Both are independent of order and layout. Other documents refer to
    them.

    Args:
        path: path of the file, which ends in `SUFFIX`.
        arrays: numbers and truth values by name; nothing else has a portable form.
        kind: what the file is, which its readers must ask for.
        config: the settings that the arrays were made with.
        made_from: hashes of the artefacts that the arrays were made from, by kind.
    """
    if path.suffix != SUFFIX:
        raise failure(path, f"not written, the name must end in {SUFFIX}")
    stored: dict[str, np.ndarray] = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise failure(path, f"not written, {name} is of dtype {array.dtype}")
        # The library writes memory as it lies: rows first, in the machine's byte order.
        stored[name] = np.asarray(array, array.dtype.newbyteorder("="), order="C")
    manifest = {
        "kind": kind,
        "format": FORMAT,
        "sha256": sha256_of_arrays(stored),
        "config": plain(config),
        "made_from": made_from or {},
        "versions": versions(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    with as_artefact_error(path, ValueError, advice="not written"):
        manifest["content_sha256"] = content_hash(manifest)
        # One entry: safetensors writes several in an order that changes.
        text = json.dumps(manifest)
    write_bytes(path, save(stored, {"manifest": text}))
    return manifest


def read_arrays(
    path: Path, *, kind: str, config: Mapping[str, Any] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of `path` and their manifest; nothing is ever unpickled.

    Args:
        path: path of the file.
        kind: the kind that the file must be of.
        config: the settings that the arrays must have been made with; None for any.

    Raises:
        ArtefactError: the file has another kind or format, or other settings, or its
            arrays or settings do not match their hashes.
    """
    advice = "the file is truncated, damaged or foreign"
    with as_artefact_error(path, SafetensorError, ValueError, advice=advice):
        path.open("rb").close()  # the system's reason why not, before the library's
        with safe_open(path, framework="numpy") as file:
            text = (file.metadata() or {}).get("manifest", "")
            if not text:
                raise failure(path, "foreign, it has no manifest of sfkd_jax")
            manifest = _decode(path, text.encode(), where="its manifest is ")
            _check_manifest(path, kind, manifest)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if sha256_of_arrays(arrays) != manifest["sha256"]:
        raise failure(path, "its arrays do not match the sha256 of its manifest")
    changed = [] if config is None else differences(manifest["config"], config)
    if changed:
        listed = "; ".join(changed[:3])
        if len(changed) > 3:
            listed += f" and {len(changed) - 3} more"
        raise failure(path, f"made with other settings: {listed}")
    return arrays, manifest


def _check_manifest(path: Path, kind: str, manifest: dict[str, Any]) -> None:
    """Refuse another kind or format, and settings that do not match their hash."""
    with as_artefact_error(path):
        for name, wanted in (("kind", kind), ("format", FORMAT)):
            if manifest[name] != wanted:
                raise failure(path, f"is of {name} {manifest[name]}, not {wanted}")
        for name in ("config", "made_from", "versions"):
            if not isinstance(manifest[name], dict):
                raise failure(path, f"its manifest is malformed, {name}")
        if content_hash(manifest) != manifest["content_sha256"]:
            raise failure(path, "its settings were changed since it was written")


# ---- JSON


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Replace `path` atomically; arrays become lists, NaN and infinities null."""
    with as_artefact_error(path, ValueError, advice="not written"):
        text = json.dumps(plain(document), indent=2)
    write_bytes(path, text.encode())


def read_json(path: Path, *, keys: Sequence[str] = ()) -> dict[str, Any]:
    """Return the JSON object in `path`, which has `keys`.

    NaN and infinities are refused: they are in no range that a reader could check.
    """
    return _decode(path, read_bytes(path), keys=keys)


def _decode(
    path: Path, text: bytes, *, where: str = "", keys: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the JSON object in `text`, or raise an ArtefactError about `path`."""
    try:
        document = json.loads(
            text.decode("utf-8-sig"), parse_float=_finite, parse_constant=_finite
        )
    except (ValueError, RecursionError) as error:
        raise failure(path, f"{where}truncated or not JSON ({error})") from error
    if not isinstance(document, dict):
        raise failure(path, f"{where}not a JSON object")
    if absent := [key for key in keys if key not in document]:
        raise failure(path, f"{where}lacks {', '.join(absent)}")
    return document


def _finite(text: str) -> float:
    """Return a number; NaN, Infinity and 1e999 are none that JSON can hold."""
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is not finite")
    return number


def read_jsonl(path: Path, *, keys: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return the JSON objects in the lines of `path`.

    A line that is damaged or lacks one of `keys` is left out with a message. The last
    line is left out silently if it has no end: its writer was killed.
    """
    records = []
    for number, line in enumerate(read_bytes(path).split(b"\n")[:-1], 1):
        try:
            records.append(_decode(path, line, where=f"line {number} ", keys=keys))
        except ArtefactError as reason:
            print_message(f"{reason}; left out, the other lines stay")
    return records


def truncate_jsonl(
    path: Path, keep: Callable[[dict[str, Any]], bool], *, keys: Sequence[str] = ()
) -> None:
    """Replace `path` by the records to keep; a missing file stays missing."""
    if path.exists():
        kept = filter(keep, read_jsonl(path, keys=keys))
        text = "".join(f"{json.dumps(record)}\n" for record in kept)
        write_bytes(path, text.encode())


# ---- locks


@contextmanager
def locked(directory: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of `directory`, which is created if it is missing.

    The lock is reentrant. The system frees it when the process ends, however it ends;
    it also holds between hosts that share the directory. With `wait` a message is
    printed while another process holds it; otherwise that raises `DirectoryLocked`.
    """
    from filelock import FileLock, Timeout  # only writers need it

    holder = directory / HOLDER
    with as_artefact_error(directory / LOCK):
        directory.mkdir(parents=True, exist_ok=True)
        lock = FileLock(directory.resolve() / LOCK, is_singleton=True)
        try:
            lock.acquire(timeout=GRACE_S)
        except Timeout:
            known = holder.is_file()
            who = holder.read_text(errors="replace") if known else "another process"
            message = f"{directory}: {one_line(who)} is writing there"
            if not wait:
                advice = "try again when it has ended"
                raise DirectoryLocked(f"{message}; {advice}") from None
            print_message(f"waiting: {message}")
            lock.acquire()
    try:
        # Of nested locks the outermost says who holds it. The record of an earlier
        # holder may stay: it is read only while somebody holds the lock.
        if lock.lock_counter == 1:
            command = shlex.join(["python", *sys.orig_argv[1:]])[:200]
            since = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
            process = f"process {os.getpid()} on {socket.gethostname()}"
            write_bytes(holder, f"{process} ({command}, since {since})".encode())
        yield
    finally:
        lock.release()


# ---- provenance


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that numbers depend on."""
    installed = {"python": platform.python_version()}
    for name in ("numpy", "jax", "sfkd_jax"):
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = import_module(name).__version__
    return installed
