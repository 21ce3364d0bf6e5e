"""The program `sfkd`: `sfkd train` does what `python -m sfkd_jax.train` does."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

from sfkd_jax import __version__
from sfkd_jax.settings import did_you_mean

COMMANDS = (
    "demo",
    "train",
    "generate",
    "certify",
    "evaluate",
    "compare",
    "report",
    "export",
    "doctor",
)
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
        try:
            hydra_command = import_module("sfkd_jax.experiment.command").hydra_command
        except ModuleNotFoundError as reason:
            # A package that only loads policies is installed without these.
            advice = 'pip install "sfkd-jax[train]"'
            sys.exit(f"sfkd_jax: {command} needs {reason.name}: {advice}")
        sys.argv = [f"sfkd {command}", *rest]
        hydra_command(import_module(_module(command)).run)()
    else:
        hint = did_you_mean(command, COMMANDS) or ";"
        sys.exit(f"sfkd_jax: unknown command {command}{hint} sfkd lists them")


def overview() -> str:
    """Return the page that lists the commands."""
    width = max(map(len, COMMANDS))
    return "\n".join(
        [
            f"{VERSION}: learned dynamics with a stability certificate, driving MPPI.",
            "",
            "usage: sfkd COMMAND [+experiment=NAME] [GROUP=OPTION] [SETTING=VALUE]",
            "",
            *(f"  {name:{width}}  {_summary(name)}" for name in COMMANDS),
            "",
            "sfkd COMMAND --help lists groups and options, --cfg job all settings;",
            "-sc install=bash completes words; -m seed=0,1 runs a job for each value.",
        ]
    )


def _module(command: str) -> str:
    """Return the name of a command's module: a package runs its `__main__`."""
    package = Path(__file__).with_name(command) / "__main__.py"
    return f"sfkd_jax.{command}" + (".__main__" if package.exists() else "")


def _summary(command: str) -> str:
    """Return the first line of a command's module docstring, without importing it."""
    file = Path(__file__).with_name(f"{command}.py")
    if not file.exists():
        file = Path(__file__).with_name(command) / "__main__.py"
    text = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    return text.split("\n")[0]


if __name__ == "__main__":
    main()
