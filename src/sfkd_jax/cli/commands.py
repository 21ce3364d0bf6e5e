"""The commands of the package, and what each of them does."""

from __future__ import annotations

import ast
from pathlib import Path

from sfkd_jax import __version__

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


def module(command: str) -> str:
    """Return the name of a command's module: a package runs its `__main__`."""
    package = Path(__file__).parents[1] / command / "__main__.py"
    return f"sfkd_jax.{command}" + (".__main__" if package.exists() else "")


def summary(command: str) -> str:
    """Return the first line of a command's module docstring, without importing it."""
    root = Path(__file__).parents[1]
    file = root / f"{command}.py"
    if not file.exists():
        file = root / command / "__main__.py"
    text = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    return text.split("\n")[0]
