"""Files: arrays with their manifest (safetensors), JSON and locks.

Every failure is an `ArtefactError`, one line that names the file. A file is replaced
atomically, so a writer that is killed leaves the old file or the new one.
"""

from __future__ import annotations

import glob
import hashlib
import io
import json
import math
import os
import platform
import secrets
import shlex
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

SUFFIX = ".safetensors"
FORMAT = 2
"""Version of the manifest; a reader refuses every other one."""
MAX_BYTES = 1 << 24
"""Size of a document; the largest of this package has 0.6 MB. Parsed JSON takes up to
35 times as much memory.
"""
MAX_DEPTH = 64
"""Levels of a JSON document; those of this package have at most 7."""
MAX_LINE = 400
"""Characters of a message, which may quote the file that it is about."""
LOCK, HOLDER = ".lock", ".lock.json"
GRACE_S = 2.0
"""Time to wait for a writer that is about to finish [s]."""
ABANDONED_S = 3600.0
"""Age of the hidden file of a killed writer from which the next writer removes it."""


class ArtefactError(Exception):
    """A file that cannot be read or written: its name and the reason, in one line."""


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
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError while files are written into an ArtefactError.

    Args:
        path: to blame if the exception names no file.
    """
    try:
        yield
    except OSError as reason:
        named = Path(os.fsdecode(reason.filename)) if reason.filename else path
        raise failure(named, reason) from reason


@contextmanager
def as_artefact_error(
    path: Path, *also: type[Exception], advice: str = ""
) -> Iterator[None]:
    """Turn exceptions about the content of a file into an ArtefactError.

    Args:
        path: of the file.
        also: exceptions to convert besides those of missing keys and wrong types.
        advice: appended to the message.
    """
    usual = (KeyError, TypeError, IndexError, AttributeError, OverflowError)
    try:
        yield
    except (*usual, *also) as reason:
        message = f"malformed, {type(reason).__name__}: {reason}"
        raise failure(path, f"{message}; {advice}" if advice else message) from reason


def print_message(message: str) -> None:
    """Print a message for a person to stderr; stdout is for the result of a command."""
    print(message, file=sys.stderr, flush=True)


# ---- content


def sha256(data: Mapping[str, Any] | Sequence[Any]) -> str:
    """Hash the content, independent of its order and memory layout.

    The hash of a flat dict of arrays covers names, dtypes, shapes and values; that of
    anything else covers the JSON that it would become.
    """
    if not (
        isinstance(data, Mapping)
        and data
        and all(
            hasattr(value, "__array__") and not isinstance(value, np.generic)
            for value in data.values()
        )
    ):
        text = json.dumps(plain(data), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()
    digest = hashlib.sha256()
    for name in sorted(data):
        array = np.asarray(data[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def content_hash(manifest: Mapping[str, Any]) -> str:
    """Return the hash of the arrays and all settings that a manifest describes."""
    return sha256({"weights": manifest["sha256"], "settings": manifest["config"]})


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List where settings differ, by dotted key; 1 and 1.0 are equal.

    An entry reads "training.steps was 4000, is now 100".

    Args:
        old: recorded settings.
        new: current settings.
    """

    def short(value: Any) -> str:
        text = "absent" if value is ... else str(plain(value))
        return text if len(text) <= 60 else f"{text[:57]}..."

    lines = []
    for key in dict.fromkeys([*old, *new]):
        a, b = old.get(key, ...), new.get(key, ...)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += [f"{key}.{line}" for line in differences(a, b)]
        # True == 1 in Python, but a switch is no number.
        elif isinstance(a, bool) != isinstance(b, bool) or plain(a) != plain(b):
            lines.append(f"{key} was {short(a)}, is now {short(b)}")
    return lines


def plain(value: Any) -> Any:
    """Convert to JSON types; arrays become lists, NaN and infinities None."""
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


def open_regular(path: Path) -> io.FileIO:
    """Open a regular file for reading, or raise an ArtefactError.

    A pipe, a socket or a device is refused without waiting for it.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except FileNotFoundError:
        raise failure(path, "missing") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        raise failure(path, error) from error
    mode = os.fstat(number).st_mode
    if stat.S_ISREG(mode):
        return io.FileIO(number)
    os.close(number)
    folder = stat.S_ISDIR(mode)
    raise failure(path, "Is a directory" if folder else "not a regular file")


def read_bytes(path: Path) -> bytes:
    """Return the content of `path`, of at most MAX_BYTES, or raise an ArtefactError."""
    with open_regular(path) as file, io.BufferedReader(file) as buffered:
        try:
            content = buffered.read(MAX_BYTES + 1)
        except OSError as error:
            raise failure(path, error) from error
    if len(content) > MAX_BYTES:
        raise failure(path, f"larger than {MAX_BYTES >> 20} MiB")
    return content


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` atomically.

    Raises:
        ArtefactError: the disk is full or not writable; an earlier file stays as it
            was.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
            with suppress(FileNotFoundError):  # another writer was faster
                if time.time() - left.stat().st_mtime > ABANDONED_S:
                    left.unlink()
        try:
            with part.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise failure(path, error) from error


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

    `sha256` in the manifest identifies the arrays and `content_sha256` the arrays and
    all settings, independent of order and layout; other documents refer to them.

    Args:
        path: of the file, ending in .safetensors.
        arrays: numbers or truth values, by name.
        kind: of artefact, such as "policy".
        config: settings that the arrays were made with.
        made_from: hashes of the artefacts that they were made from.

    Raises:
        ArtefactError: the disk is full or not writable (an earlier file stays as it
            was), `path` does not end in .safetensors, a dtype has no portable form
            (text, objects, bfloat16), or `config` is not JSON.
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
    manifest = {"kind": kind, "format": FORMAT, "sha256": sha256(stored)}
    settings = json.loads(encode(path, config))
    manifest |= {"config": settings, "made_from": made_from or {}}
    manifest["content_sha256"] = content_hash(manifest)
    manifest["versions"] = versions()
    manifest["created"] = datetime.now(UTC).isoformat(timespec="seconds")
    # One entry: safetensors writes several in an order that changes.
    text = encode(path, manifest).decode()
    write_bytes(path, save(stored, {"manifest": text}))
    return manifest


def read_arrays(
    path: Path, *, kind: str, config: Mapping[str, Any] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of `path` and their manifest; nothing is ever unpickled.

    Args:
        path: of the file.
        kind: that the artefact must have.
        config: settings that it must have been made with, or None for any.

    Raises:
        ArtefactError: the file is missing, truncated, damaged or foreign; the artefact
            is of another kind or format, was made with other settings than `config`,
            or arrays or settings do not match their hashes.
    """
    with _opened(path) as file:
        manifest = _manifest(path, kind, file)
        if config is not None and (
            changed := differences(manifest["config"], plain(config))
        ):
            more = f" and {len(changed) - 3} more" if changed[3:] else ""
            listed = "; ".join(changed[:3]) + more
            raise failure(path, f"made with other settings: {listed}")
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    actual, recorded = sha256(arrays), manifest["sha256"]
    if actual != recorded:
        message = f"sha256 {actual[:12]}, recorded {recorded[:12]}"
        raise failure(path, f"its arrays do not match its manifest: {message}")
    return arrays, manifest


def read_manifest(path: Path, *, kind: str) -> dict[str, Any]:
    """Return the manifest of `path` without reading its arrays; see `read_arrays`."""
    with _opened(path) as file:
        return _manifest(path, kind, file)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a safetensors file; what the library raises becomes an ArtefactError."""
    open_regular(path).close()  # a pipe would block the library
    try:
        with safe_open(path, framework="numpy") as file:
            yield file
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as reason:
        raise failure(path, f"truncated, damaged or foreign ({reason})") from reason


def _manifest(path: Path, kind: str, file: Any) -> dict[str, Any]:
    """Return the manifest of an open file, checked without its arrays."""
    text = (file.metadata() or {}).get("manifest")
    if text is None or len(text) > MAX_BYTES:
        raise failure(path, "foreign, it has no manifest of sfkd_jax")
    manifest = decode(path, text.encode(), where="its manifest is ")
    hashes = ("sha256", "content_sha256")
    if absent := [key for key in ("kind", "format", *hashes) if key not in manifest]:
        raise failure(path, f"its manifest lacks {', '.join(absent)}")
    if manifest["kind"] != kind:
        raise failure(path, f"is of kind {manifest['kind']}, not {kind}")
    if manifest["format"] != FORMAT:
        found = f"is of format {manifest['format']}"
        raise failure(path, f"{found}, this version reads {FORMAT}")
    for name in ("config", "made_from", "versions"):
        if not isinstance(manifest.get(name), dict):
            raise failure(path, f"its manifest is malformed, {name}")
    if not isinstance(manifest["sha256"], str) or (
        content_hash(manifest) != manifest["content_sha256"]
    ):
        raise failure(path, "its settings were changed since it was written")
    return manifest


# ---- JSON


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Replace `path` atomically; arrays become lists, NaN and infinities null.

    Raises:
        ArtefactError: the disk is full or not writable (an earlier file stays as it
            was), or a value is not JSON.
    """
    write_bytes(path, encode(path, document, indent=2))


def read_json(path: Path, *, keys: Sequence[str] = ()) -> dict[str, Any]:
    """Return the JSON object in `path`.

    Raises:
        ArtefactError: the file is missing, no regular file, larger than MAX_BYTES,
            truncated, not strictly JSON (see `decode`), or lacks one of `keys`.
    """
    document = decode(path, read_bytes(path))
    if absent := [key for key in keys if key not in document]:
        raise failure(path, f"lacks {', '.join(absent)}")
    return document


def encode(
    path: Path, document: Mapping[str, Any], *, indent: int | None = None
) -> bytes:
    """Return `document` as JSON, or raise an ArtefactError about `path`."""
    try:
        return json.dumps(plain(document), indent=indent, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise failure(path, f"not written, {error}") from error


def decode(path: Path, text: bytes, *, where: str = "") -> dict[str, Any]:
    """Return the JSON object in `text`, or raise an ArtefactError about `path`.

    Refused is what two parsers could read differently: a key twice in one object, NaN
    and infinities (also numbers that overflow), integers beyond 64 bits, half of a
    surrogate pair; and more levels than MAX_DEPTH, so that readers may recurse.
    """
    try:
        document = json.loads(
            text.decode("utf-8-sig"), parse_constant=_refuse, object_pairs_hook=_object
        )
        _check_values(document)
        json.dumps(document, ensure_ascii=False).encode()  # refuses lone surrogates
    except (ValueError, RecursionError) as error:
        raise failure(path, f"{where}truncated or not JSON ({error})") from error
    if not isinstance(document, dict):
        raise failure(path, f"{where}not a JSON object")
    return document


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:60]!r} occurs twice in one object")
    return document


def _check_values(value: Any, levels: int = MAX_DEPTH) -> None:
    """Refuse numbers that do not fit into 64 bits, and deep documents."""
    if isinstance(value, dict | list):
        if not levels:
            raise ValueError(f"more than {MAX_DEPTH} levels")
        for item in value.values() if isinstance(value, dict) else value:
            _check_values(item, levels - 1)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError("a number is larger than float64 holds")
    elif isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise ValueError("an integer does not fit into 64 bits")


def read_jsonl(path: Path, *, keys: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return the JSON objects in the lines of `path`.

    A line that is damaged or lacks one of `keys` is left out with a message. The last
    line is left out silently if it has no end: its writer was killed.

    Raises:
        ArtefactError: the file is missing, no regular file or too large.
    """
    records = []
    for number, line in enumerate(io.BytesIO(read_bytes(path)), 1):
        try:
            record = decode(path, line, where=f"line {number} ")
            if absent := [key for key in keys if key not in record]:
                raise failure(path, f"line {number} lacks {', '.join(absent)}")
            records.append(record)
        except ArtefactError as reason:
            if line.endswith(b"\n") and line.strip():
                print_message(f"{reason}; left out, the other lines stay")
    return records


def truncate_jsonl(
    path: Path, keep: Callable[[dict[str, Any]], bool], *, keys: Sequence[str] = ()
) -> None:
    """Replace `path` by the records to keep; a missing file stays missing."""
    if path.exists():
        records = filter(keep, read_jsonl(path, keys=keys))
        write_bytes(path, b"".join(encode(path, record) + b"\n" for record in records))


# ---- locks


@contextmanager
def locked(directory: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of `directory`, which is created if it is missing.

    The lock is reentrant. The system frees it when the process ends, however it ends;
    it also holds between hosts that share the directory.

    Args:
        directory: of a run, a data set or a comparison.
        wait: wait until the lock is free and print a message, instead of raising.

    Raises:
        DirectoryLocked: another process holds the lock, and `wait` is false.
        ArtefactError: the directory or its lock cannot be made.
    """
    from filelock import FileLock, Timeout  # only writers need it

    holder = directory / HOLDER
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = FileLock(directory.resolve() / LOCK, is_singleton=True)
        try:
            lock.acquire(timeout=GRACE_S)
        except Timeout:
            message = f"{directory}: {_who(directory)} is writing there"
            if not wait:
                advice = "try again when it has ended"
                raise DirectoryLocked(f"{message}; {advice}") from None
            print_message(f"waiting: {message}")
            lock.acquire()
    except OSError as reason:
        raise failure(directory / LOCK, reason) from reason
    try:
        if lock.lock_counter == 1:
            command = shlex.join(["python", *sys.orig_argv[1:]])
            since = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
            me = {"pid": os.getpid(), "host": socket.gethostname()}
            write_json(holder, me | {"command": command, "since": since})
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):
                holder.unlink(missing_ok=True)
        lock.release()


def _who(directory: Path) -> str:
    """Describe the process that holds a directory, if its record can be read."""
    try:
        record = read_json(directory / HOLDER, keys=("pid", "host", "command", "since"))
    except ArtefactError:
        return "another process"
    command = " ".join(str(record["command"]).split())[:200]
    process = f"process {record['pid']} on {record['host']}"
    return f"{process} ({command}, since {record['since']})"


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
