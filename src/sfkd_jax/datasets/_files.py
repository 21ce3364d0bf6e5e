"""Which files a path means, and what they are known by: their contents, wherever they lie."""

from __future__ import annotations

import glob
import hashlib
from functools import cache
from pathlib import Path

from sfkd_jax.artefacts import open_regular

SUFFIXES = (".csv", ".npz", ".parquet")


def log_files(path: str) -> list[Path]:
    """The logs that a file, a folder or a glob means, sorted by name.

    Raises:
        ValueError: there are none, some are of another kind, or two have the same
            contents.
        ArtefactError: one is a pipe, a device or a folder, or cannot be read.
    """
    if path in ("", "???"):
        raise ValueError(
            "dataset.path is not set: pass dataset.path=FILE, dataset.path=FOLDER or 'dataset.path=GLOB'"
        )
    place = Path(path).expanduser()
    known = ", ".join(SUFFIXES)
    if place.is_dir():
        found = [
            file
            for file in sorted(place.iterdir())
            if file.suffix.lower() in SUFFIXES and file.name[0] != "."
        ]
        if not found:
            raise ValueError(
                f"{path}: no {known} in this folder; dataset.path takes globs such as logs/**/*.csv"
            )
    else:
        matches = (
            [str(place)] if place.is_file() else glob.glob(str(place), recursive=True)
        )
        found = sorted(file for file in map(Path, matches) if file.is_file())
        if not found:
            raise ValueError(f"{path}: no such file or folder, and no file matches it")
    if odd := [file for file in found if file.suffix.lower() not in SUFFIXES]:
        raise ValueError(f"{odd[0]}: unknown kind of log; choose one of {known}")
    first: dict[str, Path] = {}
    for file in found:
        if (same := first.setdefault(digest(file), file)) != file:
            raise ValueError(
                f"{file}: the same contents as {same}; remove one of them, or test drives are trained on"
            )
    return found


def fingerprint(path: str) -> str:
    """Hash of the contents of all logs of a path: a changed file is another data set, a moved or renamed one is not.

    Raises:
        ValueError: as for `log_files`.
    """
    return hashlib.sha256(
        "".join(sorted(map(digest, log_files(path)))).encode()
    ).hexdigest()


def digest(file: Path) -> str:
    """Hash of a file's contents, computed again only when the file was written again."""
    status = file.stat()
    return _digest(file.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _digest(file: Path, size: int, written: int) -> str:
    del size, written  # they are the key of the cache
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
