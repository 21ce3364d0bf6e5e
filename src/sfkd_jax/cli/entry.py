"""What every command does around its work: compose, check, report, exit."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import training
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.cli import config, messages, queues, sweeps
from sfkd_jax.cli.help import information
from sfkd_jax.store import ArtefactError

FAILED = 1
REFUSED = 2
STALE = 3
INTERRUPTED = 130
"""Exit codes."""

Run = Callable[[dict[str, Any]], dict[str, Any]]


def hydra_command(run: Run) -> Callable[[], None]:
    """Make `run(settings) -> document` a command.

    The command composes its settings, works, and prints one JSON object as the last
    line of stdout. Expected errors become one line on stderr and an exit code: 1
    failed, 2 refused, 3 stale. A job of a sweep returns the document's "objective" to
    the sweeper, or infinity if it failed; the other jobs continue, and the sweep ends
    with one line for each job that failed and status 1 (`sweeps.Sweep.status`).
    """
    config.register()

    def main(composed: DictConfig) -> sweeps.Outcome | None:
        sweeping = HydraConfig.get().mode == RunMode.MULTIRUN
        fail = functools.partial(_fail, sweeping=sweeping)
        try:
            document = run(config.plain_settings(composed))
        except KeyboardInterrupt:
            _report("interrupted; the same command continues")
            # The interpreter would first wait for compiled code that nobody needs.
            os._exit(INTERRUPTED)
        except CertificationRefused as reason:
            return fail(f"refused: {reason}", REFUSED)
        except CertificateStale as reason:
            return fail(f"stale: {reason}", STALE)
        except (HydraException, OmegaConfBaseException) as reason:
            return fail(messages.one_line(reason, _typed()), FAILED)
        except (ArtefactError, ValueError, training.TrainingStopped, OSError) as reason:
            first = str(reason).splitlines()[:1]
            return fail(first[0] if first else type(reason).__name__, FAILED)
        except Exception as reason:
            if not sweeping:
                raise
            traceback.print_exc()  # into the log of the job
            return fail(queues.one_line(reason), FAILED)
        print(json.dumps(document), flush=True)
        return sweeps.Outcome(document.get("objective")) if sweeping else None

    start = hydra.main(
        config_path=config.conf_path(), config_name="config", version_base="1.3"
    )(main)
    return functools.partial(_start, start, _name(run))


def _start(start: Callable[[], None], name: str) -> None:
    """Run a command, or print its version or its help page.

    What cannot be composed or launched becomes one line, unless HYDRA_FULL_ERROR is
    set.
    """
    if text := information(name, sys.argv[1:]):
        print(text)
        return
    full = "HYDRA_FULL_ERROR" in os.environ
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints the error and exits
    try:
        with sweeps.watched() as sweep:
            start()
    except (HydraException, OmegaConfBaseException, sweeps.SweepError) as reason:
        if full:
            raise
        _fail(messages.one_line(reason, _typed()), FAILED)
    except KeyboardInterrupt:
        _fail("interrupted; the same command continues", INTERRUPTED)
    finally:
        if not full:
            del os.environ["HYDRA_FULL_ERROR"]
    sweep.report()
    if sweep.status():
        sys.exit(sweep.status())


def _name(run: Run) -> str:
    """Return the name of the module of a command, also if it runs as a script."""
    spec = getattr(sys.modules.get(run.__module__), "__spec__", None)
    module = spec.name if spec else Path(sys.argv[0]).stem
    return module.removesuffix(".__main__").rpartition(".")[2]


def _typed() -> list[str]:
    """Return the overrides of the command line."""
    return [word for word in sys.argv[1:] if not word.startswith("-")]


def _report(line: str) -> None:
    print(f"sfkd_jax: {line}", file=sys.stderr, flush=True)


def _fail(reason: str, code: int, *, sweeping: bool = False) -> sweeps.Outcome:
    """Print one line, then exit; in a sweep, return the outcome of a failed job."""
    _report(reason)
    return sweeps.Outcome(math.inf, reason) if sweeping else sys.exit(code)
