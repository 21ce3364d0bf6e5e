"""The help page of a command: groups, their options, and how to override settings."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from sfkd_jax.cli import commands, options

WIDTH = 88
USAGE = "[+experiment=NAME] [GROUP=OPTION ...] [SETTING=VALUE ...]"


def information(command: str, arguments: Sequence[str]) -> str | None:
    """Return what --help or --version prints; None without either of them."""
    if "--version" in arguments:
        return commands.VERSION
    return help_page(command) if {"--help", "-h"} & set(arguments) else None


def help_page(command: str) -> str:
    """Return the page of a command; the options are those that conf/ holds now."""
    known = command in commands.COMMANDS  # a script may be a command too
    program = f"sfkd {command}" if known else command
    title = f"{program}: {commands.summary(command)}" if known else program
    defaults = options.defaults()
    groups = [
        _group(f"{name}=", sentence, options.options(name), defaults.get(name))
        for name, sentence in options.GROUPS.items()
    ]
    experiments = options.options(options.EXPERIMENT)
    launchers = "|".join(options.options("hydra/launcher"))
    sweepers = "|".join(options.options("hydra/sweeper"))
    return "\n".join(
        [
            *textwrap.wrap(title, WIDTH),
            "",
            f"usage: {program} {USAGE}",
            "",
            _group("+experiment=", "a choice from all groups below", experiments),
            *groups,
            "",
            f"* marks the default. training.steps=1000 changes a setting; {program}",
            "--cfg job prints all settings, --cfg job -p training those of one group.",
            "-m seed=0,1,2 runs one job for each value, in parallel with",
            f"hydra/launcher={launchers}; hydra/sweeper={sweepers} searches.",
            "--version prints the version, --hydra-help lists the other flags.",
        ]
    )


def _group(
    name: str, sentence: str, known: list[str], default: str | None = None
) -> str:
    """Return the lines of a group: what it chooses, then its options."""
    listed = " ".join(f"{one}*" if one == default else one for one in known)
    indent = " " * 4
    lines = textwrap.wrap(
        listed, WIDTH, initial_indent=indent, subsequent_indent=indent
    )
    return "\n".join([f"{name:16}{sentence}", *lines])
