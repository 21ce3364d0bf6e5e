"""Wait for all jobs that submitit queues, and report the outcome of each."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hydra.core.utils import JobReturn, JobStatus

KILLED = frozenset(
    {"BOOT_FAIL", "CANCELLED", "DEADLINE", "NODE_FAIL", "OUT_OF_MEMORY", "TIMEOUT"}
)
"""States of Slurm in which a job has ended without a result."""
ENDED = KILLED | {"COMPLETED", "FAILED"}
GONE, NEVER = "GONE", "NEVER_STARTS"
"""States of a job that Slurm no longer lists, and of one that can never start."""
_PARTITION = {"PartitionConfig", "PartitionNodeLimit", "PartitionTimeLimit"}
HOPELESS = _PARTITION | {
    "BadConstraints",
    "DependencyNeverSatisfied",
    "InvalidAccount",
    "InvalidQOS",
}
"""Slurm's reasons for a pending job that only a user or an administrator can remove."""
HOPELESS_S = 30
"""Seconds for which such a reason must last: Slurm also gives it for a moment before it
has examined a job.
"""
POLL_S = 30
"""Seconds between two queries; Slurm forgets a job 300 s after its end (MinJobAge)."""


@contextmanager
def wait_for_all(launcher: Any) -> Iterator[list[str]]:
    """Make submitit return a failed job like any other, so that all are waited for.

    States come from squeue: sacct, which submitit calls, needs an accounting database,
    and without one submitit would wait forever for a job that was killed.

    Args:
        launcher: of Hydra; nothing changes for one that does not use submitit.

    Yields:
        The log file of each job, in the order in which they were launched; "" for one
        that never started.
    """
    logs: list[str] = []
    if not type(launcher).__module__.startswith(
        "hydra_plugins.hydra_submitit_launcher"
    ):
        yield logs
        return
    import submitit
    from submitit.core.utils import FailedJobError, UncompletedJobError

    wait, watcher = submitit.Job.results, submitit.SlurmJob.watcher

    def results(job: submitit.Job) -> list[Any]:
        job.wait()
        logs.append(str(job.paths.stderr) if job.paths.stderr.exists() else "")
        known = job.get_info(mode="cache")
        try:
            if (
                known.get("State") not in (*KILLED, NEVER)
                or job.paths.result_pickle.exists()
            ):
                return wait(job)
            message = _state_message(known)
        except (FailedJobError, UncompletedJobError) as reason:
            message = _state_message(known) if "Reason" in known else one_line(reason)
        if known.get("State") == NEVER:
            job.cancel(check=False)
        return [JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError(message))]

    setattr(submitit.Job, "results", results)  # noqa: B010
    submitit.SlurmJob.watcher = _queue()
    try:
        yield logs
    except KeyboardInterrupt:
        _print_message(
            "the submitted jobs continue; squeue --me lists them, scancel stops them"
        )
        raise
    finally:
        setattr(submitit.Job, "results", wait)  # noqa: B010
        submitit.SlurmJob.watcher = watcher


def one_line(reason: object) -> str:
    """Return an exception in one line, with its type unless the text suffices."""
    words = " ".join(str(reason).split())[:400]
    if (
        isinstance(
            reason, subprocess.SubprocessError | OSError | RuntimeError | ValueError
        )
        and words
    ):
        return words
    return f"{type(reason).__name__}: {words}" if words else type(reason).__name__


def _queue() -> Any:
    """Return a watcher for submitit that calls squeue and prints changes of state."""
    from submitit.slurm.slurm import SlurmInfoWatcher

    class Queue(SlurmInfoWatcher):
        def __init__(self) -> None:
            super().__init__(delay_s=POLL_S)
            self._hopeless_since: dict[str, float] = {}
            self._line = ""

        def _make_command(self) -> list[str] | None:
            if not self._registered - self._finished:
                return None
            return [
                "squeue",
                "--me",
                "--array",
                "--states=all",
                "--noheader",
                "--format=%i|%T|%r",
            ]

        def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
            text = string if isinstance(string, str) else string.decode()
            listed = dict(
                line.strip().split("|", 1) for line in text.splitlines() if "|" in line
            )
            arrays = {job.split("_")[0] for job in self._registered if "_" in job}
            states = {}
            for job in self._registered - self._finished - arrays:
                state, reason = listed.get(
                    job, f"{GONE}|not in the queue any more"
                ).split("|")
                states[job] = {
                    "State": NEVER if self._never(job, state, reason) else state,
                    "Reason": reason,
                }
            line = _counted(self._info_dict | states)
            if line != self._line:
                self._line = line
                _print_message(f"Slurm: {line}")
            return states

        def is_done(self, job_id: str, mode: str = "standard") -> bool:
            return self.get_state(job_id, mode=mode) in (*ENDED, GONE, NEVER)

        def _never(self, job: str, state: str, reason: str) -> bool:
            if state != "PENDING" or reason not in HOPELESS:
                self._hopeless_since.pop(job, None)
                return False
            return (
                time.monotonic()
                - self._hopeless_since.setdefault(job, time.monotonic())
                >= HOPELESS_S
            )

    return Queue()


def _counted(jobs: dict[str, dict[str, str]]) -> str:
    """Return the number of jobs in each state, with the reason of those that wait."""

    def words(known: dict[str, str]) -> str:
        waits = known["State"] == "PENDING" and known["Reason"] != "None"
        return known["State"].lower() + (f" ({known['Reason']})" if waits else "")

    states = Counter(words(known) for known in jobs.values())
    return ", ".join(f"{count} {state}" for state, count in sorted(states.items()))


def _state_message(known: dict[str, str]) -> str:
    """Return the last state of a job that gave no result."""
    if known["State"] == NEVER:
        return (
            f"it can never start (Slurm says {known['Reason']}); "
            "hydra.launcher asks for too much"
        )
    return f"Slurm says {known['State']} ({known['Reason']})"


def _print_message(text: str) -> None:
    print(f"sfkd_jax: {text}", file=sys.stderr, flush=True)
