"""Messages of one line about settings and options that Hydra refuses."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import nullcontext
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import (
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sfkd_jax.cli.options import EXPERIMENT, GROUPS, SCHEMA, conf_path

_ADVICE = "|".join(
    (
        r"Config search path",
        r"\n\s*full_key:",
        r"\nSee https",
        r"\n?To append to your",
        r"\n?Either remove",
    )
)
"""Where details and Hydra's own advice begin, which may be to add a wrong setting."""
SIMILAR = 0.75
"""Similarity of two names, from 0 to 1, from which one is suggested for the other."""


def one_line(reason: BaseException, overrides: Sequence[str] = ()) -> str:
    """Return what Hydra or OmegaConf refuses, with what was probably meant.

    Args:
        reason: the exception.
        overrides: of the command; they decide which settings there are.
    """
    if isinstance(reason, MissingConfigException) and reason.options:
        return _unknown_option(reason)
    unknown = re.match(r"Could not override '([^']+)'", str(reason))
    if unknown and not unknown[1].startswith("hydra"):
        return unknown_setting(unknown[1], _names_under(overrides))
    override = (
        f"{reason.override}: " if isinstance(reason, OverrideParseException) else ""
    )
    cause = reason.__cause__
    behind = f": {cause}" if isinstance(cause, OmegaConfBaseException) else ""
    text = re.split(_ADVICE, f"{override}{reason}{behind}")[0]
    return " ".join(word for word in text.split() if not word.endswith(SCHEMA))


def unknown_setting(name: str, known: Collection[str]) -> str:
    """Return a line about a setting that does not exist; `known` are those that do."""
    hint = did_you_mean(name, [*known, f"+{EXPERIMENT}"])
    return f"unknown setting {name}{hint}"


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Return "; did you mean …?" with the closest of the known names, or nothing.

    A name that resembles none as a whole is compared with the last parts of them, so
    that `steps` leads to `training.steps`.
    """
    if close := difflib.get_close_matches(name, known, n=1, cutoff=SIMILAR):
        return f"; did you mean {close[0]}?"
    ends = {one.rpartition(".")[2] for one in known}
    last = name.rpartition(".")[2]
    ending = difflib.get_close_matches(last, ends, n=1, cutoff=SIMILAR)
    similar = [one for one in known if one.rpartition(".")[2] in ending]
    return f"; did you mean {' or '.join(similar[:3])}?" if similar else ""


def setting_names(settings: Any, above: str = "") -> Iterator[str]:
    """Yield the dotted names of nested settings, those of inner mappings included."""
    for key, value in settings.items():
        yield f"{above}{key}"
        if isinstance(value, dict):
            yield from setting_names(value, f"{above}{key}.")


def _unknown_option(reason: MissingConfigException) -> str:
    """Return a line with the options of a group."""
    group, _, option = str(reason.missing_cfg_file).rpartition("/")
    known = [one for one in reason.options or () if not one.endswith(SCHEMA)]
    hint = did_you_mean(option, known) or "."
    prefix = "+" if group == EXPERIMENT else ""
    return f"unknown option {prefix}{group}={option}{hint} Options: {', '.join(known)}"


def _names_under(overrides: Sequence[str]) -> list[str]:
    """Return the names of all settings under the options that the overrides choose."""
    groups = (*GROUPS, *(f"+{group}" for group in (*GROUPS, EXPERIMENT)))
    chosen = [word for word in overrides if word.partition("=")[0] in groups]
    running = GlobalHydra.instance().is_initialized()  # a row of a comparison
    with (
        nullcontext()
        if running
        else hydra.initialize_config_dir(conf_path(), version_base="1.3")
    ):
        for attempt in (chosen, []):
            try:
                config = hydra.compose("config", attempt)
            except (HydraException, OmegaConfBaseException):
                continue
            return list(setting_names(OmegaConf.to_container(config)))
    return []
