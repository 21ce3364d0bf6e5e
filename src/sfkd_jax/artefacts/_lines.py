"""Logs that grow by one JSON object a line."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from sfkd_jax.artefacts._files import ArtefactError, decode, encode, failure, open_regular, read_bytes, write_bytes


def append_jsonl(path: Path, record: Mapping[str, Any]) -> None:
    """Add a line; a last line cut short by a kill is dropped first.

    Raises:
        ArtefactError: the disk is full or not writable (the earlier lines stay as they were), or a value is not JSON.
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


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """The records of `path`, without a last line that was cut short.

    Raises:
        ArtefactError: the file is missing, or a line before the last is not a JSON object.
    """
    content, records = read_bytes(path), []
    for number, line in enumerate(io.BytesIO(content), 1):
        with nullcontext() if line.endswith(b"\n") else suppress(ArtefactError):
            records += [decode(path, line, where=f"line {number} ")] if line.strip() else []
    return records


def truncate_jsonl(path: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
    """Rewrite `path` in one step with the records to keep, as a resumed run needs; where no file is, none is made.

    Raises:
        ArtefactError: see `read_jsonl` and `write_json`.
    """
    if path.exists():
        write_bytes(path, b"".join(encode(path, record) + b"\n" for record in read_jsonl(path) if keep(record)))


def _cut_short(path: Path) -> bool:
    """Whether the last byte is not the end of a line."""
    if not path.exists() or not path.stat().st_size:
        return False
    with open_regular(path) as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"
