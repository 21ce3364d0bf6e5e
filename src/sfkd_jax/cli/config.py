"""The plan: composition, and what every door does around its work."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import shlex
import sys
import traceback
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax import build, training
from sfkd_jax.artefacts import ArtefactError
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.cli import queues, ranges, sweeps
from sfkd_jax.cli.schemas import register as register

REFUSED = 2
STALE = 3
INTERRUPTED = 130


def conf_path() -> str:
    """The folder of options: the repository's in a checkout, the package's in an installed wheel."""
    here = Path(__file__).resolve().parents[1]
    checkout = here.parents[1]
    inside = (checkout / "conf" / "config.yaml").exists() and (
        checkout / "pyproject.toml"
    ).exists()
    return str(checkout / "conf" if inside else here / "conf")


def compose(*overrides: str) -> dict[str, Any]:
    """The settings of this command under further overrides, inside a door."""
    asked = [*HydraConfig.get().overrides.task, *overrides]
    return _settings(hydra.compose("config", asked))


def command(name: str) -> str:
    """The command that is running, less where its artefacts go, as it is typed in a shell."""
    asked = [
        word
        for word in HydraConfig.get().overrides.task
        if not word.startswith("root=")
    ]
    return " ".join(["python -m", f"sfkd_jax.{name}", shlex.join(asked)]).strip()


def door(run: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[], None]:
    """Make `run(settings) -> document` a command: compose, work, print one JSON object as the last line of stdout.

    What can be expected to go wrong becomes one line on stderr and an exit code: 1
    failed, 2 refused, 3 stale. A job of a sweep returns the document's "objective" to
    the sweeper, and infinity where it failed: the others go on, and the sweep ends with
    a line for each that failed and status 1 (`sweeps.Sweep.status`).
    """
    register()

    def main(config: DictConfig) -> sweeps.Outcome | None:
        sweeping = HydraConfig.get().mode == RunMode.MULTIRUN
        fail = functools.partial(_fail, sweeping=sweeping)
        try:
            document = run(_settings(config))
        except KeyboardInterrupt:
            print(
                "sfkd_jax: interrupted; the same command continues",
                file=sys.stderr,
                flush=True,
            )
            os._exit(
                INTERRUPTED
                # The interpreter would first wait for compiled code that nobody needs any
                # more.
            )
        except CertificationRefused as reason:
            return fail(f"refused: {reason}", REFUSED)
        except CertificateStale as reason:
            return fail(f"stale: {reason}", STALE)
        except (HydraException, OmegaConfBaseException) as reason:
            return fail(_one_line(reason), 1)
        except (ArtefactError, ValueError, training.TrainingStopped, OSError) as reason:
            return fail(
                str(reason).splitlines()[0] if str(reason) else type(reason).__name__, 1
            )
        except Exception as reason:
            if not sweeping:
                raise
            traceback.print_exc()  # to the job's own log: nobody expected this
            return fail(queues.one_line(reason), 1)
        print(json.dumps(document), flush=True)
        return sweeps.Outcome(document.get("objective")) if sweeping else None

    opened = hydra.main(
        config_path=conf_path(), config_name="config", version_base="1.3"
    )(main)
    return functools.partial(_open, opened)


def _open(opened: Callable[[], None]) -> None:
    """Open a door; what cannot be composed or launched is one line, unless HYDRA_FULL_ERROR asks for all of it."""
    loud = "HYDRA_FULL_ERROR" in os.environ
    os.environ["HYDRA_FULL_ERROR"] = (
        "1"  # else Hydra prints what is wrong in its own words and exits
    )
    try:
        with sweeps.watched() as sweep:
            opened()
    except (HydraException, OmegaConfBaseException, sweeps.SweepError) as reason:
        if loud:
            raise
        _fail(_one_line(reason), 1)
    except KeyboardInterrupt:
        _fail("interrupted; the same command continues", 130)
    finally:
        if not loud:
            del os.environ["HYDRA_FULL_ERROR"]
    sweep.report()
    if sweep.status():
        sys.exit(sweep.status())


def _one_line(reason: BaseException) -> str:
    """Hydra's reason and OmegaConf's behind it, without search paths and what types they have inside."""
    behind = (
        reason.__cause__
        if isinstance(reason.__cause__, OmegaConfBaseException)
        else None
    )
    asked = f"{reason.override}: " if isinstance(reason, OverrideParseException) else ""
    text = f"{asked}{reason}" + (f": {behind}" if behind else "")
    words = re.split(r"Config search path|\n\s*full_key:|\nSee https", text)[0].split()
    return " ".join(
        word for word in words if not word.endswith("schema")
    )  # options for other options alone


def _settings(config: DictConfig) -> dict[str, Any]:
    """Plain settings; a model that is told nothing of the environment has no use for it.

    Raises:
        ValueError: a setting that cannot be meant, an `env_source` that there is not, or an
            estimate of what the model does not read.
    """
    settings = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    ranges.check(settings)
    env_source, model = settings["env_source"], settings["model"]
    if env_source not in build.ENV_SOURCES:
        raise ValueError(
            f"unknown env_source {env_source!r}; "
            f"choose one of {', '.join(build.ENV_SOURCES)}"
        )
    if env_source == "estimated" and not model["environment"]:
        raise ValueError(
            "env_source=estimated needs a model that reads the environment; drop model.environment=false"
        )
    model["environment"] &= env_source != "none"
    return settings


def _fail(reason: str, code: int, *, sweeping: bool = False) -> sweeps.Outcome:
    """One line on stderr, then the exit code; in a sweep, the outcome of a job that failed."""
    print(f"sfkd_jax: {reason}", file=sys.stderr, flush=True)
    return sweeps.Outcome(math.inf, reason) if sweeping else sys.exit(code)
