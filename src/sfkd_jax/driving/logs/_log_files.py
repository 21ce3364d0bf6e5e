"""The files of recorded runs that a path stands for, and a hash of their contents."""

from __future__ import annotations

import glob
import hashlib
from functools import cache
from pathlib import Path

SUFFIXES = (".csv", ".npz", ".parquet")


def log_files(path: str) -> list[tuple[str, Path]]:
    """Return the logs of a file, a folder or a glob, with the hashes of their contents.

    They are in the order of the hashes, so that a data set does not depend on the names
    of files.

    Raises:
        ValueError: the path is not set, there are no files, or one has an unknown
            suffix.
    """
    if path in ("", "???"):
        raise ValueError(
            "dataset.path is not set: pass dataset.path=FILE, dataset.path=FOLDER or "
            "'dataset.path=GLOB'"
        )
    place = Path(path).expanduser()
    known = ", ".join(SUFFIXES)
    if place.is_dir():
        files = _logs_in(place)
        absent = (
            f"no {known} in this folder; dataset.path takes globs such as logs/**/*.csv"
        )
    else:
        files = _matching(place)
        absent = "no such file or folder, and no file matches it"
    if not files:
        raise ValueError(f"{path}: {absent}")
    hashed: list[tuple[str, Path]] = []
    for file in sorted(files):
        if file.suffix.lower() not in SUFFIXES:
            raise ValueError(f"{file}: unknown kind of log; choose one of {known}")
        status = file.stat()
        digest = _digest(file.resolve(), status.st_size, status.st_mtime_ns)
        hashed.append((digest, file))
    return sorted(hashed)


def _logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder, without hidden files."""
    return [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    ]


def left_out(path: str) -> list[str]:
    """Return the names of the files in a folder that are read by nobody.

    Hidden files are none of them.
    """
    place = Path(path).expanduser()
    if not place.is_dir():
        return []
    return sorted(
        file.name
        for file in place.iterdir()
        if file.is_file()
        and file.suffix.lower() not in SUFFIXES
        and not file.name.startswith(".")
    )


def _matching(place: Path) -> list[Path]:
    """Return a file, or the files that match a glob."""
    # A file whose name holds brackets is meant itself, and not what it would match.
    if place.is_file():
        return [place]
    matches = map(Path, glob.glob(str(place), recursive=True))
    return [file for file in matches if file.is_file()]


def fingerprint(path: str) -> str:
    """Return a hash of the contents of all logs of a path, whatever their names."""
    digests = (digest for digest, _ in log_files(path))
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@cache
def _digest(file: Path, size: int, written: int) -> str:
    """Return the hash of a file's contents.

    It is cached until the file is written again: size and time of writing are arguments
    for the key of the cache alone.
    """
    del size, written
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore
