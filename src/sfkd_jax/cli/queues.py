"""Jobs that submitit queues, under Slurm or on this machine: all are waited for, and what became of each is told."""

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
"""States of Slurm from which a job does not go on by itself, and which leave no result
to wait for.
"""
ENDED = KILLED | {"COMPLETED", "FAILED"}
GONE, NEVER = "GONE", "NEVER_STARTS"
"""States for a job that Slurm no longer knows, and for one that is pending for a reason
that will not pass.
"""
_PARTITION = {"PartitionConfig", "PartitionNodeLimit", "PartitionTimeLimit"}
HOPELESS = _PARTITION | {
    "BadConstraints",
    "DependencyNeverSatisfied",
    "InvalidAccount",
    "InvalidQOS",
}
"""Slurm's reasons for a pending job that only other settings or an administrator can
remove.
"""
HOPELESS_S = 30
"""How long such a reason must last to be believed; Slurm also gives it for a moment
before it has looked.
"""
POLL_S = 30
"""Longest time between two questions to Slurm, which forgets a job some time after its
end (MinJobAge, 300 s).
"""


@contextmanager
def patient(launcher: Any) -> Iterator[list[str]]:
    """While it lasts, a job of submitit that failed is a result like another, so that the others are waited for.

    States come from squeue: sacct, which submitit asks, needs an accounting data base,
    and without one a job that was killed would be waited for without end.

    Args:
        launcher: of Hydra; one that does not use submitit is left alone.

    Yields:
        The log file of each job, in the order in which they were launched; "" of one
        that never began.
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
            told = _said(known)
        except (FailedJobError, UncompletedJobError) as reason:
            told = _said(known) if "Reason" in known else one_line(reason)
        if known.get("State") == NEVER:
            job.cancel(check=False)
        return [JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError(told))]

    setattr(submitit.Job, "results", results)  # noqa: B010
    submitit.SlurmJob.watcher = _queue()
    try:
        yield logs
    except KeyboardInterrupt:
        _say(
            "the jobs that were submitted go on; squeue --me lists them, scancel stops them"
        )
        raise
    finally:
        setattr(submitit.Job, "results", wait)  # noqa: B010
        submitit.SlurmJob.watcher = watcher


def one_line(reason: object) -> str:
    """What was raised, in one line; of submitit's errors, what it was told by others."""
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
    """A watcher for submitit that asks squeue, and says when something changes."""
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
            found = {}
            for job in self._registered - self._finished - arrays:
                state, reason = listed.get(
                    job, f"{GONE}|not in the queue any more"
                ).split("|")
                found[job] = {
                    "State": NEVER if self._never(job, state, reason) else state,
                    "Reason": reason,
                }
            line = _counted(self._info_dict | found)
            if line != self._line:
                self._line = line
                _say(f"Slurm: {line}")
            return found

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
    """How many jobs are in which state, and why some wait."""

    def words(known: dict[str, str]) -> str:
        waits = known["State"] == "PENDING" and known["Reason"] != "None"
        return known["State"].lower() + (f" ({known['Reason']})" if waits else "")

    states = Counter(words(known) for known in jobs.values())
    return ", ".join(f"{count} {state}" for state, count in sorted(states.items()))


def _said(known: dict[str, str]) -> str:
    """Slurm's last word on a job."""
    if known["State"] == NEVER:
        return f"it can never start (Slurm says {known['Reason']}); hydra.launcher asks for too much"
    return f"Slurm says {known['State']} ({known['Reason']})"


def _say(text: str) -> None:
    print(f"sfkd_jax: {text}", file=sys.stderr, flush=True)
