"""Jobs that submitit queues, under Slurm or on this machine: all are waited for, and what became of each is told."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hydra.core.utils import JobReturn, JobStatus

ENDED = frozenset("BOOT_FAIL CANCELLED COMPLETED DEADLINE FAILED NODE_FAIL OUT_OF_MEMORY TIMEOUT".split())
"""States of Slurm from which a job does not go on by itself."""
GONE, NEVER = "GONE", "NEVER_STARTS"
"""States for a job that Slurm no longer knows, and for one that is pending for a reason that will not pass."""
HOPELESS = frozenset(
    "BadConstraints DependencyNeverSatisfied InvalidAccount InvalidQOS PartitionNodeLimit PartitionTimeLimit".split()
)
"""Slurm's reasons for a pending job that only other settings or an administrator can remove."""
POLL_S = 30
"""Longest time between two questions to Slurm, which forgets a job some time after its end (MinJobAge, 300 s)."""


@contextmanager
def patient(launcher: Any) -> Iterator[list[str]]:
    """While it lasts, a job of submitit that failed is a result like another, so that the others are waited for.

    States come from squeue: sacct, which submitit asks, needs an accounting data base, and without one a job that was
    killed would be waited for without end.

    Args:
        launcher: of Hydra; one that does not use submitit is left alone.

    Yields:
        The log file of each job, in the order in which they were launched.
    """
    logs: list[str] = []
    if not type(launcher).__module__.startswith("hydra_plugins.hydra_submitit_launcher"):
        yield logs
        return
    import submitit

    wait, watcher = submitit.Job.results, submitit.SlurmJob.watcher

    def results(job: submitit.Job) -> list[Any]:
        logs.append(str(job.paths.stderr))
        try:
            return wait(job)
        except (submitit.core.utils.FailedJobError, submitit.core.utils.UncompletedJobError) as reason:
            state = job.get_info(mode="cache")
            if state.get("State") == NEVER:
                job.cancel(check=False)
            told = f"Slurm says {state['State']} ({state['Reason']})" if "Reason" in state else one_line(reason)
            return [JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError(told))]

    setattr(submitit.Job, "results", results)  # noqa: B010
    submitit.SlurmJob.watcher = _queue()
    try:
        yield logs
    except KeyboardInterrupt:
        _say("the jobs that were submitted go on; squeue --me lists them, scancel stops them")
        raise
    finally:
        setattr(submitit.Job, "results", wait)  # noqa: B010
        submitit.SlurmJob.watcher = watcher


def one_line(reason: object) -> str:
    """What was raised, in one line; of submitit's errors, what it was told by others."""
    words = " ".join(str(reason).split())[:400]
    if isinstance(reason, subprocess.SubprocessError | OSError | RuntimeError | ValueError) and words:
        return words
    return f"{type(reason).__name__}: {words}" if words else type(reason).__name__


def _queue() -> Any:
    """A watcher for submitit that asks squeue, and says when something changes."""
    from submitit.slurm.slurm import SlurmInfoWatcher

    class Queue(SlurmInfoWatcher):
        said = ""

        def _make_command(self) -> list[str] | None:
            if not self._registered - self._finished:
                return None
            return ["squeue", "--me", "--array", "--states=all", "--noheader", "--format=%i|%T|%r"]

        def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
            text = string if isinstance(string, str) else string.decode()
            listed = dict(line.strip().split("|", 1) for line in text.splitlines() if "|" in line)
            found = {}
            for job in self._registered - self._finished:
                state, reason = listed.get(job, f"{GONE}|no result, and not in the queue").split("|")
                hopeless = state == "PENDING" and reason in HOPELESS
                found[job] = {"State": NEVER if hopeless else state, "Reason": reason}
            self._tell(found)
            return found

        def is_done(self, job_id: str, mode: str = "standard") -> bool:
            return self.get_state(job_id, mode=mode) in (*ENDED, GONE, NEVER)

        def _tell(self, found: dict[str, dict[str, str]]) -> None:
            states = {job: known["State"].lower() for job, known in self._info_dict.items()} | {
                job: " ".join(word for word in (info["State"].lower(), _why(info)) if word)
                for job, info in found.items()
            }
            line = ", ".join(f"{count} {state}" for state, count in sorted(Counter(states.values()).items()))
            if line != self.said:
                self.said = line
                _say(f"Slurm: {line}")

    return Queue(delay_s=POLL_S)


def _why(info: dict[str, str]) -> str:
    return f"({info['Reason']})" if info["State"] == "PENDING" and info["Reason"] != "None" else ""


def _say(text: str) -> None:
    print(f"sfkd_jax: {text}", file=sys.stderr, flush=True)
