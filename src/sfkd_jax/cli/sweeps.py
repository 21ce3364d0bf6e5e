"""Sweeps: a run directory for every job, and one line for every job that failed."""

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

from sfkd_jax import artefacts
from sfkd_jax.cli import queues
from sfkd_jax.pipeline import store

NAMED = frozenset({"model", "seed"})
"""Swept settings that a run directory names by itself."""
LONGEST = 40
"""Characters of a value that a directory spells out; of what is longer, a hash."""
LONGEST_NAME = 160
"""Characters of all swept settings together; file systems take 255."""


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
    """What became of the jobs of one command."""

    def __init__(self) -> None:
        """Begin with none."""
        self.jobs = 0
        self.failures: list[str] = []
        self.is_study = False

    def status(self) -> int:
        """Exit status: 1 if a job failed; of a study, whose trials may fail, 1 if all did."""
        if self.is_study:
            return int(self.jobs > 0 and len(self.failures) == self.jobs)
        return int(bool(self.failures))

    def report(self) -> None:
        """One line for each job that failed, and how many did, on stderr."""
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
    """Any launcher, whose jobs have a directory each and tell the sweep what became of them."""

    def __init__(self, inner: Launcher, sweep: Sweep) -> None:
        self._inner, self._sweep = inner, sweep

    def setup(self, **_: Any) -> None:
        """Nothing to do: the inner launcher is set up."""

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Launch, and wait for all.

        Raises:
            SweepError: they could not be launched.
        """
        inner: Any = self._inner
        swept = swept_settings(inner.config)
        named = {
            key for key in swept if key.split(".")[0] in (*store.IDENTITY, "env_source")
        } - NAMED
        load = inner.hydra_context.config_loader.load_sweep_config
        jobs = []
        for overrides in job_overrides:
            composed = load(inner.config, list(overrides))
            jobs.append(
                with_name(list(overrides), composed, directory(composed, named))
            )
        try:
            with queues.patient(inner) as logs:
                returned = inner.launch(jobs, initial_job_idx=initial_job_idx)
        except Exception as reason:  # each launcher raises what its own libraries raise
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
        found = job._return_value
        if not isinstance(found, Outcome):  # it never came to its end
            found = Outcome(float("inf"), queues.one_line(found))
        self._sweep.jobs += 1
        if found.failure is not None:
            where = f"; log: {log}" if log else ""
            self._sweep.failures.append(f"{name} failed: {found.failure}{where}")
        job.status, job.return_value = JobStatus.COMPLETED, found.objective


@contextmanager
def watched() -> Iterator[Sweep]:
    """While it lasts, jobs that Hydra launches are named and counted, whatever launches them."""
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
    """The settings that a sweep varies, of its composed `config`."""
    params = (config.hydra.sweeper or {}).get("params") or {}
    asked = chain(
        config.hydra.overrides.task, (f"{key}={value}" for key, value in params.items())
    )
    parsed = OverridesParser.create().parse_overrides(list(asked))
    return {found.key_or_group for found in parsed if found.is_sweep_override()}


def directory(config: DictConfig, swept: set[str]) -> str:
    """What tells a job's run from the others: key=value,... in the order of keys; "" if nothing does.

    The value is that of the composed settings, so that 1e-3 and 0.001 are one, or the
    option of a group.
    """
    choices = config.hydra.runtime.choices
    parts = []
    for key in sorted(swept):
        value = choices[key] if key in choices else OmegaConf.select(config, key)
        parts.append(f"{key}={_spelled(value)}")
    name = ",".join(parts)
    return name if len(name) <= LONGEST_NAME else f"{len(parts)}-settings-{_hash(name)}"


def with_name(overrides: list[str], config: DictConfig, added: str) -> list[str]:
    """The overrides of a job whose run is called name/added, and so are the policies of a comparison if it is one."""
    names = {"name": config.name, "comparison.policies": config.comparison.policies}
    for key, name in names.items() if added else ():
        if key != "name" and name == config.name:
            continue  # it follows
        escaped = re.sub(
            r"([\\()\[\]{}:=, \t])", r"\\\1", f"{name}/{added}"
        )  # what Hydra reads as its own grammar
        overrides = [
            *(word for word in overrides if not word.startswith(f"{key}=")),
            f"{key}={escaped}",
        ]
    return overrides


def _spelled(value: Any) -> str:
    """A value as part of a file name: itself if it is short and plain, else what is plain of it and a hash."""
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
    return artefacts.sha256([text])[:8]
