"""One writer a directory: a lock that the system frees when its process ends, and a record of who holds it."""

from __future__ import annotations

import errno
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from sfkd_jax.artefacts._files import ArtefactError, failure, read_json, write_json
from sfkd_jax.artefacts._lines import print_message

LOCK, HOLDER = ".lock", ".lock.json"
GRACE_S = 2.0
"""How long everybody waits for a writer that is about to finish [s]."""
_WITHOUT_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""How a file system says that it has no locks: there a file with host and process id
stands for one.
"""


class DirectoryLocked(ArtefactError):
    """Another process writes into a directory: which one, where and since when, in one line."""


@contextmanager
def locked(directory: Path, *, wait: bool = False) -> Iterator[None]:
    """Be the only process that writes into `directory`, made if missing; what holds it already may enter again.

    The lock is freed by the system when its process ends, however it ends. It is taken
    with flock(2), which Linux passes on to the server of a shared directory, so it
    holds between hosts as well.

    Args:
        directory: of a run, a data set or a comparison.
        wait: until it is free, as whoever holds finished work should; this is told on
            stderr.

    Raises:
        DirectoryTaken: it is not free after a moment, and `wait` is false.
        ArtefactError: the directory or its lock cannot be made.
    """
    holder = directory / HOLDER
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = _acquired(directory, wait)
    except OSError as reason:
        raise failure(directory / LOCK, reason) from reason
    try:
        if lock.lock_counter == 1:
            write_json(holder, _myself())
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):
                holder.unlink(missing_ok=True)
        lock.release()


def _acquired(directory: Path, wait: bool) -> BaseFileLock:
    """The lock of `directory`, held by this process."""
    path = directory.resolve() / LOCK
    try:
        return _held(
            FileLock(path, is_singleton=True, fallback_to_soft=False), directory, wait
        )
    except OSError as reason:
        if reason.errno not in _WITHOUT_LOCKS:
            raise
    return _held(SoftFileLock(f"{path}.soft", is_singleton=True), directory, wait)


def _held(lock: BaseFileLock, directory: Path, wait: bool) -> BaseFileLock:
    """`lock`, once it is ours."""
    try:
        lock.acquire(timeout=GRACE_S)
    except Timeout:
        soft = (
            f" (if it is gone, remove {lock.lock_file})"
            if isinstance(lock, SoftFileLock)
            else ""
        )
        taken = f"{directory}: {_who(directory)} is writing there{soft}"
        if not wait:
            raise DirectoryLocked(f"{taken}; try again when it has ended") from None
        print_message(f"waiting: {taken}")
        lock.acquire()
    return lock


def _myself() -> dict[str, str | int]:
    """This process, as another one may want to know it."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
        "since": datetime.now(UTC).isoformat(sep=" ", timespec="seconds"),
    }


def _who(directory: Path) -> str:
    """Who holds a directory, as far as its record can be read."""
    try:
        record = read_json(directory / HOLDER, keys=("pid", "host", "command", "since"))
    except ArtefactError:
        return "another process"
    command = " ".join(str(record["command"]).split())[:200]
    return f"process {record['pid']} on {record['host']} ({command}, since {record['since']})"
