"""Find the log files of a path, and identify them by their contents."""

from __future__ import annotations

import glob
import hashlib
from functools import cache
from pathlib import Path

from sfkd_jax.store import open_regular

SUFFIXES = (".csv", ".npz", ".parquet")


def log_files(path: str) -> list[Path]:
    """Return the log files of a file, a folder or a glob, sorted by name.

    Raises:
        ValueError: none, files of another kind, or two with the same contents.
        ArtefactError: one is a pipe, a device or a folder, or cannot be read.
    """
    if path in ("", "???"):
        raise ValueError(
            "dataset.path is not set: pass dataset.path=FILE, dataset.path=FOLDER or "
            "'dataset.path=GLOB'"
        )
    files, known = _files(Path(path).expanduser()), ", ".join(SUFFIXES)
    if not files and Path(path).expanduser().is_dir():
        raise ValueError(
            f"{path}: no {known} in this folder; "
            "dataset.path takes globs such as logs/**/*.csv"
        )
    if not files:
        raise ValueError(f"{path}: no such file or folder, and no file matches it")
    if odd := [file for file in files if file.suffix.lower() not in SUFFIXES]:
        raise ValueError(f"{odd[0]}: unknown kind of log; choose one of {known}")
    first: dict[str, Path] = {}
    for file in files:
        if (same := first.setdefault(digest(file), file)) != file:
            raise ValueError(
                f"{file}: the same contents as {same}; remove one of them, "
                "or test drives are trained on"
            )
    return files


def _files(path: Path) -> list[Path]:
    """The log files of a folder, or all files that a path or glob matches."""
    if path.is_dir():
        return [
            file
            for file in sorted(path.iterdir())
            if file.suffix.lower() in SUFFIXES and file.name[0] != "."
        ]
    matches = [str(path)] if path.is_file() else glob.glob(str(path), recursive=True)
    return sorted(file for file in map(Path, matches) if file.is_file())


def fingerprint(path: str) -> str:
    """Return a hash of the contents of all logs of a path, whatever their names.

    Raises:
        ValueError: as for `log_files`.
    """
    return hashlib.sha256(
        "".join(sorted(map(digest, log_files(path)))).encode()
    ).hexdigest()


def digest(file: Path) -> str:
    """Return the hash of a file's contents, cached until the file is written again."""
    status = file.stat()
    return _digest(file.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _digest(file: Path, size: int, written: int) -> str:
    del size, written  # part of the key of the cache
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
