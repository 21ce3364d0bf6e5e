"""Composed settings of a command, and the words that were typed for it."""

from __future__ import annotations

import shlex
import typing
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from sfkd_jax import build
from sfkd_jax.cli import ranges
from sfkd_jax.cli.groups import register as register
from sfkd_jax.cli.groups import root_schema
from sfkd_jax.cli.options import conf_path as conf_path


def compose(*overrides: str) -> dict[str, Any]:
    """Return the settings of the running command under further overrides."""
    typed = HydraConfig.get().overrides.task
    return plain_settings(hydra.compose("config", [*typed, *overrides]))


def command_line(name: str) -> str:
    """Return the running command as typed in a shell, without `root=`."""
    typed = [
        word
        for word in HydraConfig.get().overrides.task
        if not word.startswith("root=")
    ]
    return " ".join(["python -m", f"sfkd_jax.{name}", shlex.join(typed)]).strip()


def plain_settings(config: DictConfig) -> dict[str, Any]:
    """Return checked settings as nested dicts.

    With `env_source=none` the model reads no environment.

    Raises:
        ValueError: a setting that does not exist or is out of its range, an unknown
            `env_source`, or an estimate of an environment that the model does not read.
    """
    ranges.check(config, root_schema())
    settings = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    env_source, model = settings["env_source"], settings["model"]
    if env_source not in build.ENV_SOURCES:
        raise ValueError(
            f"unknown env_source {env_source!r}; "
            f"choose one of {', '.join(build.ENV_SOURCES)}"
        )
    if env_source == "estimated" and not model["environment"]:
        raise ValueError(
            "env_source=estimated needs a model that reads the environment; "
            "drop model.environment=false"
        )
    model["environment"] &= env_source != "none"
    return settings
