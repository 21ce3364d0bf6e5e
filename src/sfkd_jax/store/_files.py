"""Read and replace files atomically; every failure is an error of one line."""

from __future__ import annotations

import fcntl
import glob
import io
import json
import os
import secrets
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from sfkd_jax.store._content import plain
from sfkd_jax.store._json import parse

MAX_BYTES = 1 << 24
"""Size of a document; the largest of this package has 0.6 MB. Parsed JSON takes up to
35 times as much memory.
"""
MAX_LINE = 400
"""Characters of a message, which may quote the file that it is about."""


class ArtefactError(Exception):
    """A file that cannot be read or written: its name and the reason, in one line."""


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
            truncated, not strictly JSON (see `parse`), not an object, or lacks one of
            `keys`.
    """
    document = decode(path, read_bytes(path))
    if absent := [key for key in keys if key not in document]:
        raise failure(path, f"lacks {', '.join(absent)}")
    return document


def failure(path: Path, reason: object) -> ArtefactError:
    """Return the error to raise about `path`; `reason` may be an exception."""
    text = reason.strerror or reason if isinstance(reason, OSError) else reason
    return ArtefactError(f"{path}: {one_line(text)}")


def one_line(text: object) -> str:
    """Shorten a reason to one printable line, without control characters."""
    line = " ".join(str(text)[: 4 * MAX_LINE].split())
    line = "".join(
        letter if letter.isprintable() else ascii(letter)[1:-1] for letter in line
    )
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
        raise failure(
            Path(os.fsdecode(reason.filename)) if reason.filename else path, reason
        ) from reason


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
    try:
        yield
    except (
        KeyError,
        TypeError,
        IndexError,
        AttributeError,
        OverflowError,
        *also,
    ) as reason:
        message = f"malformed, {type(reason).__name__}: {reason}"
        raise failure(path, f"{message}; {advice}" if advice else message) from reason


def encode(
    path: Path, document: Mapping[str, Any], *, indent: int | None = None
) -> bytes:
    """Return `document` as JSON, or raise an ArtefactError about `path`."""
    try:
        return json.dumps(plain(document), indent=indent, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise failure(path, f"not written, {error}") from error


def decode(path: Path, text: bytes, *, where: str = "") -> dict[str, Any]:
    """Return the JSON object in `text`, or raise an ArtefactError about `path`."""
    try:
        document = parse(text)
    except ValueError as error:
        raise failure(path, f"{where}truncated or not JSON ({error})") from error
    if not isinstance(document, dict):
        raise failure(path, f"{where}not a JSON object")
    return document


def read_bytes(path: Path) -> bytes:
    """Return the content of `path`, of at most MAX_BYTES, or raise an ArtefactError."""
    with open_regular(path) as file:
        content = _up_to(path, file, MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise failure(path, f"larger than {MAX_BYTES >> 20} MiB")
    return content


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
    raise failure(
        path, "Is a directory" if stat.S_ISDIR(mode) else "not a regular file"
    )


def _up_to(path: Path, file: io.FileIO, most: int) -> bytes:
    """Return at most the first `most` bytes of a file."""
    try:
        with io.BufferedReader(file) as buffered:
            return buffered.read(min(most, os.fstat(file.fileno()).st_size + 1))
    except OSError as error:
        raise failure(path, error) from error


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` atomically.

    Raises:
        ArtefactError: the disk is full or not writable; an earlier file stays as it
            was.
    """
    with replacement(path) as (file, part):
        file.write(content)
        synchronise(file)
        os.replace(part, path)


def synchronise(file: BinaryIO) -> None:
    """Flush `file` to the disk."""
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def replacement(path: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """Yield a hidden file to write and to move over `path`; remove it if it stays.

    The hidden file of a killed writer is removed by the next writer, which recognises
    it because its lock is free.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        file, part = _claim(path)
        try:
            with file:
                yield file, part
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise failure(path, error) from error


def _sweep(path: Path) -> None:
    """Remove hidden files of `path` that no process holds."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with suppress(OSError), left.open("r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


def _claim(path: Path) -> tuple[BinaryIO, Path]:
    """Create a hidden file beside `path`, locked if the file system has locks."""
    while True:
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        file = part.open("xb")
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        if part.exists():  # else another writer removed it before it was locked
            return file, part
        file.close()
