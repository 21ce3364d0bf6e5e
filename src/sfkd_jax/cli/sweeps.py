"""Sweeps: a run directory for each job, and one line for each job that failed."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, zip_longest
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, OmegaConf

from sfkd_jax import store
from sfkd_jax.cli import queues
from sfkd_jax.pipeline import runs

NAMED = frozenset({"model", "seed"})
"""Swept settings that the path of a run directory contains anyway."""
LONGEST = 40
"""Characters of a value in a directory name; a longer value is cut and hashed."""
LONGEST_NAME = 160
"""Characters of all swept settings together; file systems allow 255."""


class SweepError(RuntimeError):
    """A sweep that could not be launched; the message is one line."""


class Outcome(NamedTuple):
    """What a job of a sweep returns.

    Attributes:
        objective: for a sweeper that minimises; infinity where the job failed.
        failure: why it failed, in one line; None where it did not.
    """

    objective: float | None
    failure: str | None = None


class Sweep:
    """The jobs of one command and their failures.

    Attributes:
        jobs: how many have ended.
        failures: one line for each that failed.
        is_study: whether a sweeper searches, so that single trials may fail.
    """

    def __init__(self) -> None:
        """Start without jobs."""
        self.jobs = 0
        self.failures: list[str] = []
        self.is_study = False

    def status(self) -> int:
        """Return the exit status: 1 if a job failed; for a study, if all did."""
        if self.is_study:
            return int(self.jobs > 0 and len(self.failures) == self.jobs)
        return int(bool(self.failures))

    def report(self) -> None:
        """Print one line for each job that failed, and their number, on stderr."""
        if self.failures:
            count = f"{len(self.failures)} of {self.jobs} jobs failed"
            lines = [
                *self.failures,
                f"{count}; the same sweep again skips what is finished",
            ]
            print(
                *(f"sfkd_jax: {line}" for line in lines),
                sep="\n",
                file=sys.stderr,
                flush=True,
            )


class _NamedJobs(Launcher):
    """A launcher that gives each job a run directory and records its outcome."""

    def __init__(self, inner: Launcher, sweep: Sweep) -> None:
        self._inner, self._sweep = inner, sweep

    def setup(self, **_: Any) -> None:
        """Do nothing: the inner launcher is set up."""

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Launch all jobs and wait for them.

        Raises:
            SweepError: they could not be launched.
        """
        inner: Any = self._inner
        swept = swept_settings(inner.config)
        named = {
            key for key in swept if key.split(".")[0] in (*runs.IDENTITY, "env_source")
        } - NAMED
        load = inner.hydra_context.config_loader.load_sweep_config
        jobs = []
        for overrides in job_overrides:
            composed = load(inner.config, list(overrides))
            jobs.append(
                with_name(list(overrides), composed, directory(composed, named))
            )
        try:
            with queues.wait_for_all(inner) as logs:
                returned = inner.launch(jobs, initial_job_idx=initial_job_idx)
        except Exception as reason:  # launchers raise the errors of many libraries
            raise SweepError(
                f"the sweep stopped: {queues.one_line(reason)}"
            ) from reason
        for number, (job, log) in enumerate(zip_longest(returned, logs)):
            varied = (
                word
                for word in job_overrides[number]
                if word.lstrip("+").split("=")[0] in swept
            )
            self._note(job, f"job {initial_job_idx + number} ({' '.join(varied)})", log)
        return returned

    def _note(self, job: JobReturn, name: str, log: str | None) -> None:
        """Count a job, and give its objective to the sweeper."""
        outcome = job._return_value
        if not isinstance(outcome, Outcome):  # the job did not end by itself
            outcome = Outcome(float("inf"), queues.one_line(outcome))
        self._sweep.jobs += 1
        if outcome.failure is not None:
            where = f"; log: {log}" if log else ""
            self._sweep.failures.append(f"{name} failed: {outcome.failure}{where}")
        job.status, job.return_value = JobStatus.COMPLETED, outcome.objective


@contextmanager
def watched() -> Iterator[Sweep]:
    """Name and count the jobs that Hydra launches, with any launcher."""
    sweep, instantiate = Sweep(), Plugins.instantiate_launcher

    def watching(
        plugins: Plugins, *args: Any, config: DictConfig, **options: Any
    ) -> Launcher:
        sweep.is_study = config.hydra.runtime.choices["hydra/sweeper"] != "basic"
        return _NamedJobs(instantiate(plugins, *args, config=config, **options), sweep)

    setattr(Plugins, instantiate.__name__, watching)
    try:
        yield sweep
    finally:
        setattr(Plugins, instantiate.__name__, instantiate)


def swept_settings(config: DictConfig) -> set[str]:
    """Return the names of the settings that a sweep varies.

    Args:
        config: composed, of the sweep.
    """
    params = (config.hydra.sweeper or {}).get("params") or {}
    overrides = chain(
        config.hydra.overrides.task, (f"{key}={value}" for key, value in params.items())
    )
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return {one.key_or_group for one in parsed if one.is_sweep_override()}


def directory(config: DictConfig, swept: set[str]) -> str:
    """Return key=value,... of the swept settings of a job, sorted by key.

    A value is that of the composed settings, so that 1e-3 and 0.001 give one name, or
    the option of a group.

    Args:
        config: composed, of the job.
        swept: names of the settings; "" is returned for none.
    """
    choices = config.hydra.runtime.choices
    parts = []
    for key in sorted(swept):
        value = choices[key] if key in choices else OmegaConf.select(config, key)
        parts.append(f"{key}={_spelled(value)}")
    name = ",".join(parts)
    return name if len(name) <= LONGEST_NAME else f"{len(parts)}-settings-{_hash(name)}"


def with_name(overrides: list[str], config: DictConfig, added: str) -> list[str]:
    """Return the overrides of a job with name/added as the name of its run.

    The policies of a comparison get the same ending.
    """
    names = {"name": config.name, "comparison.policies": config.comparison.policies}
    for key, name in names.items() if added else ():
        if key != "name" and name == config.name:
            continue  # it follows the name by interpolation
        # Characters of Hydra's grammar are escaped.
        escaped = re.sub(r"([\\()\[\]{}:=, \t])", r"\\\1", f"{name}/{added}")
        overrides = [
            *(word for word in overrides if not word.startswith(f"{key}=")),
            f"{key}={escaped}",
        ]
    return overrides


def _spelled(value: Any) -> str:
    """Return a value as part of a file name; a long or special one gets a hash."""
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value, resolve=True)
    text = value if isinstance(value, str) else json.dumps(value)
    plain = "-".join(re.findall(r"[\w.+-]+", text, re.ASCII))
    return (
        text
        if text == plain and len(text) <= LONGEST
        else f"{plain[:LONGEST]}-{_hash(text)}"
    )


def _hash(text: str) -> str:
    return store.sha256([text])[:8]
