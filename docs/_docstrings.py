"""A griffe extension: turn public names in docstrings into links on the site."""

from __future__ import annotations

import re
from typing import Any

import griffe

NAME = re.compile(r"(?<![`\w])`([A-Za-z_]\w*)`(?!`)")
STAR = re.compile(r"(?<=\w)\*(?=\()")
ZERO_WIDTH_SPACE = "\u200b"


def linked(text: str, targets: dict[str, str]) -> str:
    """Link public names, and protect units in brackets and u*(κ) from Markdown.

    Args:
        text: a docstring.
        targets: path of the object to link to, by name.
    """
    text = STAR.sub(r"\\*", text.replace("] [", f"]{ZERO_WIDTH_SPACE} ["))
    return NAME.sub(
        lambda match: (
            f"[{match[0]}][{targets[match[1]]}]" if match[1] in targets else match[0]
        ),
        text,
    )


def _has_an_entry(member: Any) -> bool:
    """Return whether the reference shows a member of a package."""
    if member.name.startswith("_") or (member.is_alias and not member.public):
        return False
    try:
        return member.docstring is not None
    except griffe.AliasResolutionError:  # of another library
        return False


class Docstrings(griffe.Extension):
    """Rewrites every docstring of the library once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Rewrite the docstrings of every package."""
        del kwargs
        for package in pkg.members.values():
            if package.is_alias or not package.is_module:
                continue
            targets = {
                name: f"{package.path}.{name}"
                for name, member in package.members.items()
                if _has_an_entry(member)
            }
            self._rewrite_members(package, targets)

    def _rewrite_members(self, parent: Any, targets: dict[str, str]) -> None:
        """Rewrite the docstrings of the members of a module or class."""
        for member in parent.members.values():
            if member.is_alias:
                continue
            if member.docstring is not None:
                member.docstring.value = linked(member.docstring.value, targets)
            self._rewrite_members(member, targets)
