"""Lock a directory for one writer, and record which process holds it."""

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

from sfkd_jax.store._files import ArtefactError, failure, read_json, write_json
from sfkd_jax.store._lines import print_message

LOCK, HOLDER = ".lock", ".lock.json"
GRACE_S = 2.0
"""Time to wait for a writer that is about to finish [s]."""
_WITHOUT_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of file systems without locks; there a file with host and process id replaces
the lock.
"""


class DirectoryLocked(ArtefactError):
    """Another process writes into a directory; the message names the process."""


@contextmanager
def locked(directory: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of `directory`, which is created if it is missing.

    The lock is reentrant. The system frees it when the process ends, however it ends.
    It uses flock(2), which Linux forwards to the server of a shared directory, so it
    also holds between hosts.

    Args:
        directory: of a run, a data set or a comparison.
        wait: wait until the lock is free and print a message, instead of raising.

    Raises:
        DirectoryLocked: another process holds the lock, and `wait` is false.
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
    """Return the lock of `directory`, acquired."""
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
    """Acquire `lock` and return it."""
    try:
        lock.acquire(timeout=GRACE_S)
    except Timeout:
        soft = (
            f" (if it is gone, remove {lock.lock_file})"
            if isinstance(lock, SoftFileLock)
            else ""
        )
        message = f"{directory}: {_who(directory)} is writing there{soft}"
        if not wait:
            raise DirectoryLocked(f"{message}; try again when it has ended") from None
        print_message(f"waiting: {message}")
        lock.acquire()
    return lock


def _myself() -> dict[str, str | int]:
    """Describe this process for the record of the lock."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
        "since": datetime.now(UTC).isoformat(sep=" ", timespec="seconds"),
    }


def _who(directory: Path) -> str:
    """Describe the process that holds a directory, if its record can be read."""
    try:
        record = read_json(directory / HOLDER, keys=("pid", "host", "command", "since"))
    except ArtefactError:
        return "another process"
    command = " ".join(str(record["command"]).split())[:200]
    process = f"process {record['pid']} on {record['host']}"
    return f"{process} ({command}, since {record['since']})"
