"""Append to and read logs of one JSON object a line, and print messages."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sfkd_jax.store._files import (
    ArtefactError,
    decode,
    encode,
    failure,
    open_regular,
    read_bytes,
    write_bytes,
)


def append_jsonl(path: Path, record: Mapping[str, Any]) -> None:
    """Append one record, after removing an incomplete last line.

    Raises:
        ArtefactError: the disk is full or not writable (the earlier lines stay as they
            were), or a value is not JSON.
    """
    line = encode(path, record) + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if _cut_short(path):
            truncate_jsonl(path, lambda _: True)
        with path.open("ab", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            try:
                if file.write(line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except BaseException:
                file.truncate(size)
                raise
    except OSError as error:
        raise failure(path, error) from error


def read_jsonl(
    path: Path,
    *,
    keys: Sequence[str] = (),
    damaged: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Return the records of `path`, without an incomplete last line.

    Args:
        path: of the file.
        keys: that every record must have.
        damaged: receives one message for each other line that is no such record; the
            line is then skipped. `print_message`, for example.

    Raises:
        ArtefactError: the file is missing; or a complete line is no such record and
            `damaged` is None.
    """
    records = []
    for number, line in enumerate(io.BytesIO(read_bytes(path)), 1):
        whole = line.endswith(b"\n")
        try:
            record = (
                decode(path, line, where=f"line {number} ") if line.strip() else None
            )
            if record is not None and (
                absent := [key for key in keys if key not in record]
            ):
                raise failure(path, f"line {number} lacks {', '.join(absent)}")
            records += [record] if record is not None else []
        except ArtefactError as reason:
            if whole and damaged is None:
                raise
            if whole and damaged is not None:
                damaged(f"{reason}; left out, the other lines stay")
    return records


def print_message(message: str) -> None:
    """Print a message for a person to stderr; stdout is for the result of a command."""
    print(message, file=sys.stderr, flush=True)


def truncate_jsonl(
    path: Path,
    keep: Callable[[dict[str, Any]], bool],
    *,
    keys: Sequence[str] = (),
    damaged: Callable[[str], None] | None = None,
) -> None:
    """Replace `path` by the records to keep, as a resumed run needs.

    A missing file stays missing.

    Args:
        path: of the file.
        keep: whether to keep a record.
        keys: see `read_jsonl`.
        damaged: see `read_jsonl`.

    Raises:
        ArtefactError: see `read_jsonl` and `write_json`.
    """
    if path.exists():
        records = [
            record
            for record in read_jsonl(path, keys=keys, damaged=damaged)
            if keep(record)
        ]
        write_bytes(path, b"".join(encode(path, record) + b"\n" for record in records))


def _cut_short(path: Path) -> bool:
    """Whether the last line is incomplete."""
    if not path.exists() or not path.stat().st_size:
        return False
    with open_regular(path) as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"
