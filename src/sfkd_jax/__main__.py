"""The program `sfkd`: `sfkd train` does what `python -m sfkd_jax.train` does."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

from sfkd_jax import __version__
from sfkd_jax.settings import did_you_mean

COMMANDS = ("demo", "train", "generate", "certify", "evaluate", "compare")
COMMANDS += ("collect", "report", "export")
"""Modules that are commands, in the order in which they are listed."""
VERSION = f"sfkd_jax {__version__}"


def main() -> None:
    """Run the command that the first argument names; without one, list the commands."""
    command, *rest = sys.argv[1:] or ["--help"]
    if command in ("--help", "-h"):
        print(overview())
    elif command == "--version":
        print(VERSION)
    elif command in COMMANDS:
        # The imports take seconds; the list above is quick.
        hydra_command = import_module("sfkd_jax.experiment.command").hydra_command
        package = _file(command).stem == "__main__"
        module = import_module(f"sfkd_jax.{command}{'.__main__' * package}")
        sys.argv = [f"sfkd {command}", *rest]
        hydra_command(module.run)()
    else:
        hint = did_you_mean(command, COMMANDS) or ";"
        sys.exit(f"sfkd_jax: unknown command {command}{hint} sfkd lists them")


def overview() -> str:
    """Return the page that lists the commands."""
    listed = []
    for name in COMMANDS:
        # Parsed, not imported: that would take seconds.
        text = ast.get_docstring(ast.parse(_file(name).read_text("utf-8"))) or ""
        listed.append(f"  {name:8}  {text.partition(chr(10))[0]}")
    lines = [
        f"{VERSION}: learned dynamics with a stability certificate, driving MPPI.",
        "",
        "usage: sfkd COMMAND [+experiment=NAME] [GROUP=OPTION] [SETTING=VALUE]",
        "",
        *listed,
        "",
        "sfkd COMMAND --help lists groups and options, --cfg job all settings;",
        "-sc install=bash completes words; -m seed=0,1 runs a job for each value.",
    ]
    return "\n".join(lines)


def _file(command: str) -> Path:
    """Return the file of a command: of a package, its `__main__`."""
    inside = Path(__file__).with_name(command) / "__main__.py"
    return inside if inside.exists() else Path(__file__).with_name(f"{command}.py")


if __name__ == "__main__":
    main()
