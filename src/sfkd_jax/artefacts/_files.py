"""How bytes reach the disk and come back: whole or not at all, and every failure as one line."""

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

from sfkd_jax.artefacts._content import plain
from sfkd_jax.artefacts._json import parse

LARGEST = 1 << 24
"""Bytes of a document; the largest of this package has 0.6 MB, and what JSON becomes
takes up to 35 times as much.
"""
LONGEST_LINE = 400
"""Letters of a reason; one may quote the file that it is about."""


class ArtefactError(Exception):
    """A file that cannot be read or written: its name and the reason, in one line."""


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Replace `path` in one step; arrays become lists, NaN and infinities null.

    Raises:
        ArtefactError: the disk is full or not writable (an earlier file stays as it
            was), or a value is not JSON.
    """
    write_bytes(path, encode(path, document, indent=2))


def read_json(path: Path, *, keys: Sequence[str] = ()) -> dict[str, Any]:
    """The object in `path`.

    Raises:
        ArtefactError: the file is missing, no regular file, larger than LARGEST,
            truncated, not strictly JSON (see `parse`), not an object, or lacks one of
            `keys`.
    """
    document = decode(path, read_bytes(path))
    if absent := [key for key in keys if key not in document]:
        raise failure(path, f"lacks {', '.join(absent)}")
    return document


def failure(path: Path, reason: object) -> ArtefactError:
    """The error to raise about `path`; `reason` may be an exception of any length."""
    text = reason.strerror or reason if isinstance(reason, OSError) else reason
    return ArtefactError(f"{path}: {one_line(text)}")


def one_line(text: object) -> str:
    """A reason as a terminal shows it: nothing that breaks or colours the line, and not all that a file holds."""
    line = " ".join(str(text)[: 4 * LONGEST_LINE].split())
    line = "".join(
        letter if letter.isprintable() else ascii(letter)[1:-1] for letter in line
    )
    return line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..."


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """What the disk refuses while several files are made becomes an ArtefactError about the file, or about `path`."""
    try:
        yield
    except OSError as reason:
        raise failure(
            Path(os.fsdecode(reason.filename)) if reason.filename else path, reason
        ) from reason


@contextmanager
def as_artefact_error(path: Path, *also: type[Exception], advice: str = "") -> Iterator[None]:
    """What is missing or of another kind inside a file that could be read becomes an ArtefactError about it.

    Args:
        path: of the file.
        also: further exceptions that nothing else than the file can be the reason of.
        advice: what the line ends with.
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
        said = f"malformed, {type(reason).__name__}: {reason}"
        raise failure(path, f"{said}; {advice}" if advice else said) from reason


def encode(
    path: Path, document: Mapping[str, Any], *, indent: int | None = None
) -> bytes:
    """JSON text of `document`, or an ArtefactError about `path`."""
    try:
        return json.dumps(plain(document), indent=indent, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise failure(path, f"not written, {error}") from error


def decode(path: Path, text: bytes, *, where: str = "") -> dict[str, Any]:
    """The JSON object in `text`, or an ArtefactError about `path`."""
    try:
        document = parse(text)
    except ValueError as error:
        raise failure(path, f"{where}truncated or not JSON ({error})") from error
    if not isinstance(document, dict):
        raise failure(path, f"{where}not a JSON object")
    return document


def read_bytes(path: Path) -> bytes:
    """All of `path`, or an ArtefactError; more than LARGEST is not read."""
    with open_regular(path) as file:
        content = _up_to(path, file, LARGEST + 1)
    if len(content) > LARGEST:
        raise failure(path, f"larger than {LARGEST >> 20} MiB")
    return content


def open_regular(path: Path) -> io.FileIO:
    """A regular file to read from, or an ArtefactError; a pipe, a socket or a device does not make the caller wait."""
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except FileNotFoundError:
        raise failure(path, "missing") from None
    except (
        OSError,
        ValueError,
    ) as error:  # a ValueError: of a name that no file can have
        raise failure(path, error) from error
    mode = os.fstat(number).st_mode
    if stat.S_ISREG(mode):
        return io.FileIO(number)
    os.close(number)
    raise failure(
        path, "Is a directory" if stat.S_ISDIR(mode) else "not a regular file"
    )


def _up_to(path: Path, file: io.FileIO, most: int) -> bytes:
    """The first bytes of a file."""
    try:
        with io.BufferedReader(file) as buffered:
            return buffered.read(min(most, os.fstat(file.fileno()).st_size + 1))
    except OSError as error:
        raise failure(path, error) from error


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` in one step.

    Raises:
        ArtefactError: the disk is full or not writable; an earlier file stays as it
            was.
    """
    with replacement(path) as (file, part):
        file.write(content)
        synchronise(file)
        os.replace(part, path)


def synchronise(file: BinaryIO) -> None:
    """Wait until what was written to `file` is on the disk."""
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def replacement(path: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """A hidden file to fill and to move over `path`; it is removed if it was not moved.

    A killed writer cannot remove its own: the next one does, and knows it by the lock
    that died with its owner.
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
    """Remove the hidden files beside `path` that nobody holds."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with suppress(OSError), left.open("r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


def _claim(path: Path) -> tuple[BinaryIO, Path]:
    """A new hidden file beside `path`, locked where the file system has locks."""
    while True:
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        file = part.open("xb")
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        if (
            part.exists()
        ):  # else another writer took it for left over before it was locked
            return file, part
        file.close()
