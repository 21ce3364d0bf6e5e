"""What every command does around its work: compose, check, run, report, exit."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import sys
from collections.abc import Callable, Collection
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import hydra
import jax
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from threadpoolctl import threadpool_limits

from sfkd_jax import training
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.experiment.identified import with_identified
from sfkd_jax.experiment.options import Settings, parse_settings
from sfkd_jax.experiment.run import Run
from sfkd_jax.experiment.run_directory import IDENTITY
from sfkd_jax.experiment.scaling import scaled, summary
from sfkd_jax.experiment.schemas import register
from sfkd_jax.settings import replace
from sfkd_jax.store import ArtefactError, print_message

FAILED = 1
"""Exit code of a command that ends with an expected error."""
INTERRUPTED = 130
"""Exit code of a command that the user interrupts."""
OUTCOMES = {CertificationRefused: ("refused: ", 2), CertificateStale: ("stale: ", 3)}
"""Errors with an exit code of their own: what begins their line, and the code."""
EXPECTED = (*OUTCOMES, ArtefactError, ValueError, training.TrainingStopped, OSError)
"""Errors that become one line."""
LONGEST_NAME = 160
"""The most characters of a directory name of a sweep; file systems allow 255."""


def hydra_command(
    command: Callable[[Run], dict[str, Any]], *, of_systems: bool = False
) -> Callable[[], None]:
    """Make `command(run) -> document` a command, whose `Run` is made here.

    A command that is not `of_systems` refuses the setting `system`.

    The command prints the document as JSON in the last line of stdout. Expected errors
    become one line on stderr and an exit code. A job of a sweep returns "objective" to
    the sweeper; one that fails raises, which Hydra reports after all other jobs.
    """
    # Before Hydra composes, since it checks options against these schemas.
    register()

    def main(composed: DictConfig) -> Any:
        sweeping = HydraConfig.get().mode == RunMode.MULTIRUN
        try:
            settings = named_for_controller(settings_of(composed, _typed()))
            if settings.system is not None and not of_systems:
                raise ValueError("system=… is for train, report and export alone")
            if derived := summary(settings):
                print_message(derived)
            if sweeping:
                settings = named_for_sweep(settings)
            use_compilation_cache(Path(settings.root))
            if not settings.optimized:
                compile_fast()
            check_devices()
            # Small factorisations, in every step of a training: threads of BLAS would
            # wait for each other, and keep XLA's waiting, for half of the time.
            with threadpool_limits(1, user_api="blas"):
                document = command(Run.of(with_identified(settings)))
        except KeyboardInterrupt:
            print_message("sfkd_jax: interrupted; the same command continues")
            # The interpreter would first wait for compiled code that nobody needs.
            os._exit(INTERRUPTED)
        except EXPECTED as reason:
            prefix, code = OUTCOMES.get(type(reason), ("", FAILED))
            line = next(iter(str(reason).splitlines()), type(reason).__name__)
            print_message(f"sfkd_jax: {prefix}{line}")
            if sweeping:  # an exit would end the jobs that follow
                raise
            sys.exit(code)
        except Exception as reason:
            if sweeping:  # Hydra shows the first failure alone
                print_message(f"sfkd_jax: {type(reason).__name__}: {reason}")
            raise
        print_result(document)
        return document.get("objective")

    composing = hydra.main(
        config_path=conf_path(), config_name="config", version_base="1.3"
    )(main)

    def start() -> None:
        if reason := _unusable(sys.argv[1:]):
            print_message(f"sfkd_jax: {reason}")
            sys.exit(FAILED)
        composing()

    return start


def check_devices() -> None:
    """Refuse a device that the user has asked for and JAX does not find.

    Otherwise the first number that is computed would fail, with another cause.

    Raises:
        ValueError: with the message of JAX.
    """
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if not platforms:
        return
    try:
        jax.devices()
    except Exception as reason:  # Also an AssertionError, which has no message.
        message = next(iter(str(reason).splitlines()), "JAX finds no such device")
        raise ValueError(f"JAX_PLATFORMS={platforms}: {message}") from None


def print_result(document: dict[str, Any]) -> None:
    """Print the JSON of a result to stdout, which nobody may read any more."""
    try:
        print(json.dumps(document), flush=True)
    except BrokenPipeError:
        # The interpreter flushes stdout once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _unusable(words: list[str]) -> str | None:
    """Return why a command line cannot be used, where Hydra would not say it plainly.

    Hydra would end in a traceback, or in a message about its grammar. None: Hydra may
    have the words.
    """
    try:
        os.getcwd()
    except FileNotFoundError:
        return "this directory was deleted: change to one that exists"
    parser = OverridesParser.create()
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or word.startswith("-") or value.startswith(("[", "{")):
            continue
        quoted = f'{name}="{value}"'
        try:
            parser.parse_override(word)
        except HydraException:
            # Letters beyond ASCII, ~ and = inside a value; other faults are Hydra's.
            with suppress(HydraException):
                parser.parse_override(quoted)
                return f"{word}: quote the value, '{quoted}'"
    return None


def conf_path() -> str:
    """Return the folder of options: of the checkout, or of the installed package."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "conf"
    checkout = package.parents[1] / "conf"
    return str(installed if installed.exists() else checkout)


def settings_of(composed: DictConfig, words: Collection[str] = ()) -> Settings:
    """Return composed options as checked settings, scaled to the vehicle.

    Args:
        composed: by Hydra.
        words: the overrides that it was composed with.
    """
    values: Any = OmegaConf.to_container(composed, resolve=True)
    return scaled(parse_settings(values), words)


def _typed() -> list[str]:
    """Return the overrides of the running command, as they were typed."""
    # A program that calls a command as a function has typed nothing.
    if not HydraConfig.initialized():
        return []
    return [*HydraConfig.get().overrides.task]


def compose(*overrides: str) -> Settings:
    """Return the settings of the running command under further overrides."""
    words = [*_typed(), *overrides]
    composed = hydra.compose("config", words)
    return with_identified(settings_of(composed, words))


def command_line(name: str) -> str:
    """Return the running command as typed in a shell, without `root=`."""
    # A path of this machine means nothing to whoever repeats the command.
    kept = [word for word in _typed() if not word.startswith("root=")]
    return " ".join(["python -m", f"sfkd_jax.{name}", shlex.join(kept)]).strip()


def use_compilation_cache(root: Path) -> None:
    """Keep compiled programs below `root`, or where the user has said."""
    defaults = {
        "jax_compilation_cache_dir": str(root.resolve() / "compiled"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for option, value in defaults.items():
        # What the user has set in the environment wins.
        if option.upper() not in os.environ:
            jax.config.update(option, value)


def compile_fast() -> None:
    """Compile fast, not well: a trial spends its time on compiling, not on running."""
    jax.config.update("jax_disable_most_optimizations", True)
    flags = [os.environ.get("XLA_FLAGS", "")]
    # Fusion by MLIR is half of the time. XLA aborts at a flag that it does not know.
    if metadata.version("jaxlib").startswith("0.10."):
        flags.append("--xla_cpu_use_fusion_emitters=false")
    # Read when the first program is compiled, which comes later.
    os.environ["XLA_FLAGS"] = " ".join(flags)


def named_for_sweep(settings: Settings) -> Settings:
    """Return the settings of a job of a sweep under a run name of its own.

    It says what changes the weights, so that jobs do not write into one directory.
    """
    # By setting, such as "training.steps": model and seed choose directories already.
    overrides = []
    # An override that was typed twice changes no more than once.
    for override in dict.fromkeys(word.lstrip("+") for word in _typed()):
        setting = override.split("=")[0]
        group = setting.split(".")[0]
        if group in IDENTITY and setting not in ("model", "seed"):
            overrides.append(override)
    if not overrides:
        return settings
    name = _name_of(overrides)
    # The policies of a comparison follow, unless they have a name of their own.
    comparison = settings.comparison
    if comparison.policies == settings.name:
        comparison = replace(comparison, policies=f"{settings.name}/{name}")
    return replace(settings, name=f"{settings.name}/{name}", comparison=comparison)


def named_for_controller(settings: Settings) -> Settings:
    """Return the settings with what was typed about the controller in its name.

    Rows of results.json are told apart by names: with other samples it is another row.
    """
    prefix = "controller."
    overrides = []
    for word in _typed():
        override = word.lstrip("+")
        if override.startswith(prefix) and not override.startswith(f"{prefix}name="):
            overrides.append(override.removeprefix(prefix))
    if not overrides:
        return settings
    name = f"{settings.controller.name},{_name_of(overrides)}"
    return replace(settings, controller=replace(settings.controller, name=name))


def _name_of(overrides: list[str]) -> str:
    """Return a name of a file that says what was overridden."""
    # Sorted: the order in which options were typed makes no difference.
    varied = ",".join(sorted(overrides))
    name = "-".join(re.findall(r"[\w.+=,-]+", varied, re.ASCII))
    # A name that was cleaned or cut needs its digest, or two jobs might share it.
    if name != varied or len(name) > LONGEST_NAME:
        digest = hashlib.sha256(varied.encode()).hexdigest()[:8]
        name = f"{name[:LONGEST_NAME]}-{digest}"
    return name
